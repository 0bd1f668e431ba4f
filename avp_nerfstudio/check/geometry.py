"""The verdicts on depth and poses, with the mistake that explains a disagreement."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from avp_habitat.rollout.format import Rollout
from avp_habitat.scenes.loader import Scene
from avp_nerfstudio.check import Verdict, mistakes
from avp_nerfstudio.check.agreement import (
    AGREEING_SHARE,
    AGREEING_SHARE_OF_FRAME,
    LEAST_COMPARED,
    Agreement,
    Cameras,
    Comparison,
    agrees,
    bad_frames,
    overlap,
)
from avp_nerfstudio.check.depth_maps import DepthMaps, load_depth_maps
from avp_nerfstudio.check.mistakes import Mistake, Walk, find_mistake
from avp_nerfstudio.check.surfaces import Correction, mesh_distance, register

Mask = NDArray[np.bool_]
Corrections = dict[int, Correction | None]
"""What ICP would do with the frames that were looked at; None where too little of a frame is seen by others."""

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
_REGISTERED, _PARTNERS = 100, 8
_FEW = 4
_MOST_EXCHANGED = 12
_NAMED, _MOST_NAMED = 5, 8


@dataclass(frozen=True)
class Geometry:
    """What the depth says about the poses."""

    verdicts: list[Verdict]
    """Depth agreement, ICP correction, and mesh distance where a mesh was given."""
    maps: DepthMaps
    """The depth, thinned."""
    cameras: Cameras
    """The rollout's own."""
    bad: Mask
    """`(n,)` frames that disagree."""
    proved: Mask
    """`(n,)` frames whose poses are right: `PROVED_SHARE`."""
    diagnosis: Mistake | None
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
    passed = not (agreement.share() < AGREEING_SHARE or bad.any())
    diagnosis = None if passed or not explain else _diagnose(comparison, given, rollout, bad, corrections)
    hidden = _hidden_mistakes(comparison, given) if passed and explain else []
    verdicts = [_agreement_verdict(given, agreement, bad, passed, hidden), _correction_verdict(given, corrections)]
    if scene is not None:
        named = rollout.meta.get("scene")
        digest = named.get("sha256") if isinstance(named, dict) else None
        verdict, far = mesh_distance(maps, given, scene, named=digest)
        verdicts.append(verdict)
        bad = bad | far
    return Geometry([_with_cause(v, diagnosis, given, bad) for v in verdicts], maps, given, bad, proved, diagnosis)


def _diagnose(
    comparison: Comparison, given: Cameras, rollout: Rollout, bad: Mask, corrections: Corrections
) -> Mistake | None:
    walk = Walk.of(rollout.meta, given.poses[: given.captured])
    count, captured = int(bad.sum()), given.captured
    found = find_mistake(comparison, given, walk)
    of_heldout = count > 1 and not bad[:captured].any()
    if found is None and 0 < captured < len(bad) and (count > _FEW or of_heldout):
        found = find_mistake(comparison, given, walk, ("captured", "held-out"))
    if found is None and 0 < count <= max(_FEW, 0.25 * len(bad)):
        found = _exchanged(comparison, given, bad) or _off(given, np.flatnonzero(bad).tolist(), corrections)
    return found


def _exchanged(comparison: Comparison, given: Cameras, bad: Mask) -> Mistake | None:
    """Two poses, one of them of a frame that disagrees, with which all frames agree once they are exchanged."""
    others = np.flatnonzero(~bad)
    for pair in _pairs(np.flatnonzero(bad).tolist(), len(bad)):
        poses = given.poses.copy()
        poses[list(pair)] = given.poses[list(reversed(pair))]
        cameras = replace(given, poses=poses)
        found = [comparison.some(cameras, frame, others) for frame in pair]
        both = all(one.compared() >= LEAST_COMPARED and one.share() >= AGREEING_SHARE_OF_FRAME for one in found)
        if both and agrees(comparison.full(cameras), given.kept):
            names = " and ".join(name_of(given, frame) for frame in pair)
            return Mistake(f"the poses of {names} are exchanged", cameras)
    return None


def _pairs(bad: list[int], count: int) -> Iterator[tuple[int, int]]:
    """Pairs of frames that may have been exchanged; a single bad frame with any other."""
    if len(bad) == 1:
        yield from ((min(bad[0], other), max(bad[0], other)) for other in range(count) if other != bad[0])
    elif len(bad) <= _MOST_EXCHANGED:
        yield from combinations(bad, 2)


def _off(given: Cameras, bad: list[int], corrections: Corrections) -> Mistake:
    parts, poses = [], given.poses.copy()
    for frame in bad[:_MOST_NAMED]:
        name, correction = name_of(given, frame), corrections.get(frame)
        if correction is None or not correction.distance_m + correction.rotation_deg:
            parts.append(f"{name} does not fit the others")
            continue
        poses[frame] = correction.camera_to_world
        x, y, z = -1000 * correction.shift_m
        parts.append(
            f"the pose of {name} is off by {1000 * correction.distance_m:.0f} mm (x {x:+.0f}, y {y:+.0f}, z {z:+.0f}) "
            f"and {correction.rotation_deg:.1f} degrees"
        )
    more = len(bad) - _MOST_NAMED
    text = "; ".join(parts) + (f"; and {more} more" if more > 0 else "")
    return Mistake(f"{text}; all other frames agree", replace(given, poses=poses))


def _left_by_icp(
    agreement: Agreement, given: Cameras, corrections: Corrections, *, share: float, directions: int
) -> Mask:
    """`(n,)` frames that ICP, with so many directions fixed, does not move, and of which such a share agrees."""
    agreeing, compared = agreement.per_frame(given.kept)
    left = np.zeros(len(given.poses), bool)
    for frame, correction in corrections.items():
        left[frame] = correction is not None and correction.fixed_directions >= directions and _small(correction)
    return left & (compared >= LEAST_COMPARED) & (agreeing >= share)


def _small(correction: Correction) -> bool:
    return correction.distance_m <= CORRECTION_M and correction.rotation_deg <= CORRECTION_DEG


def _corrections(comparison: Comparison, given: Cameras, agreement: Agreement, bad: Mask) -> Corrections:
    n = len(given.poses)
    table = overlap(agreement, n) * ~bad
    spread = np.linspace(0, n - 1, min(n, _REGISTERED)).round().astype(int)
    found: Corrections = {}
    for frame in np.union1d(spread, np.flatnonzero(bad)[:_REGISTERED]).tolist():
        partners = np.argsort(-table[frame], kind="stable")[:_PARTNERS]
        partners = partners[table[frame, partners] > 0]
        found[frame] = _correction(comparison, given, frame, partners, far=bool(bad[frame])) if len(partners) else None
    return found


def _correction(
    comparison: Comparison, given: Cameras, frame: int, partners: NDArray[np.int64], *, far: bool
) -> Correction | None:
    """ICP's correction where it makes the frame agree better; else none, whatever ICP says."""
    correction = register(comparison.maps, given, frame, partners, far=far)
    if correction is None and far:
        # What is far off for another reason than its pose, as leaves between the pixels, can still be held to what is
        # near.
        correction = register(comparison.maps, given, frame, partners, far=False)
    if correction is None:
        return None
    poses = given.poses.copy()
    poses[frame] = correction.camera_to_world
    before, after = (comparison.some(c, frame, partners).cost_m() for c in (given, replace(given, poses=poses)))
    if before - after >= _LEAST_GAIN_M:
        return correction
    return replace(correction, shift_m=np.zeros(3), rotation_deg=0.0, camera_to_world=given.poses[frame])


def _agreement_verdict(given: Cameras, agreement: Agreement, bad: Mask, passed: bool, hidden: list[str]) -> Verdict:
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
        "a scale that is wrong by 10 %": [mistakes.scale_factor(given, 1.1)],
        "a focal length that is wrong by 3 %": [mistakes.focal_factor(given, 1.03)],
        "a time shift of one frame": list(mistakes.time_shifts(given))[:1],
        "a wrong convention of the matrices": list(mistakes.conventions(given)),
    }
    found = []
    for text, wrong in tried.items():
        changed = [mistake.cameras for mistake in wrong if _differ(mistake.cameras, given)]
        if not changed or any(agrees(comparison.full(cameras), cameras.kept) for cameras in changed):
            found.append(text)
    return found


def _differ(a: Cameras, b: Cameras) -> bool:
    """Whether cameras differ in more than a shift of the whole world."""
    shifted = a.poses.copy()
    shifted[:, :3, 3] += b.poses[0, :3, 3] - a.poses[0, :3, 3]
    return a.intrinsics != b.intrinsics or float(np.abs(shifted - b.poses).max()) > 1e-4


def _correction_verdict(given: Cameras, corrections: Corrections) -> Verdict:
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


def _with_cause(verdict: Verdict, diagnosis: Mistake | None, given: Cameras, bad: Mask) -> Verdict:
    if verdict.passed or verdict.cause:
        return verdict
    if diagnosis is not None:
        return replace(verdict, cause=diagnosis.cause)
    names = [name_of(given, int(frame)) for frame in np.flatnonzero(bad)]
    listed = ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
    if verdict.name == "mesh distance":
        return replace(verdict, cause=f"the world of the poses is not that of the mesh; far from it: {listed}")
    return replace(verdict, cause=f"none of the known mistakes explains it; disagreeing: {listed or 'no single frame'}")
