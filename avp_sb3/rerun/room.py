"""What a recording shows of the environments of a training, and of any room: a cloud out of pictures with depth."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, camera_to_world, pixel_directions
from avp_sb3.rerun.episode import EncodedView, encode_view, spread_indices

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

    from avp_habitat.navigation.area import NavigableArea
    from avp_habitat.task.trajectory import Trajectory

Cloud = tuple[NDArray[np.float32], NDArray[np.uint8]]
"""`(p, 3)` points in metres, world frame, and `(p, 3)` colours."""
_PIXELS_PER_FRAME = 40_000
_CELL_KEY = np.array([1 << 42, 1 << 21, 1])
_GROWTH = 1.05
_POINT_RADIUS_M = 0.02
_HFOV_DEG, _SENSOR_HEIGHT_M = 90.0, 1.5
_ROOM_WIDTH, _ROOM_HEIGHT = 72, 54
_CANDIDATES, _YAWS, _PITCH_DEG = 512, 3, -20.0
_TURN = 0.382  # of a full one from place to place, so that no two look the same ways


class RecordedEnvironments:
    """The environments of a training; each of `area`, `capture`, `scene_name` and `settings` may be missing."""

    def __init__(self, env: "VecEnv") -> None:
        """Ask which attributes they have."""
        self._env = env
        self._has = {name: env.has_attr(name) for name in ("area", "capture", "scene_name", "settings")}
        self.missing = [name for name in ("area", "capture") if not self._has[name]]
        """Those of `area` and `capture` that the environments lack."""

    @property
    def areas(self) -> "dict[str, NavigableArea | None]":
        """Where agents can stand, by the scene's name, each once; one empty name where none is told."""
        names: list[str] = self._env.get_attr("scene_name") if self._has["scene_name"] else [""]
        return {name: self.get("area", names.index(name)) for name in dict.fromkeys(names)}

    def get(self, name: str, index: int, default: Any = None) -> Any:
        """One of the attributes of an environment."""
        return self._env.get_attr(name, index)[0] if self._has[name] else default

    def camera(self, index: int, *, width: int, height: int) -> Intrinsics:
        """A camera of the given size in pixels, with the field of view of the environment's own."""
        hfov_deg = getattr(self.get("settings", index), "hfov_deg", _HFOV_DEG)
        return Intrinsics.from_hfov(width, height, hfov_deg=hfov_deg)

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
        if self.missing:
            return None
        area = self.get("area", index)
        height = getattr(self.get("settings", index), "sensor_height_m", _SENSOR_HEIGHT_M)
        poses, camera = room_poses(area, height), self.camera(index, width=_ROOM_WIDTH, height=_ROOM_HEIGHT)
        return room_points(self._capture(index, poses, camera), camera, poses)

    def _capture(self, index: int, poses: NDArray[np.floating], camera: Intrinsics) -> list[tuple[NDArray, NDArray]]:
        """Picture and depth at each pose."""
        frames = self._env.env_method("capture", np.ascontiguousarray(poses), camera, indices=index)[0]
        return list(zip(frames.rgb, frames.depth, strict=True))


def room_poses(area: "NavigableArea", sensor_height_m: float, *, places: int = 12) -> NDArray[np.float64]:
    """`(3 * places, 4, 4)` habitat poses: always the same three directions at each of some places far apart."""
    candidates = area.random_points(np.random.default_rng(0), _CANDIDATES)
    chosen, distance = [0], np.full(len(candidates), np.inf)
    while len(chosen) < places:
        distance = np.minimum(distance, np.linalg.norm(candidates - candidates[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    standing = np.repeat(candidates[chosen], _YAWS, axis=0) + np.array([0.0, sensor_height_m, 0.0])
    place, direction = np.divmod(np.arange(len(standing)), _YAWS)
    yaw = 2 * np.pi * (place * _TURN + direction / _YAWS)
    return camera_to_world(standing, yaw=yaw, pitch=np.full(len(standing), np.radians(_PITCH_DEG)))


def room_points(
    frames: Iterable[tuple[NDArray[np.uint8], NDArray[np.floating]]],
    intrinsics: Intrinsics,
    camera_to_world: NDArray[np.floating],
    *,
    voxel_m: float = 0.05,
    at_most: int = 60_000,
    max_depth_m: float = 10.0,
    ceiling_m: float = 0.3,
) -> Cloud:
    """A cloud with one point in each occupied voxel, at the mean place and colour of the pixels that fell into it.

    Of large pictures a regular grid of about 40,000 pixels is used.

    Args:
        frames: k times a `(h, w, 3)` uint8 picture and its `(h, w)` planar depth in metres, 0 (or NaN) = none.
        intrinsics: of all frames.
        camera_to_world: `(k, 4, 4)` habitat poses in the order of the frames.
        voxel_m: side of a voxel in metres; it grows until at most `at_most` are occupied.
        at_most: points, above 0.
        max_depth_m: pixels farther than this are left out, metres.
        ceiling_m: points more than this above the highest camera are left out, metres: seen from above, a ceiling hides
            the room. `math.inf` keeps all.
    """
    stride = max(1, int(np.ceil(np.sqrt(intrinsics.width * intrinsics.height / _PIXELS_PER_FRAME))))
    directions = pixel_directions(intrinsics)[::stride, ::stride]
    ceiling = np.max(camera_to_world[:, 1, 3], initial=-np.inf) + ceiling_m
    clouds = [np.empty((0, 7))]
    for (rgb, depth), pose in zip(frames, camera_to_world, strict=True):
        seen, colours = np.asarray(depth)[::stride, ::stride].astype(np.float64), np.asarray(rgb)[::stride, ::stride]
        hit = (seen > 0) & (seen <= max_depth_m)
        points = (directions[hit] * seen[hit][:, None]) @ pose[:3, :3].T + pose[:3, 3]
        rows = np.column_stack([points, colours[hit].astype(np.float64), np.ones(len(points))])
        clouds.append(_summed(rows[points[:, 1] <= ceiling], voxel_m))
    rows = _summed(np.concatenate(clouds), voxel_m)
    while len(rows) > at_most:
        voxel_m *= max(_GROWTH, np.sqrt(len(rows) / at_most))
        rows = _summed(rows, voxel_m, from_least=True)
    means = rows[:, :6] / np.maximum(rows[:, 6:], 1)
    return means[:, :3].astype(np.float32), means[:, 3:].round().astype(np.uint8)


def _summed(rows: NDArray[np.float64], voxel_m: float, *, from_least: bool = False) -> NDArray[np.float64]:
    """Add up the `(n, 7)` sums over pixels (place, colour, how many) whose mean places lie in the same voxel."""
    places = rows[:, :3] / rows[:, 6:]
    cells = np.floor((places - (places.min(axis=0) if from_least else 0)) / voxel_m).astype(np.int64)
    _, group = np.unique(cells @ _CELL_KEY, return_inverse=True)
    return np.stack([np.bincount(group, weights=column).astype(np.float64) for column in rows.T], axis=1)


def log_room(recording: rr.RecordingStream, path: str, cloud: Cloud) -> None:
    """Add a room to a recording, at all times."""
    points, colours = cloud
    recording.log(path, rr.Points3D(points, colors=colours, radii=[_POINT_RADIUS_M]), static=True)
