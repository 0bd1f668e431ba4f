"""Finding the mistake that, undone, makes the depth agree: made with all frames, with a part, or with single ones."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_nerfstudio.check import hypotheses
from avp_nerfstudio.check.agreement import AGREEING_SHARE_OF_FRAME, LEAST_COMPARED, Agreement, Comparison, agrees
from avp_nerfstudio.check.cloud import Correction
from avp_nerfstudio.check.hypotheses import Cameras, Hypothesis, exchanged
from avp_nerfstudio.check.verdict import full_angles, has_no_roll, is_upright

Float = NDArray[np.floating]

_FINE_M = 0.005
_VERIFIED = 4
_STILL_JUDGED = 0.8
_WEIGHT_OF_CONTRADICTION = 10
_FACTORS = np.geomspace(0.5, 2.0, 41)
_UNITS = (0.001, 0.01, 0.1, 0.3048, 1 / 0.3048, 10.0, 100.0, 1000.0)


@dataclass(frozen=True)
class Walk:
    """What is known about the walk besides the poses."""

    pitch_limit_deg: float = 60.0
    """Greatest pitch of captured frames."""
    tilt_deg: float = 10.0
    """Pitch changes by multiples of it."""
    step_ratio: float | None = None
    """Longest step between captured frames over the length of a forward move, None where that is not known."""

    @classmethod
    def of(cls, meta: dict[str, Any], captured: Float) -> "Walk":
        """Read from `rollout.json`, as far as it says; `(n, 4, 4)` the captured poses."""
        actions = meta.get("actions")
        actions = actions if isinstance(actions, dict) else {}
        steps = np.linalg.norm(np.diff(captured[:, [0, 2], 3], axis=0), axis=1)
        forward = actions.get("forward_m")
        return cls(
            float(actions.get("pitch_limit_deg", cls.pitch_limit_deg)),
            float(actions.get("tilt_deg") or cls.tilt_deg),
            float(steps.max() / forward) if forward and len(steps) else None,
        )


@dataclass(frozen=True)
class Diagnosis:
    """What explains the disagreement."""

    key: str
    """Short name of the mistake."""
    cause: str
    """In words."""
    cameras: Cameras
    """With the mistake undone."""


def mistake_with_all(comparison: Comparison, given: Cameras, walk: Walk) -> Diagnosis | None:
    """The mistake made with all frames that, undone, makes all of them agree; None when there is none such."""
    return _best(comparison, given, _of_all(comparison, given, walk), walk)


def mistake_with_a_part(comparison: Comparison, given: Cameras, walk: Walk) -> Diagnosis | None:
    """The mistake made with the captured frames alone, or with the held-out views alone; None as above."""
    if not 0 < given.captured < len(given.poses):
        return None
    parts = (h for group in ("captured", "held-out") for h in _of_group(comparison, given, walk, group))
    return _best(comparison, given, parts, walk)


def _best(comparison: Comparison, given: Cameras, tried: Iterable[Hypothesis], walk: Walk) -> Diagnosis | None:
    scored = sorted(((comparison.quick(h.cameras), h) for h in tried), key=lambda pair: -pair[0])
    believed = comparison.full(given)
    least, judged = believed.score(), _judged(believed, given.kept)
    accepted = []
    for _, hypothesis in scored[:_VERIFIED]:
        kept = hypothesis.cameras.kept
        agreement = comparison.full(hypothesis.cameras)
        # Undoing a mistake makes more points agree; cameras that are torn apart have no contradictions either.
        together = _judged(agreement, kept) >= _STILL_JUDGED * judged
        if together and agrees(agreement, kept) and agreement.score(kept) > least:
            # The world may hang upside down and yet agree with itself: cameras of a walker stand upright.
            upright = float(is_upright(hypothesis.cameras.poses, limit_deg=walk.pitch_limit_deg).mean())
            accepted.append(((upright, agreement.score(kept)), hypothesis))
    if not accepted:
        return None
    best = max(accepted, key=lambda pair: pair[0])[1]
    return Diagnosis(best.key, best.cause, best.cameras)


def _judged(agreement: Agreement, kept: NDArray[np.bool_]) -> int:
    """How many of the kept frames share enough with others to be judged."""
    return int((agreement.per_frame(kept)[1] >= LEAST_COMPARED)[kept].sum())


def _of_all(comparison: Comparison, given: Cameras, walk: Walk) -> Iterator[Hypothesis]:
    yield from _of_group(comparison, given, walk, "all")
    yield from hypotheses.time_shifts(given)
    yield from hypotheses.swapped_intrinsics(given)
    yield _best_factor(comparison, lambda factor: hypotheses.focal_factor(given, factor), _FACTORS)


def _of_group(comparison: Comparison, given: Cameras, walk: Walk, group: str) -> Iterator[Hypothesis]:
    yield from hypotheses.conventions(given, group)
    yield from hypotheses.radians_taken_for_degrees(given, group)
    yield from _pitches(comparison, given, walk, group)
    yield _best_factor(
        comparison,
        lambda factor: hypotheses.scale_factor(given, factor, group, step_ratio=walk.step_ratio),
        (*_FACTORS, *_UNITS),
    )


def _best_factor(comparison: Comparison, undo: Callable[[float], Hypothesis], factors: Any) -> Hypothesis:
    """The best of a family with one number: the best of a list, then refined with a finer tolerance."""
    best = max(factors, key=lambda factor: comparison.quick(undo(factor).cameras))
    low, high = best / 1.036, best * 1.036
    for _ in range(3):
        tried = np.geomspace(low, high, 9)
        scores = [comparison.quick(undo(factor).cameras, tolerance_m=_FINE_M) for factor in tried]
        centre = int(np.argmax(scores))
        best, low, high = tried[centre], tried[max(centre - 1, 0)], tried[min(centre + 1, 8)]
    return undo(float(best))


def _pitches(comparison: Comparison, given: Cameras, walk: Walk, group: str) -> Iterator[Hypothesis]:
    """Degrees taken for radians: which of the possible pitches each camera had."""
    members = np.flatnonzero(given.select(group))
    if not has_no_roll(given.poses).all():
        return
    possible = hypotheses.pitches_from_degrees(given.poses[members], limit_deg=walk.pitch_limit_deg)
    pitch = full_angles(given.poses)[1].copy()
    unsettled = {}
    for frame, values in zip(members, possible, strict=True):
        on_grid = _on_tilt_grid(values, walk.tilt_deg)
        pitch[frame] = values[0] if on_grid is None else on_grid
        if on_grid is None:
            unsettled[int(frame)] = values
    settled = np.setdiff1d(np.arange(len(pitch)), np.array(list(unsettled), np.int64))
    undecided = _settle(comparison, given, pitch, settled, unsettled)
    if len(undecided) > len(members) / 2:
        return
    found = hypotheses.degrees_taken_for_radians(given, pitch, group)
    kept = given.kept & ~np.isin(np.arange(len(pitch)), undecided)
    yield replace(found, cameras=replace(found.cameras, kept=kept))


def _settle(
    comparison: Comparison, given: Cameras, pitch: Float, settled: NDArray[np.int64], unsettled: dict[int, Float]
) -> list[int]:
    """Decide the pitch of the frames that settled ones see, then of those that these see, and so on.

    Args:
        comparison: for what is tried.
        given: the cameras.
        pitch: `(n,)` radians; changed in place.
        settled: frames whose pitch is known.
        unsettled: the possible pitches of the others.

    Returns:
        The frames that no settled one sees.
    """
    open_frames = list(unsettled)
    while open_frames and len(settled):
        decided = []
        for frame in open_frames:
            best = _pitch_by_depth(comparison, given, pitch, frame, unsettled[frame], settled)
            if best is not None:
                pitch[frame] = best
                decided.append(frame)
        if not decided:
            break
        settled = np.append(settled, decided)
        open_frames = [frame for frame in open_frames if frame not in decided]
    return open_frames


def _on_tilt_grid(values: Float, tilt_deg: float) -> float | None:
    """The pitch that is a multiple of the tilt, as those of the captured frames are."""
    turns = np.degrees(values) / tilt_deg
    distance = np.abs(turns - turns.round())
    best = int(np.argmin(distance))
    return float(values[best]) if distance[best] * tilt_deg < 1e-3 else None


def _pitch_by_depth(
    comparison: Comparison, given: Cameras, pitch: Float, frame: int, values: Float, settled: NDArray[np.int64]
) -> float | None:
    """The pitch, of the possible ones, with which settled frames agree; None where they see too little to say."""
    scores = []
    for value in values:
        tried = pitch.copy()
        tried[frame] = value
        cameras = replace(given, poses=hypotheses.with_pitch(given.poses, tried))
        found = comparison.some(cameras, [frame], settled)
        # The right pitch has hardly any contradiction; a wrong one may have more points in view, and agree with some.
        scores.append(int(found.agreeing.sum()) - _WEIGHT_OF_CONTRADICTION * int(found.contradicting.sum()))
    best = int(np.argmax(scores))
    return float(values[best]) if scores[best] >= LEAST_COMPARED else None


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
