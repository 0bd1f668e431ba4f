"""Checking a rollout's poses against what its pictures alone say."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics
from avp_habitat.rollout.format import Rollout
from avp_nerfstudio.check import Verdict
from avp_nerfstudio.check.agreement import Cameras
from avp_nerfstudio.check.colmap import triangulate
from avp_nerfstudio.check.pictures.causes import (
    FIT_PX,
    FOCAL_TOLERANCE,
    FreedFit,
    best_focal_factor,
    frame_shares,
    frames_off,
    likely_cause,
    pair_shares,
)
from avp_nerfstudio.check.pictures.matching import Matches, match_pictures
from avp_nerfstudio.check.pictures.rays import (
    RelativePoses,
    estimate_relative_poses,
    frame_medians,
    ray_errors,
    relative_errors,
    stack_matches,
)

Float = NDArray[np.floating]
Mask = NDArray[np.bool_]

# Percent of a frame's matches that do not fit, median over the frames. In 24 correct rollouts of all policies and
# sizes 2 to 17 % did not: false ones, and features of blurred walls. Wrong conventions leave 60 to 100 %.
MISFIT_LIMIT = 0.4
# Poses that the depth proves right, and relative poses that fit, from which on it is the matches that are false.
MIN_PROVED, FITTING_SHARE = 5, 0.9
# Rotations 0.00 to 0.08 deg off (median of the pairs; 0.21 at 320x240), directions 0.15 to 1.6 deg, 5.9 deg in that
# random walk. Single pairs can be far off where a wall fills both pictures, so a frame's own median only shows gross
# faults: 0.3 to 2.9 deg.
ROTATION_LIMIT_DEG = 0.5
FRAME_ROTATION_LIMIT_DEG = 10.0
DIRECTION_LIMIT_DEG = 10.0
# The limits in degrees are for pictures of this focal length or more (640x480 of 90 degrees).
FULL_FOCAL_PX = 320.0
# Fewer pairs, or pairs for fewer frames, say too little to fail a rollout.
MIN_PAIRS = 10
MIN_FRAMES_SHARE = 0.5


def check_pictures(
    rollout: Rollout,
    *,
    matches: Matches | None = None,
    proved: Mask | None = None,
    progress: bool = True,
) -> list[Verdict]:
    """The verdicts of `judge` on a rollout, whose held-out views are not looked at; `proved` is per frame.

    Raises:
        RolloutError: a picture cannot be read.
    """
    matches = matches or match_pictures(rollout, progress=progress)
    poses = np.array([rollout.frames[index].camera_to_world for index in matches.frames]).reshape(-1, 4, 4)
    of_pictures = None if proved is None else proved[matches.frames]
    verdicts = judge(matches, poses, rollout.intrinsics, proved=of_pictures)
    return [_with_points(verdicts[0], matches, poses, rollout.intrinsics), *verdicts[1:]]


def judge(
    matches: Matches,
    poses: Float,
    intrinsics: Intrinsics,
    *,
    proved: Mask | None = None,
    estimated: RelativePoses | None = None,
) -> list[Verdict]:
    """Hold poses and intrinsics against the matches of the pictures.

    Args:
        matches: of n pictures.
        poses: `(n, 4, 4)` camera_to_world, habitat axes, metres.
        intrinsics: of all pictures.
        proved: `(n,)` whether the depth proves a pose right; none when omitted.
        estimated: relative poses from the matches, where they are known already.

    Returns:
        The verdicts "reprojection" (multi-view) and "relative poses" (pair by pair). A scene's scale cannot be seen
        in pictures. Pictures with too few matches pass, and the text says that they could not be judged.
    """
    known = len({picture for pair in matches.pairs for picture in (pair.first, pair.second)})
    if len(matches.pairs) < MIN_PAIRS or known < MIN_FRAMES_SHARE * len(poses):
        return [_unjudged(name, matches, known) for name in ("reprojection", "relative poses")]
    proved = np.zeros(len(poses), bool) if proved is None else proved
    stacked = stack_matches(matches)
    factor = best_focal_factor(stacked, poses, intrinsics)
    fit = frame_shares(stacked, poses, intrinsics)
    misfit = 1 - float(np.nanmedian(fit))
    off = frames_off(stacked, poses, intrinsics, proved=proved) if misfit <= MISFIT_LIMIT else {}
    given = Cameras(poses, intrinsics, len(poses), np.ones(len(poses), bool))
    cause = likely_cause(stacked, given, focal_factor=factor, off=off, frames=matches.frames, proved=proved)
    estimated = estimated or estimate_relative_poses(matches, intrinsics)
    shares = pair_shares(stacked, poses, intrinsics)
    pairs = zip(estimated.first.tolist(), estimated.second.tolist(), strict=True)
    fitting = np.array([shares[pair] >= 1 - MISFIT_LIMIT for pair in pairs], bool)
    figures = {
        "misfit_percent": 100 * misfit,
        "judged_frames": float(known),
        "frames": float(len(poses)),
        "pairs": float(len(matches.pairs)),
    }
    right = fit[proved & np.isfinite(fit)]
    false = misfit > MISFIT_LIMIT and len(right) >= MIN_PROVED and 1 - np.median(right) > MISFIT_LIMIT
    if false and len(fitting) >= MIN_PAIRS and fitting.mean() >= FITTING_SHARE:
        reprojection = _false_matches(figures, right=len(right), fitting=fitting)
    else:
        figures |= {
            "ray_error_median_px": float(np.median(ray_errors(stacked, poses, intrinsics))),
            "frames_off": float(len(off)),
            "best_focal_factor": factor,
        }
        reprojection = _judge_reprojection(matches, figures, off, cause)
    return [reprojection, _judge_relative(matches, estimated, given, fitting, cause)]


def _with_points(verdict: Verdict, matches: Matches, poses: Float, intrinsics: Intrinsics) -> Verdict:
    """The verdict with what COLMAP triangulates: no part of it, because where nothing moves only false matches do."""
    if "misfit_percent" not in verdict.figures:
        return verdict
    model = triangulate(matches, poses, intrinsics)
    points = model.num_points3D()
    figures = {
        "points": float(points),
        "track_length_mean": model.compute_mean_track_length() if points else 0.0,
        "observations": float(model.compute_num_observations()),
    }
    text = verdict.text
    if points:
        figures["mean_reprojection_px"] = float(model.compute_mean_reprojection_error())
        text += f"; {points} points triangulated, mean reprojection error {figures['mean_reprojection_px']:.2f} px"
    return replace(verdict, text=text, figures=verdict.figures | figures)


_Limit = tuple[str, float, float]
"""What was measured, with its value; the value; and what it may be at most."""


def _verdict(name: str, limits: list[_Limit], figures: dict[str, float], cause: str | None, *, note: str) -> Verdict:
    broken = [(text, value, most) for text, value, most in limits if value > most]
    text = "; ".join(f"{text} (limit {most:.3g})" for text, _, most in broken or limits)
    return Verdict(name, not broken, text + note, figures, cause if broken else None)


def _unjudged(name: str, matches: Matches, known: int) -> Verdict:
    figures = {
        "frames": float(len(matches.names)),
        "judged_frames": float(known),
        "pairs": float(len(matches.pairs)),
        "features_median": float(np.median([len(rows) for rows in matches.features])) if matches.features else 0.0,
    }
    text = (
        f"could not be judged: {len(matches.names)} pictures with {figures['features_median']:.0f} features (median) "
        f"gave {len(matches.pairs)} matching pairs, enough for {known} frames"
    )
    return Verdict(name, True, text, figures)


def _false_matches(figures: dict[str, float], *, right: int, fitting: Mask) -> Verdict:
    """Patterns that repeat match falsely in whole pairs: where poses are right for sure, that is no fault of them."""
    text = (
        f"could not be judged: {figures['misfit_percent']:.0f} % of the matches of {figures['judged_frames']:.0f} "
        f"frames are off by more than {FIT_PX} px, but also at {right} poses that the depth proves right, and "
        f"{int(fitting.sum())} of {len(fitting)} relative poses fit: the matches are false, as of patterns that repeat"
    )
    return Verdict("reprojection", True, text, figures | {"judged_frames": 0.0})


def _judge_reprojection(
    matches: Matches, figures: dict[str, float], off: dict[int, FreedFit], cause: str | None
) -> Verdict:
    misfit, wrong_focal = figures["misfit_percent"], 100 * abs(figures["best_focal_factor"] - 1)
    named = f"{len(off)} of {figures['judged_frames']:.0f} frames would fit much better elsewhere"
    if off:
        worst = max(off, key=lambda picture: off[picture].gain)
        figures |= {"worst_frame": float(matches.frames[worst]), "worst_frame_gain_percent": 100 * off[worst].gain}
        named += (
            f", worst frame {matches.frames[worst]}: {100 * off[worst].given:.0f} % of its matches in "
            f"{off[worst].pairs} pairs fit, {100 * off[worst].freed:.0f} % were it freed"
        )
    limits: list[_Limit] = [
        (f"{misfit:.0f} % of the matches off by more than {FIT_PX} px", misfit, 100 * MISFIT_LIMIT),
        (named, len(off), 0),
        (f"focal length {wrong_focal:.2f} % off", wrong_focal, 100 * FOCAL_TOLERANCE),
    ]
    frames = len(matches.names)
    left_out = frames - int(figures["judged_frames"])
    note = f"; {left_out} of {frames} frames show too little to be judged" if left_out else ""
    return _verdict("reprojection", limits, figures, cause, note=note)


def _judge_relative(
    matches: Matches, estimated: RelativePoses, given: Cameras, fitting: Mask, cause: str | None
) -> Verdict:
    # Features are located to a part of a pixel, which is a greater angle in small pictures.
    coarseness = max(1.0, FULL_FOCAL_PX / np.sqrt(given.intrinsics.fx * given.intrinsics.fy))
    rotation_deg, direction_deg = relative_errors(estimated, given.poses)
    moved = np.isfinite(direction_deg)
    if len(rotation_deg) < MIN_PAIRS:
        return _unjudged("relative poses", matches, len(set(estimated.first) | set(estimated.second)))
    # Where the matches fit the poses too, another estimate says nothing against these: one wall, or few features in a
    # corner, look the same from other places.
    counted_deg = np.where(fitting, 0.0, rotation_deg)
    frames_deg = frame_medians(estimated, counted_deg, len(given.poses))
    worst = int(np.nanargmax(frames_deg))
    figures = {
        "worst_frame_rotation_deg": float(frames_deg[worst]),
        "worst_rotation_frame": float(matches.frames[worst]),
        "rotation_median_deg": float(np.median(rotation_deg)),
        "rotation_90th_percentile_deg": float(np.percentile(rotation_deg, 90)),
        "pairs": float(len(rotation_deg)),
        "pairs_with_direction": float(moved.sum()),
        "fitting_pairs": float(fitting.sum()),
    }
    limits: list[_Limit] = [
        (
            f"rotation of {len(rotation_deg)} pairs {figures['rotation_median_deg']:.3f} deg off (median)",
            float(np.median(counted_deg)),
            coarseness * ROTATION_LIMIT_DEG,
        ),
        (
            f"worst frame {matches.frames[worst]} turned by {frames_deg[worst]:.2f} deg",
            float(frames_deg[worst]),
            coarseness * FRAME_ROTATION_LIMIT_DEG,
        ),
    ]
    if moved.sum() >= MIN_PAIRS:
        figures["direction_median_deg"] = float(np.median(direction_deg[moved]))
        limits.append(
            (
                f"direction of {moved.sum()} pairs {figures['direction_median_deg']:.2f} deg off (median)",
                float(np.median(np.where(fitting, 0.0, direction_deg)[moved])),
                coarseness * DIRECTION_LIMIT_DEG,
            )
        )
    note = f"; {fitting.sum()} of {len(fitting)} pairs fit the poses as they are and count as right"
    return _verdict("relative poses", limits, figures, cause, note=note)
