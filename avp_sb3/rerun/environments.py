"""What a recording asks the environments of a training for."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from avp_habitat.poses import Intrinsics, camera_to_world
from avp_sb3.rerun.episode import EncodedView, encode_view, spread_indices
from avp_sb3.rerun.room import Cloud, room_points

if TYPE_CHECKING:
    from avp_habitat.navigation.area import NavigableArea
    from avp_habitat.task.trajectory import Trajectory

_HFOV_DEG, _SENSOR_HEIGHT_M = 90.0, 1.5
_ROOM_WIDTH, _ROOM_HEIGHT = 72, 54
_CANDIDATES, _YAWS, _PITCH_DEG = 512, 3, -20.0
_TURN = 0.382  # of a full one from place to place, so that no two look the same ways


class RecordedEnvironments:
    """The environments of a training; each of `area`, `capture`, `scene_name` and `settings` may be missing."""

    def __init__(self, env: VecEnv) -> None:
        """Ask which attributes they have."""
        self._env = env
        self._has = {name: env.has_attr(name) for name in ("area", "capture", "scene_name", "settings")}
        self.missing = [name for name in ("area", "capture") if not self._has[name]]
        """Those of `area` and `capture` that the environments lack."""

    @property
    def areas(self) -> "dict[str, NavigableArea | None]":
        """Where agents can stand, by the scene's name, each once; one empty name where none is told."""
        names: list[str] = self._env.get_attr("scene_name") if self._has["scene_name"] else [""]
        return {name: self.area(names.index(name)) for name in dict.fromkeys(names)}

    def scene(self, index: int) -> str:
        """Name of an environment's scene."""
        return self._get(index, "scene_name", "")

    def area(self, index: int) -> "NavigableArea | None":
        """Where an environment's agent can stand."""
        return self._get(index, "area", None)

    def camera(self, index: int, *, width: int, height: int) -> Intrinsics:
        """A camera of the given size in pixels, with the field of view of the environment's own."""
        settings = self._get(index, "settings", None)
        return Intrinsics.from_hfov(width, height, hfov_deg=getattr(settings, "hfov_deg", _HFOV_DEG))

    def pictures(
        self, index: int, trajectory: "Trajectory", camera: Intrinsics, *, at_most: int
    ) -> dict[int, EncodedView]:
        """Pictures of an episode by step, spread over it; rendered now, none where the environment cannot."""
        steps = spread_indices(len(trajectory.action), at_most)
        if not self._has["capture"] or not steps:
            return {}
        frames = self._capture(index, trajectory.camera_to_world[steps], camera)
        return {step: encode_view(rgb, depth) for step, (rgb, depth) in zip(steps, frames, strict=True)}

    def room(self, index: int) -> Cloud | None:
        """Points and colours of an environment's scene, rendered now; None where it cannot be."""
        area = self.area(index)
        if area is None or not self._has["capture"]:
            return None
        height = getattr(self._get(index, "settings", None), "sensor_height_m", _SENSOR_HEIGHT_M)
        poses, camera = room_poses(area, height), self.camera(index, width=_ROOM_WIDTH, height=_ROOM_HEIGHT)
        return room_points(self._capture(index, poses, camera), camera, poses)

    def _capture(self, index: int, poses: NDArray[np.floating], camera: Intrinsics) -> list[tuple[NDArray, NDArray]]:
        """Picture and depth at each pose."""
        frames = self._env.env_method("capture", np.ascontiguousarray(poses), camera, indices=index)[0]
        return list(zip(frames.rgb, frames.depth, strict=True))

    def _get(self, index: int, name: str, default: Any) -> Any:
        return self._env.get_attr(name, index)[0] if self._has[name] else default


def room_poses(area: "NavigableArea", sensor_height_m: float, *, places: int = 12) -> NDArray[np.float64]:
    """Views from all over a scene, always the same ones: three directions at each of some places far from each other.

    Args:
        area: where one can stand.
        sensor_height_m: above the floor, metres.
        places: how many.

    Returns:
        `(3 * places, 4, 4)` habitat camera_to_world.
    """
    candidates = area.random_points(np.random.default_rng(0), _CANDIDATES)
    chosen, distance = [0], np.full(len(candidates), np.inf)
    while len(chosen) < places:
        distance = np.minimum(distance, np.linalg.norm(candidates - candidates[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    standing = np.repeat(candidates[chosen], _YAWS, axis=0) + np.array([0.0, sensor_height_m, 0.0])
    place, direction = np.divmod(np.arange(len(standing)), _YAWS)
    yaw = 2 * np.pi * (place * _TURN + direction / _YAWS)
    return camera_to_world(standing, yaw=yaw, pitch=np.full(len(standing), np.radians(_PITCH_DEG)))
