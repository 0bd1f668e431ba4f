"""Several rollouts of one scene as one."""

from collections.abc import Sequence
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import RolloutError
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout.format import Rollout, View, read_rollout

Order = Literal["steps", "spread", "random"]

_SEED = 0


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


_SHOWN_DIGITS = 12


def read_merged(first: Path, others: Sequence[Path] = ()) -> Rollout:
    """Read rollouts of one scene that were captured with one camera.

    Args:
        first: a rollout's folder or its `rollout.json`.
        others: more of them.

    Returns:
        The first, with the frames of all, one rollout after another. The held-out views are the first one's: they
        follow from the scene, so the others hold the same.

    Raises:
        RolloutError: one of them is faulty or named twice, or shows another scene or through another camera.
    """
    rollouts = [read_rollout(first)]
    for path in others:
        rollout = read_rollout(path)
        _check_new(rollout, rollouts)
        _check_scene(rollouts[0], rollout)
        _check_camera(rollouts[0], rollout)
        rollouts.append(rollout)
    return replace(rollouts[0], frames=[view for rollout in rollouts for view in rollout.frames])


def _check_new(rollout: Rollout, known: Sequence[Rollout]) -> None:
    folder = rollout.folder.resolve()
    for other in known:
        if other.folder.resolve() == folder:
            same = "" if other.folder == rollout.folder else f" (it is {other.folder})"
            raise RolloutError(f"{rollout.folder}: expected each rollout once, it is named twice{same}")


def _check_scene(first: Rollout, other: Rollout) -> None:
    one, two = (_scene(rollout) for rollout in (first, other))
    if one["sha256"] != two["sha256"]:
        raise RolloutError(
            f"{other.folder}: captured in the scene {_scene_text(two)}, but {first.folder} in {_scene_text(one)}; "
            "only rollouts of one scene can be merged"
        )
    if _frame(one) != _frame(two):
        raise RolloutError(
            f"{other.folder}: its scene lies at {_frame_text(two)}, that of {first.folder} at {_frame_text(one)}; "
            "collect one of them again, with the same --up"
        )


def _scene(rollout: Rollout) -> dict[str, Any]:
    scene = rollout.meta.get("scene")
    if not isinstance(scene, dict) or not isinstance(scene.get("sha256"), str):
        raise RolloutError(
            f"{rollout.folder / 'rollout.json'}: expected scene.sha256, which tells scenes apart when rollouts are "
            f"merged, found scene {scene!r}"
        )
    return scene


def _frame(scene: dict[str, Any]) -> tuple[list[float], str | None]:
    """How a scene's file lies in the rollout's world."""
    return scene.get("origin") or [0.0, 0.0, 0.0], scene.get("up")


def _frame_text(scene: dict[str, Any]) -> str:
    origin, up = _frame(scene)
    return f"origin {origin} with {up or 'the usual axis'} up"


def _scene_text(scene: dict[str, Any]) -> str:
    return f"{scene.get('name', 'without a name')!r} (sha256 {scene['sha256'][:_SHOWN_DIGITS]}…)"


def _check_camera(first: Rollout, other: Rollout) -> None:
    one, two = first.intrinsics, other.intrinsics
    if not np.allclose(astuple(one), astuple(two), rtol=1e-6, atol=0):
        raise RolloutError(
            f"{other.folder / 'rollout.json'}: pictures of {_camera_text(two)}, but {first.folder / 'rollout.json'} "
            f"has {_camera_text(one)}; only rollouts of one camera can be merged: collect one of them again (`python "
            f"-m avp_habitat.collect … --width {one.width} --height {one.height}`), or train on one alone"
        )


def _camera_text(camera: Intrinsics) -> str:
    return (
        f"{camera.width}x{camera.height} pixels with focal lengths {camera.fx:.6g}, {camera.fy:.6g} "
        f"and centre {camera.cx:.6g}, {camera.cy:.6g}"
    )
