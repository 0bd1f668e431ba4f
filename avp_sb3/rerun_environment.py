"""What a recording asks of the environments: scene, navigable area, pictures and room, as far as they have them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from avp_habitat.poses import Intrinsics
from avp_sb3.rerun_episode import EncodedView, encode_view, spread_indices
from avp_sb3.rerun_room import room_points, room_poses

if TYPE_CHECKING:
    from avp_habitat.navigation.area import NavigableArea
    from avp_habitat.simulators import Frames
    from avp_habitat.trajectory import Trajectory

_HFOV_DEG, _SENSOR_HEIGHT_M = 90.0, 1.5
_ROOM_WIDTH, _ROOM_HEIGHT = 72, 54
_UNNAMED = ""


class RecordedEnvironments:
    """The environments of a training; each of them may lack what a recording would show."""

    def __init__(self, env: VecEnv) -> None:
        """Ask which attributes they have.

        Args:
            env: the training's.
        """
        self._env = env
        self.missing = [name for name in ("area", "capture") if not env.has_attr(name)]
        """Those of `area` and `capture` that the environments lack."""
        self._has_names, self._has_settings = env.has_attr("scene_name"), env.has_attr("settings")

    @property
    def scenes(self) -> list[str]:
        """Names of all scenes, each once; one empty name where environments do not tell."""
        return list(dict.fromkeys(self._names()))

    @property
    def areas(self) -> "dict[str, NavigableArea]":
        """Where agents can stand, by the scene's name; none where environments do not tell."""
        if "area" in self.missing:
            return {}
        names = self._names()
        return {name: self._env.get_attr("area", names.index(name))[0] for name in dict.fromkeys(names)}

    def scene(self, index: int) -> str:
        """Name of an environment's scene."""
        return self._env.get_attr("scene_name", index)[0] if self._has_names else _UNNAMED

    def area(self, index: int) -> "NavigableArea | None":
        """Where an environment's agent can stand."""
        return None if "area" in self.missing else self._env.get_attr("area", index)[0]

    def camera(self, index: int, *, width: int, height: int) -> Intrinsics:
        """A camera of the given size in pixels, with the field of view of the environment's own."""
        return Intrinsics.from_hfov(width, height, hfov_deg=self._setting(index, "hfov_deg", _HFOV_DEG))

    def pictures(
        self, index: int, trajectory: "Trajectory", camera: Intrinsics, *, at_most: int
    ) -> dict[int, EncodedView]:
        """Pictures of an episode by step, spread over it; rendered now, none where the environment cannot."""
        steps = spread_indices(len(trajectory.action), at_most)
        if "capture" in self.missing or not steps:
            return {}
        frames = self._capture(index, trajectory.camera_to_world[steps], camera)
        pairs = zip(steps, _colours(frames), frames.depth, strict=True)
        return {step: encode_view(rgb, depth) for step, rgb, depth in pairs}

    def room(self, index: int) -> "tuple[NDArray[np.float32], NDArray[np.uint8]] | None":
        """Points and colours of an environment's scene, rendered now; None where it cannot be."""
        area = self.area(index)
        if area is None or "capture" in self.missing:
            return None
        poses = room_poses(area, sensor_height_m=self._setting(index, "sensor_height_m", _SENSOR_HEIGHT_M))
        camera = self.camera(index, width=_ROOM_WIDTH, height=_ROOM_HEIGHT)
        frames = self._capture(index, poses, camera)
        return room_points(zip(_colours(frames), frames.depth, strict=True), camera, poses)

    def _capture(self, index: int, poses: NDArray[np.floating], camera: Intrinsics) -> "Frames":
        return self._env.env_method("capture", np.ascontiguousarray(poses), camera, indices=index)[0]

    def _names(self) -> list[str]:
        return self._env.get_attr("scene_name") if self._has_names else [_UNNAMED]

    def _setting(self, index: int, name: str, default: float) -> float:
        if not self._has_settings:
            return default
        settings: Any = self._env.get_attr("settings", index)[0]
        return getattr(settings, name, default)


def _colours(frames: "Frames") -> Sequence[NDArray[np.uint8]]:
    assert frames.rgb is not None
    return list(frames.rgb)
