"""Checking a rollout's poses against what its pictures alone say."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pycolmap import Reconstruction

from avp_habitat.poses import Intrinsics
from avp_habitat.rollout import Rollout
from avp_nerfstudio.check.colmap_model import triangulate
from avp_nerfstudio.check.pictures_causes import FOCAL_TOLERANCE, best_focal_factor, likely_cause
from avp_nerfstudio.check.pictures_matching import Matches, match_pictures
from avp_nerfstudio.check.pictures_rays import frame_errors, stack_matches
from avp_nerfstudio.check.pictures_relative import (
    RelativePoses,
    estimate_relative_poses,
    frame_medians,
    relative_errors,
)
from avp_nerfstudio.check.verdict import Verdict

Float = NDArray[np.floating]

# Measured on correct rollouts of 80 frames, 640x480 (oracle, greedy, heuristic and random in the white and the grey
# white room): mean reprojection error 0.26 to 0.50 px, and 0.83 px where a random walk stays close to blurred walls;
# focal length at most 0.1 % off.
REPROJECTION_LIMIT_PX = 1.2
# Worst frame 0.24 to 0.55 px, 1.07 px in that random walk, whose median frame has 0.49 px (0.09 to 0.13 px in the
# others): so the limit follows the median, between two bounds. A frame that was 5 cm off had 1.1 px or more in 95 % of
# the trials on the rollouts of oracle and greedy in the white room.
FRAME_LIMIT_PX = 0.8
FRAME_LIMIT_OF_MEDIAN = 3.0
FRAME_LIMIT_MOST_PX = 2.0
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
    rollout: Rollout, *, matches: Matches | None = None, workdir: Path | None = None, progress: bool = True
) -> list[Verdict]:
    """Two verdicts on a rollout's poses and intrinsics: "reprojection" and "relative poses".

    Args:
        rollout: a checked rollout; its held-out views are not looked at.
        matches: of the rollout's pictures, where they are known already.
        workdir: where temporary folders are made; the system's place when omitted.
        progress: show bars where the output is a terminal.

    Raises:
        RolloutError: a picture cannot be read.
    """
    matches = matches or match_pictures(rollout, workdir=workdir, progress=progress)
    poses = np.array([rollout.frames[index].camera_to_world for index in matches.frames]).reshape(-1, 4, 4)
    return judge(matches, poses, rollout.intrinsics, workdir=workdir)


def judge(matches: Matches, poses: Float, intrinsics: Intrinsics, *, workdir: Path | None = None) -> list[Verdict]:
    """Hold poses and intrinsics against the matches of the pictures.

    Args:
        matches: of n pictures.
        poses: `(n, 4, 4)` camera_to_world, habitat axes, metres.
        intrinsics: of all pictures.
        workdir: where a temporary folder is made.

    Returns:
        The verdicts "reprojection" (multi-view) and "relative poses" (pair by pair). A scene's scale cannot be seen
        in pictures. Pictures with too few matches pass, and the text says that they could not be judged.
    """
    stacked = stack_matches(matches)
    errors = frame_errors(stacked, poses, intrinsics) if matches.pairs else np.full(len(poses), np.nan)
    known = int(np.isfinite(errors).sum())
    if len(matches.pairs) < MIN_PAIRS or known < MIN_FRAMES_SHARE * len(poses):
        return [_unjudged(name, matches, known) for name in ("reprojection", "relative poses")]
    factor = best_focal_factor(stacked, poses, intrinsics)
    cause = likely_cause(
        stacked, poses, intrinsics, focal_factor=factor, limit_px=frame_limit(errors), frames=matches.frames
    )
    model = triangulate(matches, poses, intrinsics, workdir=workdir)
    return [
        _judge_reprojection(matches, model, errors=errors, factor=factor, cause=cause),
        _judge_relative(matches, estimate_relative_poses(matches, intrinsics), poses, intrinsics, cause=cause),
    ]


def frame_limit(errors: Float) -> float:
    """What a frame's error may be in pixels, from the `(n,)` errors of all frames: blurred pictures allow more."""
    return float(np.clip(FRAME_LIMIT_OF_MEDIAN * np.nanmedian(errors), FRAME_LIMIT_PX, FRAME_LIMIT_MOST_PX))


@dataclass(frozen=True)
class _Limit:
    """One figure held to its limit."""

    text: str
    """What was measured, with its value."""
    value: float
    """As measured."""
    most: float
    """What it may be."""

    @property
    def kept(self) -> bool:
        return self.value <= self.most


def _verdict(
    name: str, limits: list[_Limit], figures: dict[str, float], cause: str | None, *, note: str = ""
) -> Verdict:
    broken = [limit for limit in limits if not limit.kept]
    text = "; ".join(f"{limit.text} (limit {limit.most:.3g})" for limit in broken or limits)
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


def _judge_reprojection(
    matches: Matches, model: Reconstruction, *, errors: Float, factor: float, cause: str | None
) -> Verdict:
    points = model.num_points3D()
    reprojection_px = model.compute_mean_reprojection_error() if points else np.inf
    worst = int(np.nanargmax(errors))
    figures = {
        "mean_reprojection_px": float(reprojection_px),
        "points": float(points),
        "track_length_mean": model.compute_mean_track_length() if points else 0.0,
        "observations": float(model.compute_num_observations()),
        "ray_error_median_px": float(np.nanmedian(errors)),
        "worst_frame_ray_error_px": float(errors[worst]),
        "worst_frame": float(matches.frames[worst]),
        "best_focal_factor": factor,
        "judged_frames": float(np.isfinite(errors).sum()),
        "frames": float(len(errors)),
        "pairs": float(len(matches.pairs)),
    }
    limits = [
        _Limit(
            f"mean reprojection error {reprojection_px:.2f} px of {points} points",
            reprojection_px,
            REPROJECTION_LIMIT_PX,
        ),
        _Limit(f"worst frame {matches.frames[worst]} with {errors[worst]:.2f} px", errors[worst], frame_limit(errors)),
        _Limit(f"focal length {100 * abs(factor - 1):.2f} % off", 100 * abs(factor - 1), 100 * FOCAL_TOLERANCE),
    ]
    left_out = len(errors) - int(np.isfinite(errors).sum())
    return _verdict("reprojection", limits, figures, cause, note=_note(left_out, len(errors)))


def _note(left_out: int, frames: int) -> str:
    return f"; {left_out} of {frames} frames show too little to be judged" if left_out else ""


def _judge_relative(
    matches: Matches, estimated: RelativePoses, poses: Float, intrinsics: Intrinsics, *, cause: str | None
) -> Verdict:
    # Features are located to a part of a pixel, which is a greater angle in small pictures.
    coarseness = max(1.0, FULL_FOCAL_PX / np.sqrt(intrinsics.fx * intrinsics.fy))
    rotation_deg, direction_deg = relative_errors(estimated, poses)
    moved = np.isfinite(direction_deg)
    if len(rotation_deg) < MIN_PAIRS:
        return _unjudged("relative poses", matches, len(set(estimated.first) | set(estimated.second)))
    frames_deg = frame_medians(estimated, rotation_deg, len(poses))
    worst = int(np.nanargmax(frames_deg))
    figures = {
        "worst_frame_rotation_deg": float(frames_deg[worst]),
        "worst_rotation_frame": float(matches.frames[worst]),
        "rotation_median_deg": float(np.median(rotation_deg)),
        "rotation_90th_percentile_deg": float(np.percentile(rotation_deg, 90)),
        "pairs": float(len(rotation_deg)),
        "pairs_with_direction": float(moved.sum()),
    }
    limits = [
        _Limit(
            f"rotation of {len(rotation_deg)} pairs {figures['rotation_median_deg']:.3f} deg off (median)",
            figures["rotation_median_deg"],
            coarseness * ROTATION_LIMIT_DEG,
        ),
        _Limit(
            f"worst frame {matches.frames[worst]} turned by {frames_deg[worst]:.2f} deg",
            figures["worst_frame_rotation_deg"],
            coarseness * FRAME_ROTATION_LIMIT_DEG,
        ),
    ]
    if moved.sum() >= MIN_PAIRS:
        figures["direction_median_deg"] = float(np.median(direction_deg[moved]))
        limits.append(
            _Limit(
                f"direction of {moved.sum()} pairs {figures['direction_median_deg']:.2f} deg off (median)",
                figures["direction_median_deg"],
                coarseness * DIRECTION_LIMIT_DEG,
            )
        )
    return _verdict("relative poses", limits, figures, cause)
