"""The frames of one or several rollouts of a scene: merged, chosen, verified, and the points that they show."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from avp_habitat.errors import RolloutError
from avp_habitat.poses import Intrinsics, pixel_directions, y_up_to_z_up
from avp_habitat.rollout.format import Rollout, View, read_rollout
from avp_habitat.rollout.images import check_png_contents, read_depth, read_rgb

Order = Literal["steps", "spread", "random"]

MOST_VIEWS = 24
"""Points come from so many pictures at most, however long the rollout is."""
PIXELS_PER_VIEW = 4800
"""About so many pixels of each are used."""
AUTOMATIC_BYTES = 1 << 28
"""Pictures of up to this size together are decoded without being asked: about 600 views of 640x480, seven seconds."""

_SEED = 0
_BOX_PERCENTILES = (0.2, 99.8)
_THREADS = 2


def read_merged(first: Path, others: Sequence[Path] = ()) -> Rollout:
    """Read rollouts (folders or `rollout.json`) of one scene that were captured with one camera.

    Returns:
        The first, with the frames of all, one rollout after another. The held-out views are the first one's: they
        follow from the scene, so the others hold the same.

    Raises:
        RolloutError: one of them is faulty or named twice, or shows another scene or through another camera.
    """
    rollouts = [read_rollout(first)]
    for path in others:
        rollout = read_rollout(path)
        if any(rollout.folder.resolve() == known.folder.resolve() for known in rollouts):
            raise RolloutError(f"{rollout.folder}: expected each rollout once, it is named twice")
        _check_scene(rollouts[0], rollout)
        _check_camera(rollouts[0], rollout)
        rollouts.append(rollout)
    return replace(rollouts[0], frames=[view for rollout in rollouts for view in rollout.frames])


def _check_scene(first: Rollout, other: Rollout) -> None:
    (one, one_lies), (two, two_lies) = _scene(first), _scene(other)
    if one != two:
        raise RolloutError(
            f"{other.folder}: captured in a scene of sha256 {two}, but {first.folder} in a scene of sha256 {one}; only "
            "rollouts of one scene can be merged"
        )
    if one_lies != two_lies:
        raise RolloutError(
            f"{other.folder}: its scene lies at {two_lies}, that of {first.folder} at {one_lies}; collect one of them "
            "again, with the same --up"
        )


def _scene(rollout: Rollout) -> tuple[str, str]:
    """The digest of its scene, and how the scene's file lies in the rollout's world."""
    scene: Any = rollout.meta.get("scene")
    if not isinstance(scene, dict) or not isinstance(scene.get("sha256"), str):
        raise RolloutError(
            f"{rollout.folder / 'rollout.json'}: expected scene.sha256, which tells scenes apart when rollouts are "
            f"merged, found scene {scene!r}"
        )
    origin = scene.get("origin") or [0.0, 0.0, 0.0]
    return scene["sha256"], f"origin {origin} with {scene.get('up') or 'the usual axis'} up"


def _check_camera(first: Rollout, other: Rollout) -> None:
    one, two = first.intrinsics, other.intrinsics
    if not np.allclose(astuple(one), astuple(two), rtol=1e-6, atol=0):
        raise RolloutError(
            f"{other.folder / 'rollout.json'}: expected the camera of {first.folder / 'rollout.json'}, {one}, found "
            f"{two}; only rollouts of one camera can be merged (`python -m avp_habitat.collect … --width {one.width} "
            f"--height {one.height}`)"
        )


def chosen_views(frames: Sequence[View], *, every: int = 1, max_views: int = 0, order: Order = "steps") -> list[View]:
    """Every n-th frame, and of these the first few in some order.

    Args:
        frames: in the order of the steps.
        every: n; the first frame is one of them.
        max_views: how many at most; 0 for all.
        order: `steps` as captured; `spread` so that each next view is the farthest from those before it (see
            `spread_order`); `random` in an order that is the same for every rollout of that length.

    Returns:
        Them in that order; in the order of the steps when nothing is left out, because training then sees them all.
    """
    thinned = list(frames[::every])
    if not 0 < max_views < len(thinned):
        return thinned
    if order == "steps":
        return thinned[:max_views]
    if order == "random":
        indices = np.random.default_rng(_SEED).permutation(len(thinned))[:max_views]
    else:
        indices = spread_order(np.stack([view.camera_to_world for view in thinned]), max_views)
    return [thinned[index] for index in indices]


def spread_order(poses: NDArray[np.floating], count: int) -> NDArray[np.intp]:
    """Indices of views that are far from each other: the first one, then always the farthest from all before it.

    Two views are as far apart as their camera centres, in metres, and their viewing directions, as unit vectors,
    together (the root of the sum of squares): turning by 60° counts like walking a metre. Farthest-point sampling,
    Gonzalez 1985, https://doi.org/10.1016/0304-3975(85)90224-5.

    Args:
        poses: `(n, 4, 4)` camera_to_world, habitat axes, metres.
        count: how many, at most n.

    Returns:
        `(count,)` indices.
    """
    # The third column points backwards; distances between directions are the same for their opposites.
    features = np.concatenate([poses[:, :3, 3], poses[:, :3, 2]], axis=1)
    indices = np.zeros(min(count, len(poses)), dtype=np.intp)
    nearest = np.full(len(poses), np.inf)
    for k in range(1, len(indices)):
        nearest = np.minimum(nearest, ((features - features[indices[k - 1]]) ** 2).sum(axis=1))
        nearest[indices[:k]] = -1
        indices[k] = nearest.argmax()
    return indices


def verify_pictures(views: Sequence[View], *, wanted: bool | None) -> None:
    """Decode the pictures and depth images, with every byte held to its checksum; shows progress when it takes long.

    A training decodes them all anyway, but ends in Pillow's traceback then. Unless it is said whether to, it is done
    when all of them together have at most `AUTOMATIC_BYTES`. 11 ms for a view of 640x480 on one core.

    Raises:
        RolloutError: a file is damaged; the text names it.
    """
    if wanted is None:
        wanted = sum(path.stat().st_size for view in views for path in (view.image, view.depth)) <= AUTOMATIC_BYTES
    if not wanted:
        return
    how = {"desc": "checking pictures", "unit": "view", "delay": 2, "leave": False, "disable": None}
    with ThreadPoolExecutor(_THREADS) as threads:
        for _ in tqdm(threads.map(_verify, views), total=len(views), **how):
            pass


def _verify(view: View) -> None:
    for path, read in ((view.image, read_rgb), (view.depth, read_depth)):
        check_png_contents(path)
        read(path)


@dataclass(frozen=True)
class SeenPoints:
    """Points on the surfaces of a scene."""

    xyz: NDArray[np.float32]
    """`(n, 3)` metres, Z up."""
    rgb: NDArray[np.uint8]
    """`(n, 3)` their colours; `(0, 3)` when not asked for."""


def seen_points(views: Sequence[View], intrinsics: Intrinsics, *, colours: bool) -> SeenPoints:
    """Back-project a grid of pixels of views that are evenly spread over the given ones, with colours if asked for.

    Raises:
        RolloutError: a picture cannot be decoded.
    """
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), MOST_VIEWS)).round().astype(int))
    stride = max(1, round((intrinsics.width * intrinsics.height / PIXELS_PER_VIEW) ** 0.5))
    grid = (slice(stride // 2, None, stride),) * 2
    directions = pixel_directions(intrinsics)[grid]
    points, rgb = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for view in (views[index] for index in chosen):
        depth = read_depth(view.depth)[grid]
        seen = depth > 0
        pose = view.camera_to_world
        points.append((directions[seen] * depth[seen, None]) @ pose[:3, :3].T + pose[:3, 3])
        if colours:
            rgb.append(read_rgb(view.image)[grid][seen])
    return SeenPoints(_z_up(np.concatenate(points)).astype(np.float32), np.concatenate(rgb))


def subset(points: SeenPoints, count: int) -> SeenPoints:
    """At most `count` coloured points, drawn at random; the same ones every time."""
    indices = np.random.default_rng(_SEED).permutation(len(points.xyz))[:count]
    return SeenPoints(points.xyz[indices], points.rgb[indices])


def scene_box(views: Sequence[View], points: SeenPoints, *, margin_m: float) -> NDArray[np.float64]:
    """The box that holds the cameras of at least one view and what they saw, with a margin on every side.

    Far outliers (a glimpse through a window) do not stretch it.

    Returns:
        `(2, 3)` least and greatest corner, metres, Z up.
    """
    corners = _z_up(np.stack([view.camera_to_world[:3, 3] for view in views]))
    if len(points.xyz):
        corners = np.concatenate([corners, np.percentile(points.xyz, _BOX_PERCENTILES, axis=0)])
    return np.stack([corners.min(axis=0) - margin_m, corners.max(axis=0) + margin_m])


def _z_up(points: NDArray[np.floating]) -> NDArray[np.floating]:
    return points @ y_up_to_z_up(np.eye(4))[:3, :3].T
