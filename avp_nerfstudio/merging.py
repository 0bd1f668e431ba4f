"""Several rollouts of one scene as one."""

from collections.abc import Sequence
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np

from avp_habitat.errors import RolloutError
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout import Rollout, read_rollout

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
