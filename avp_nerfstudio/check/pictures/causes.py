"""Which poses the pictures prove wrong, and the fault that explains it: what, undone, makes their matches fit."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize_scalar
from scipy.spatial.transform import Rotation

from avp_habitat.poses import Intrinsics, wrap_angle
from avp_nerfstudio.check import hypotheses
from avp_nerfstudio.check.pictures.rays import Stacked, pair_medians, ray_errors
from avp_nerfstudio.check.verdict import full_angles

Float = NDArray[np.floating]

# Errors of true matches are 0.1 to 0.2 px in the middle at every size of picture; 0.5 degrees are 0.7 px at 160x120.
FIT_PX = 0.7
# A pose that is right gains too when it is freed: six numbers adapt to the noise and to some false matches. The frames
# that fitted least in 24 correct rollouts gained at most 0.13 with ten pairs or more and 0.20 with four; a pose that
# was 5 cm or 0.5 degrees off gained 0.3 to 0.9, unless all its pairs were turns on the spot, which hide where it is.
USUAL_GAIN = 0.1
SPREAD_OF_PAIRS = 0.13
# Chance that a correct rollout has a frame beyond the limit, were the gains of pairs independent and normal.
FALSE_ALARMS = 0.001
# What the depth proves right, the pictures contradict only when they are those of another place.
PROVED_GAIN = 0.5
# And only with so many others: one or two pairs of a repeating pattern can be false as a whole.
PROVED_PAIRS = 4
_SCALE_PX = 0.5
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


@dataclass(frozen=True)
class FreedFit:
    """One picture's matches at its given pose, and at the pose that they fit best while all others stay."""

    pairs: int
    """Other pictures that it is matched with."""
    given: float
    """Share of its matches that fit the given pose within `FIT_PX`."""
    freed: float
    """The same at the best pose."""
    pose: Float
    """`(4, 4)` camera_to_world, habitat axes: the best pose."""

    @property
    def gain(self) -> float:
        """Share of its matches that fit only when the pose is freed."""
        return self.freed - self.given


def gain_limit(pairs: int, frames: int) -> float:
    """Greatest gain that chance explains: it grows as the evidence shrinks, and with the number of frames tested.

    Args:
        pairs: pictures that the frame is matched with, at least one.
        frames: that are tested.
    """
    return USUAL_GAIN + SPREAD_OF_PAIRS * NormalDist().inv_cdf(1 - FALSE_ALARMS / frames) / np.sqrt(pairs)


def frame_shares(stacked: Stacked, poses: Float, intrinsics: Intrinsics) -> Float:
    """`(n,)` share of each picture's matches that fit the poses within `FIT_PX`; NaN for a picture without any."""
    fits = ray_errors(stacked, poses, intrinsics) < FIT_PX
    sides = np.concatenate([stacked.first[stacked.pair], stacked.second[stacked.pair]])
    with np.errstate(invalid="ignore"):
        return np.bincount(sides, np.tile(fits, 2), len(poses)) / np.bincount(sides, minlength=len(poses))


def pair_shares(stacked: Stacked, poses: Float, intrinsics: Intrinsics) -> dict[tuple[int, int], float]:
    """Share of the matches of each pair of pictures, earlier first, that fit the poses within `FIT_PX`."""
    fits = ray_errors(stacked, poses, intrinsics) < FIT_PX
    shares = np.bincount(stacked.pair, fits, len(stacked.first)) / np.diff(stacked.start)
    return dict(zip(zip(stacked.first.tolist(), stacked.second.tolist(), strict=True), shares.tolist(), strict=True))


def freed_fit(stacked: Stacked, poses: Float, intrinsics: Intrinsics, picture: int) -> FreedFit:
    """Free one pose and let its matches choose another, from the given pose and from that of its richest partner.

    Args:
        stacked: the matches.
        poses: `(n, 4, 4)` camera_to_world, habitat axes, of the n pictures.
        intrinsics: of all pictures.
        picture: one that has matches.
    """
    own = np.flatnonzero((stacked.first == picture) | (stacked.second == picture))
    mine = np.isin(stacked.pair, own)
    part = replace(stacked, pair=stacked.pair[mine], pixels=stacked.pixels[:, mine])
    richest = own[np.argmax(stacked.count[own])]
    partner = stacked.first[richest] + stacked.second[richest] - picture

    def errors(pose: Float) -> Float:
        changed = poses.copy()
        changed[picture] = pose
        return ray_errors(part, changed, intrinsics)

    given = float(np.mean(errors(poses[picture]) < FIT_PX))
    best, best_pose = given, poses[picture]
    for start in (poses[picture], poses[partner]):
        found: Any = least_squares(
            lambda x, start=start: errors(_moved(start, x)),
            np.zeros(6),
            loss="cauchy",
            f_scale=_SCALE_PX,
            max_nfev=40,
        )
        pose = _moved(start, found.x)
        share = float(np.mean(errors(pose) < FIT_PX))
        if share > best:
            best, best_pose = share, pose
    return FreedFit(len(own), given, best, best_pose)


def frames_off(
    stacked: Stacked, poses: Float, intrinsics: Intrinsics, *, proved: NDArray[np.bool_]
) -> dict[int, FreedFit]:
    """Free each pose that may be wrong, and keep those that gain more than chance explains.

    Args:
        stacked: the matches.
        poses: `(n, 4, 4)` camera_to_world, habitat axes, of the n pictures.
        intrinsics: of all pictures.
        proved: `(n,)` poses that something else proves right: only a gain of `PROVED_GAIN` in
            `PROVED_PAIRS` pairs or more speaks against these.

    Returns:
        By picture.
    """
    pairs = np.bincount(stacked.first, minlength=len(poses)) + np.bincount(stacked.second, minlength=len(poses))
    shares = frame_shares(stacked, poses, intrinsics)
    tested = int((pairs > 0).sum())
    found = {}
    for picture in np.flatnonzero(pairs):
        if proved[picture] and pairs[picture] < PROVED_PAIRS:
            continue
        limit = max(gain_limit(int(pairs[picture]), tested), PROVED_GAIN * proved[picture])
        # No gain is greater than what does not fit yet.
        if 1 - shares[picture] > limit:
            fit = freed_fit(stacked, poses, intrinsics, int(picture))
            if fit.gain > limit:
                found[int(picture)] = fit
    return found


def shift_and_turn(fit: FreedFit, pose: Float) -> tuple[float, float]:
    """Metres and degrees from the pose that fits to the given one."""
    turned = Rotation.from_matrix(pose[:3, :3] @ fit.pose[:3, :3].T).magnitude()
    return float(np.linalg.norm(pose[:3, 3] - fit.pose[:3, 3])), float(np.degrees(turned))


def _moved(pose: Float, change: Float) -> Float:
    moved = pose.copy()
    moved[:3, 3] += change[:3]
    moved[:3, :3] = Rotation.from_rotvec(change[3:]).as_matrix() @ pose[:3, :3]
    return moved


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
