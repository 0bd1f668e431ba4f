"""The verdicts on depth and poses, with the mistake that explains a disagreement."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from avp_habitat.rollout.format import Rollout
from avp_habitat.scenes.loader import Scene
from avp_nerfstudio.check import hypotheses
from avp_nerfstudio.check.agreement import (
    AGREEING_SHARE,
    AGREEING_SHARE_OF_FRAME,
    LEAST_COMPARED,
    Agreement,
    Comparison,
    agrees,
    bad_frames,
    overlap,
)
from avp_nerfstudio.check.cloud import PARTNERS, Correction, mesh_distance, register
from avp_nerfstudio.check.depth_maps import DepthMaps, load_depth_maps
from avp_nerfstudio.check.hypotheses import Cameras
from avp_nerfstudio.check.mistakes import Diagnosis, Walk, frame_mistake, mistake_with_a_part, mistake_with_all
from avp_nerfstudio.check.verdict import Verdict

CORRECTION_M = 0.005
"""Greatest shift by which ICP may still improve a frame; 0 in all correct rollouts that were tried."""
CORRECTION_DEG = 0.2
"""Greatest rotation by which it may."""
SETTLED_SHARE = 0.85
"""Single frames that agree less than their limit, but so much, are right where ICP leaves them: in correct rollouts of
160x120, where leaves and legs lie between the pixels, views had 0.89 to 0.98. No pose that is off by 2 cm or half a
degree was left so in the rollouts that were tried, and a shift along what the surfaces do not fix changes no depth."""
PROVED_SHARE = 0.95
"""What also agrees so much, and has surfaces that fix all six directions, no other check calls wrong."""
_LEAST_GAIN_M = 0.0005
_REGISTERED = 100
_NAMED = 5
_FEW = 4


@dataclass(frozen=True)
class Geometry:
    """What the depth says about the poses."""

    verdicts: list[Verdict]
    """Depth agreement, ICP correction, and mesh distance where a mesh was given."""
    maps: DepthMaps
    """The depth, thinned."""
    cameras: Cameras
    """The rollout's own."""
    bad: NDArray[np.bool_]
    """`(n,)` frames that disagree."""
    proved: NDArray[np.bool_]
    """`(n,)` frames whose poses are right: `PROVED_SHARE`."""
    diagnosis: Diagnosis | None
    """What explains the disagreement, where that is known."""


def cameras_of(rollout: Rollout) -> Cameras:
    """The cameras of all frames of a rollout, held-out views last."""
    views = rollout.frames + rollout.heldout
    poses = np.stack([view.camera_to_world for view in views])
    return Cameras(poses, rollout.intrinsics, len(rollout.frames), np.ones(len(views), bool))


def name_of(cameras: Cameras, frame: int) -> str:
    """What to call a frame: its number among the captured frames, or among the held-out views."""
    captured = cameras.captured
    return f"frame {frame}" if frame < captured else f"held-out view {frame - captured}"


def check_geometry(
    rollout: Rollout,
    scene: Scene | None = None,
    *,
    maps: DepthMaps | None = None,
    explain: bool = True,
    progress: Callable[[], object] = lambda: None,
) -> Geometry:
    """Compare all depth pictures of a rollout with each other and, if given, with the scene.

    Args:
        rollout: at least one frame.
        scene: the mesh it was captured in.
        maps: its depth, where it was read already.
        explain: also look for the mistake behind a disagreement, and for mistakes that would not show.
        progress: called after each picture that was read.

    Raises:
        RolloutError: a depth picture cannot be decoded.
    """
    given = cameras_of(rollout)
    maps = maps or load_depth_maps(rollout.frames + rollout.heldout, rollout.intrinsics, progress=progress)
    comparison = Comparison(maps)
    agreement = comparison.full(given)
    bad = bad_frames(agreement, given.kept)
    corrections = _corrections(comparison, given, agreement, bad)
    proved = _left_by_icp(agreement, given, corrections, share=PROVED_SHARE, directions=6)
    if bad.sum() <= _FEW:
        bad &= ~_left_by_icp(agreement, given, corrections, share=SETTLED_SHARE, directions=1)
    passed = not (agreement.share(given.kept) < AGREEING_SHARE or bad.any())
    diagnosis = None if passed or not explain else _diagnose(comparison, given, rollout, bad, corrections)
    hidden = _hidden_mistakes(comparison, given) if passed and explain else []
    verdicts = [
        _agreement_verdict(given, agreement, bad, passed, hidden),
        _correction_verdict(given, corrections),
    ]
    if scene is not None:
        named = rollout.meta.get("scene")
        measured = mesh_distance(maps, given, scene, named=named.get("sha256") if isinstance(named, dict) else None)
        verdicts.append(measured.verdict)
        bad = bad | measured.bad
    return Geometry([_with_cause(v, diagnosis, given, bad) for v in verdicts], maps, given, bad, proved, diagnosis)


def _diagnose(
    comparison: Comparison,
    given: Cameras,
    rollout: Rollout,
    bad: NDArray[np.bool_],
    corrections: dict[int, Correction | None],
) -> Diagnosis | None:
    walk = Walk.of(rollout.meta, given.poses[: given.captured])
    numbers = np.flatnonzero(bad)
    found = mistake_with_all(comparison, given, walk)
    of_heldout = len(numbers) > 1 and bool((numbers >= given.captured).all())
    if found is None and (len(numbers) > _FEW or of_heldout):
        found = mistake_with_a_part(comparison, given, walk)
    if found is None and 0 < len(numbers) <= max(_FEW, 0.25 * len(bad)):
        found = frame_mistake(comparison, given, numbers, corrections=corrections, name=partial(name_of, given))
    return found


def _left_by_icp(
    agreement: Agreement, given: Cameras, corrections: dict[int, Correction | None], *, share: float, directions: int
) -> NDArray[np.bool_]:
    """`(n,)` frames that ICP, with so many directions fixed, does not move, and of which such a share agrees."""
    agreeing, compared = agreement.per_frame(given.kept)
    left = np.zeros(len(given.poses), bool)
    for frame, correction in corrections.items():
        left[frame] = correction is not None and correction.fixed_directions >= directions and _small(correction)
    return left & (compared >= LEAST_COMPARED) & (agreeing >= share)


def _small(correction: Correction) -> bool:
    return correction.distance_m <= CORRECTION_M and correction.rotation_deg <= CORRECTION_DEG


def _corrections(
    comparison: Comparison, given: Cameras, agreement: Agreement, bad: NDArray[np.bool_]
) -> dict[int, Correction | None]:
    """What ICP would do with each frame that is looked at; None where too little of it is seen by others."""
    n = len(given.poses)
    table = overlap(agreement, n) * ~bad
    spread = np.linspace(0, n - 1, min(n, _REGISTERED)).round().astype(int)
    found: dict[int, Correction | None] = {}
    for frame in np.union1d(spread, np.flatnonzero(bad)[:_REGISTERED]):
        partners = np.argsort(-table[frame], kind="stable")[:PARTNERS]
        partners = partners[table[frame, partners] > 0]
        found[int(frame)] = _correction(comparison, given, int(frame), partners, far=bool(bad[frame]))
    return found


def _correction(
    comparison: Comparison, given: Cameras, frame: int, partners: NDArray[np.int64], *, far: bool
) -> Correction | None:
    """ICP's correction where it makes the frame agree better; else none, whatever ICP says."""
    if not len(partners):
        return None
    # What is far off for another reason than its pose, as leaves between the pixels, can still be held to what is near.
    correction = register(comparison.maps, given, frame, partners, far=far)
    if correction is None and far:
        correction = register(comparison.maps, given, frame, partners, far=False)
    if correction is None:
        return None
    poses = given.poses.copy()
    poses[frame] = correction.camera_to_world
    before, after = (comparison.some(c, [frame], partners).cost_m() for c in (given, replace(given, poses=poses)))
    if before - after >= _LEAST_GAIN_M:
        return correction
    return Correction(np.zeros(3), 0.0, given.poses[frame], correction.fixed_directions)


def _agreement_verdict(
    given: Cameras, agreement: Agreement, bad: NDArray[np.bool_], passed: bool, hidden: list[str]
) -> Verdict:
    share, compared = agreement.per_frame(given.kept)
    judged = compared >= LEAST_COMPARED
    figures = {
        "agreeing_2cm_percent": 100 * agreement.share(),
        "compared_points": float(agreement.compared()),
        "mean_difference_mm": 1000 * agreement.mean_deviation_m(),
        "unjudged_frames": float((~judged).sum()),
        "disagreeing_frames": float(bad.sum()),
    }
    if not judged.any():
        return Verdict(
            "depth agreement", True, "nothing is seen in two pictures: poses and depth could not be compared", figures
        )
    worst = int(np.argmin(np.where(judged, share, np.inf)))
    figures["worst_frame_percent"] = 100 * float(share[worst])
    text = (
        f"{100 * agreement.share():.2f} % of {agreement.compared()} points seen twice agree within 2 cm "
        f"(limit {100 * AGREEING_SHARE} %); worst is {name_of(given, worst)} with {100 * share[worst]:.1f} % "
        f"(limit {100 * AGREEING_SHARE_OF_FRAME:.0f} %, or {100 * SETTLED_SHARE:.0f} % where ICP finds no better place)"
    )
    if hidden:
        text += f"; these views cannot show {', '.join(hidden)}"
    return Verdict("depth agreement", passed, text, figures)


def _hidden_mistakes(comparison: Comparison, given: Cameras) -> list[str]:
    """Mistakes that would agree as well, because of how the cameras stand: turning in place hides the scale."""
    tried = {
        "a scale that is wrong by 10 %": [hypotheses.scale_factor(given, 1.1)],
        "a focal length that is wrong by 3 %": [hypotheses.focal_factor(given, 1.03)],
        "a time shift of one frame": list(hypotheses.time_shifts(given))[:1],
        "a wrong convention of the matrices": list(hypotheses.conventions(given, "all")),
    }
    found = []
    for text, wrong in tried.items():
        changed = [h for h in wrong if _differ(h.cameras, given)]
        if not changed or any(agrees(comparison.full(h.cameras), h.cameras.kept) for h in changed):
            found.append(text)
    return found


def _differ(a: Cameras, b: Cameras) -> bool:
    """Whether cameras differ in more than a shift of the whole world."""
    shifted = a.poses.copy()
    shifted[:, :3, 3] += b.poses[0, :3, 3] - a.poses[0, :3, 3]
    return a.intrinsics != b.intrinsics or float(np.abs(shifted - b.poses).max()) > 1e-4


def _correction_verdict(given: Cameras, corrections: dict[int, Correction | None]) -> Verdict:
    found = {frame: c for frame, c in corrections.items() if c is not None}
    if not found:
        return Verdict("ICP correction", True, "no frame could be registered to others")
    worst = max(found, key=lambda frame: max(found[frame].distance_m / CORRECTION_M, found[frame].rotation_deg))
    shift, turn = found[worst].distance_m, found[worst].rotation_deg
    wrong = [f for f, c in found.items() if not _small(c)]
    text = (
        f"ICP would improve {len(wrong)} of {len(found)} frames by more than {1000 * CORRECTION_M:.0f} mm or "
        f"{CORRECTION_DEG} degrees (limit 0)"
    )
    if wrong:
        text += f"; most {name_of(given, worst)}, by {1000 * shift:.0f} mm and {turn:.2f} degrees"
    figures = {
        "largest_shift_mm": 1000 * shift,
        "largest_rotation_deg": turn,
        "improvable_frames": float(len(wrong)),
        "registered_frames": float(len(found)),
    }
    return Verdict("ICP correction", not wrong, text, figures)


def _with_cause(verdict: Verdict, diagnosis: Diagnosis | None, given: Cameras, bad: NDArray[np.bool_]) -> Verdict:
    if verdict.passed or verdict.cause:
        return verdict
    if diagnosis is not None:
        return replace(verdict, cause=diagnosis.cause)
    names = [name_of(given, int(frame)) for frame in np.flatnonzero(bad)]
    listed = ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
    if verdict.name == "mesh distance":
        return replace(verdict, cause=f"the world of the poses is not that of the mesh; far from it: {listed}")
    return replace(verdict, cause=f"none of the known mistakes explains it; disagreeing: {listed or 'no single frame'}")
