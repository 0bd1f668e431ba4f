"""Finding the mistake made with single frames: an exchange, or a pose that is a little off."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from avp_nerfstudio.check.comparison import AGREEING_SHARE_OF_FRAME, LEAST_COMPARED, Comparison, agrees
from avp_nerfstudio.check.global_mistakes import Diagnosis
from avp_nerfstudio.check.hypotheses import Cameras, exchanged
from avp_nerfstudio.check.registration import Correction

_MOST_EXCHANGED = 12
_MOST_NAMED = 8

Names = Callable[[int], str]


def frame_mistake(
    comparison: Comparison,
    given: Cameras,
    bad: NDArray[np.int64],
    *,
    corrections: dict[int, Correction | None],
    name: Names,
) -> Diagnosis:
    """Say what is the matter with a few frames while all others agree.

    Args:
        comparison: for what is tried.
        given: the cameras.
        bad: numbers of the frames that disagree, at least one.
        corrections: what ICP would do with each of them.
        name: what to call a frame.
    """
    others = np.setdiff1d(np.arange(len(given.poses)), bad)
    for a, b in _exchanges(given, bad):
        cameras = exchanged(given, a, b)
        if _both_agree(comparison, cameras, a, b, others) and agrees(comparison.full(cameras), given.kept):
            return Diagnosis("exchanged", f"the poses of {name(a)} and {name(b)} are exchanged", cameras)
    return _off(given, bad, corrections, name)


def _exchanges(given: Cameras, bad: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Pairs of frames that may have been exchanged; a single bad frame with any other."""
    if len(bad) == 1:
        first = int(bad[0])
        yield from ((min(first, b), max(first, b)) for b in range(len(given.poses)) if b != first)
    elif len(bad) <= _MOST_EXCHANGED:
        yield from combinations(sorted(int(frame) for frame in bad), 2)


def _both_agree(comparison: Comparison, cameras: Cameras, a: int, b: int, others: NDArray[np.int64]) -> bool:
    for frame in (a, b):
        found = comparison.some(cameras, [frame], others)
        if found.compared() < LEAST_COMPARED or found.share() < AGREEING_SHARE_OF_FRAME:
            return False
    return True


def _off(given: Cameras, bad: NDArray[np.int64], corrections: dict[int, Correction | None], name: Names) -> Diagnosis:
    parts, poses = [], given.poses.copy()
    for frame in map(int, bad[:_MOST_NAMED]):
        correction = corrections.get(frame)
        if correction is None or not correction.distance_m + correction.rotation_deg:
            parts.append(f"{name(frame)} does not fit the others")
            continue
        poses[frame] = correction.camera_to_world
        x, y, z = -1000 * correction.shift_m
        parts.append(
            f"the pose of {name(frame)} is off by {1000 * correction.distance_m:.0f} mm (x {x:+.0f}, y {y:+.0f}, "
            f"z {z:+.0f}) and {correction.rotation_deg:.1f} degrees"
        )
    more = len(bad) - _MOST_NAMED
    text = "; ".join(parts) + (f"; and {more} more" if more > 0 else "")
    return Diagnosis("pose-off", f"{text}; all other frames agree", replace(given, poses=poses))
