"""The held-out views of a scene: poses, the same ones always, from whose pictures nothing is ever reconstructed."""

import itertools
from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from avp_habitat import poses
from avp_habitat.errors import SceneError
from avp_habitat.poses import Intrinsics
from avp_habitat.sight.tables import reached_around
from avp_habitat.sight.visibility import heldout_points
from avp_habitat.simulators.base import Simulator
from avp_habitat.task.settings import TaskSettings

VIEWS = 20
"""Held-out views of a rollout."""
PITCH_DEG = 20.0
"""Their greatest pitch, either way."""
MIN_MEAN_DEPTH_M = 1.0
"""A view that sees no farther on average has its nose on a wall."""
HeldoutKind = Literal["standard", "observable"]
OBSERVABLE_PITCH_DEG = 45.0
"""Greatest pitch of the observable ones, so that ceilings and floors count."""
PLACES = 100
"""What can be seen of a scene is looked for from so many places all over the navigable area."""
LEAST_SHARE = 0.02
"""A point is observable where at least this share of the places see it. With one place as the limit, more places would
always find more, through ever smaller gaps."""
SHOWN = 0.95
"""Share of an observable view's pixels that must be observable."""

_TRIES, _STRIDE = 2000, 2
_CAMERA = Intrinsics.from_hfov(32, 24, hfov_deg=90.0)


def heldout_seed(scene_digest: str) -> int:
    """The fixed seed of a scene's held-out views, from the digest of its content."""
    return int(scene_digest[:16], 16)


def heldout_poses(simulator: Simulator, *, sensor_height_m: float, views: int = VIEWS) -> NDArray[np.float64]:
    """Poses uniform over the navigable area, any yaw, pitch within ±20°, that see at least 1 m far on average.

    Returns:
        `(views, 4, 4)` habitat camera_to_world; the same for the same scene, always.

    Raises:
        SceneError: the scene is too narrow for such views.
    """
    rng = np.random.default_rng(heldout_seed(simulator.scene_digest))
    drawn = (pose for pose, _ in _drawn(simulator, rng, sensor_height_m, PITCH_DEG))
    return _first(drawn, views, simulator, f"see at least {MIN_MEAN_DEPTH_M} m far on average; is the scene in metres?")


def observable_poses(simulator: Simulator, settings: TaskSettings, *, views: int = VIEWS) -> NDArray[np.float64]:
    """The same with pitches within ±45°, of views whose pixels the navigable area can show.

    Of a view `SHOWN` of the pixels show a surface that the task's camera sees from `lookouts_needed` of the lookouts.

    Raises:
        SceneError: the scene is too narrow for such views.
    """
    # Not those of the other kind with more pitch.
    rng = np.random.default_rng([heldout_seed(simulator.scene_digest), 1])
    eyes = lookouts(simulator, settings)

    def shown(pose: NDArray[np.float64], depth: NDArray[np.floating]) -> bool:
        points = heldout_points([(depth, pose)], _CAMERA, stride=_STRIDE).xyz
        pairs = np.argwhere(in_reach(points[None] - eyes[:, None], settings))
        seen = reached_around(simulator, eyes, points, pairs, tolerance_m=settings.tolerance_m)
        times = np.bincount(pairs[seen, 1], minlength=len(points))
        # Pixels that show no surface count, and are not shown from anywhere.
        return bool((times >= lookouts_needed(len(eyes))).sum() >= SHOWN * depth[::_STRIDE, ::_STRIDE].size)

    drawn = _drawn(simulator, rng, settings.sensor_height_m, OBSERVABLE_PITCH_DEG)
    chosen = (pose for pose, depth in drawn if shown(pose, depth))
    return _first(chosen, views, simulator, "show what can be seen from elsewhere too")


def chosen_poses(kind: HeldoutKind, simulator: Simulator, settings: TaskSettings, views: int) -> NDArray[np.float64]:
    """The held-out views of a kind."""
    if kind == "observable":
        return observable_poses(simulator, settings, views=views)
    return heldout_poses(simulator, sensor_height_m=settings.sensor_height_m, views=views)


def lookouts(simulator: Simulator, settings: TaskSettings, places: int = PLACES) -> NDArray[np.float64]:
    """`(places, 3)` the camera's places, metres, all over the navigable area; fewer where that has fewer cells."""
    centres = simulator.area.centres
    feet = centres[np.unique(np.linspace(0, len(centres) - 1, places).astype(int))]
    return feet + [0.0, settings.sensor_height_m, 0.0]


def lookouts_needed(count: int) -> int:
    """From so many of `count` lookouts an observable point is seen."""
    return max(1, round(LEAST_SHARE * count))


def in_reach(offset: NDArray[np.floating], settings: TaskSettings) -> NDArray[np.bool_]:
    """`(…)` whether the task's camera, turned to any yaw, could show what lies `(…, 3)` metres from it.

    Range and elevation limit it: half its image's height beyond the greatest pitch. What lies between is not asked.
    """
    camera = settings.intrinsics
    steepest = min(np.radians(settings.pitch_limit_deg) + np.arctan(camera.height / 2 / camera.fy), np.pi / 2)
    distance = np.linalg.norm(offset, axis=-1)
    return (distance <= settings.max_range_m) & (np.abs(offset[..., 1]) <= np.sin(steepest) * distance)


def _drawn(
    simulator: Simulator, rng: np.random.Generator, sensor_height_m: float, most_pitch_deg: float
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.floating]]]:
    """`(4, 4)` poses that see far enough, each with the depth that `_CAMERA` has there; at most so many are tried."""
    for _ in range(_TRIES):
        position = simulator.area.random_points(rng, 1) + np.array([0.0, sensor_height_m, 0.0])
        yaw, pitch = rng.uniform(-np.pi, np.pi, 1), np.radians(rng.uniform(-most_pitch_deg, most_pitch_deg, 1))
        pose = poses.camera_to_world(position, yaw=yaw, pitch=pitch)
        depth = simulator.render(pose, _CAMERA, rgb=False).depth
        if depth.mean() >= MIN_MEAN_DEPTH_M:
            yield pose[0], depth[0]


def _first(drawn: Iterator[NDArray[np.float64]], views: int, simulator: Simulator, wanted: str) -> NDArray[np.float64]:
    found = list(itertools.islice(drawn, views))
    if len(found) < views:
        raise SceneError(f"{simulator.scene}: found only {len(found)} of {views} held-out views that {wanted}")
    return np.stack(found) if found else np.zeros((0, 4, 4))
