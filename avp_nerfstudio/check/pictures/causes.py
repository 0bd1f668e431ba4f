"""Likely causes of poses that the pictures contradict: the fault whose undoing makes them agree."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from avp_habitat.poses import Intrinsics, wrap_angle
from avp_nerfstudio.check import hypotheses
from avp_nerfstudio.check.pictures.frames import FreedFit, frame_shares, shift_and_turn
from avp_nerfstudio.check.pictures.rays import Stacked, pair_medians, ray_errors
from avp_nerfstudio.check.verdict import full_angles

Float = NDArray[np.floating]

FOCAL_RANGE = (0.75, 1.33)
# In correct rollouts no other focal length was better by the gain below; one 1 % off was found 0.8 to 1.0 % off.
FOCAL_TOLERANCE = 0.005
# A focal length 1 % off raised the mean error of the pairs, on a walk of the white room, from 0.9 to 1.4 px.
FOCAL_GAIN_PX = 0.03
FOCAL_GAIN_NOISES = 4.0
# Errors beyond this say no more than "wrong": false matches of a repeating texture do not pull.
_CLIP_PX = 5.0
# A fault of single frames leaves nearly all the others right.
_FEW_FRAMES = 0.1
# Least share of all matches that fit when a fault of a whole rollout is undone, and how much more that has to be.
_HEALED, _BETTER = 0.6, 0.02


def best_focal_factor(stacked: Stacked, poses: Float, intrinsics: Intrinsics) -> float:
    """Factor on the focal length with which the matches agree best with the poses; 1.0 when it is right.

    A walk without turns shows the same epipolar geometry at every focal length: 1.0 too where no factor is better than
    the focal length as given by `FOCAL_GAIN_PX`, and by `FOCAL_GAIN_NOISES` times what it varies by between pairs.

    Args:
        stacked: the matches.
        poses: `(n, 4, 4)` camera_to_world, habitat axes.
        intrinsics: as given.
    """

    def medians(factor: float) -> Float:
        errors = ray_errors(stacked, poses, _zoomed(intrinsics, factor)) / factor
        return np.minimum(pair_medians(stacked, errors), _CLIP_PX)

    def cost(factor: float) -> float:
        return float(medians(factor).mean())

    coarse = np.geomspace(*FOCAL_RANGE, 13)
    best = int(np.argmin([cost(factor) for factor in coarse]))
    bounds = coarse[max(best - 1, 0)], coarse[min(best + 1, len(coarse) - 1)]
    found: Any = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-4})
    # Where nothing turns, a longer focal length fits as well, and makes less of the same pixels of noise.
    gains = medians(1.0) / max(1.0, found.x) - medians(found.x)
    # A paired test: a few pairs that gain much are no evidence where the others gain nothing.
    noise = float(gains.std() / np.sqrt(len(gains)))
    return float(found.x) if gains.mean() >= max(FOCAL_GAIN_PX, FOCAL_GAIN_NOISES * noise) else 1.0


def likely_cause(
    stacked: Stacked,
    poses: Float,
    intrinsics: Intrinsics,
    *,
    focal_factor: float,
    off: dict[int, FreedFit],
    frames: NDArray[np.int64],
    proved: NDArray[np.bool_],
) -> str | None:
    """The fault that explains why the pictures contradict the poses, in words.

    Args:
        stacked: the matches.
        poses: `(n, 4, 4)` camera_to_world, habitat axes.
        intrinsics: as given.
        focal_factor: of `best_focal_factor`.
        off: the pictures whose poses do not fit, of `frames_off`.
        frames: `(n,)` frame numbers, for the text.
        proved: `(n,)` pictures whose poses something else proves right.

    Returns:
        None when no known fault explains it.
    """
    few = 0 < len(off) <= max(2, _FEW_FRAMES * len(poses))
    if few and abs(focal_factor - 1) < FOCAL_TOLERANCE:
        return _cause_in_frames(stacked, poses, intrinsics, off=off, frames=frames, proved=proved)
    return _cause_in_all(stacked, poses, intrinsics, focal_factor=focal_factor)


def _cause_in_all(stacked: Stacked, poses: Float, intrinsics: Intrinsics, *, focal_factor: float) -> str | None:
    """The fault whose undoing makes most matches fit."""
    best, most = None, max(_HEALED, float(np.nanmean(frame_shares(stacked, poses, intrinsics))) + _BETTER)
    for text, undone, camera in _undone(poses, intrinsics, focal_factor):
        share = float(np.nanmean(frame_shares(stacked, undone, camera)))
        if share > most:
            best, most = text, share
    return best


def _zoomed(intrinsics: Intrinsics, factor: float) -> Intrinsics:
    return replace(intrinsics, fx=intrinsics.fx * factor, fy=intrinsics.fy * factor)


def _undone(poses: Float, intrinsics: Intrinsics, focal_factor: float) -> Iterator[tuple[str, Float, Intrinsics]]:
    """Each fault of a whole rollout: its words, and the poses and intrinsics without it."""
    given = hypotheses.Cameras(poses, intrinsics, len(poses), np.ones(len(poses), bool))
    if abs(focal_factor - 1) >= FOCAL_TOLERANCE:
        yield _focal_words(intrinsics, focal_factor), poses, _zoomed(intrinsics, focal_factor)
    degrees = hypotheses.degrees_taken_for_radians(given, _whole_degrees(poses), "all")
    for found in (
        *hypotheses.conventions(given, "all"),
        *hypotheses.time_shifts(given),
        *hypotheses.radians_taken_for_degrees(given, "all"),
        degrees,
        *hypotheses.swapped_intrinsics(given),
    ):
        yield found.cause, found.cameras.poses, found.cameras.intrinsics


def _focal_words(intrinsics: Intrinsics, factor: float) -> str:
    longer = 100 * (1 / factor - 1)
    return (
        f"the focal length looks {abs(longer):.1f} % too {'long' if longer > 0 else 'short'}: "
        f"expected {intrinsics.fx * factor:.1f} px, found {intrinsics.fx:.1f} px"
    )


def _whole_degrees(poses: Float) -> Float:
    """`(n,)` the pitch in radians that is the whole number of degrees which, read as radians, gives the pitch now."""
    degrees = np.arange(-90, 91)
    nearest = np.abs(wrap_angle(full_angles(poses)[1][:, None] - degrees)).argmin(axis=1)
    return np.radians(degrees[nearest])


def _cause_in_frames(
    stacked: Stacked,
    poses: Float,
    intrinsics: Intrinsics,
    *,
    off: dict[int, FreedFit],
    frames: NDArray[np.int64],
    proved: NDArray[np.bool_],
) -> str:
    pictures = sorted(off)
    what, other = ("pictures", "poses") if proved[pictures].all() else ("poses", "pictures")
    known = ": the depth proves the poses right" if what == "pictures" else ""
    for first, second in combinations(pictures, 2):
        exchanged = poses.copy()
        exchanged[[first, second]] = poses[[second, first]]
        shares = frame_shares(stacked, exchanged, intrinsics)
        if all(shares[picture] - off[picture].given > off[picture].gain / 2 for picture in (first, second)):
            return f"the {what} of frames {frames[first]} and {frames[second]} look exchanged{known}"
    names = ", ".join(str(frame) for frame in frames[pictures])
    if len(pictures) > 1:
        return f"the {what} of frames {names} do not fit their {other}, those of the others do{known}"
    if known:
        return f"the picture of frame {names} does not fit its pose{known}"
    shift_m, turn_deg = shift_and_turn(off[pictures[0]], poses[pictures[0]])
    return (
        f"the pose of frame {names} looks {100 * shift_m:.1f} cm and {turn_deg:.1f} degrees off, "
        "those of the others fit"
    )
