"""Which poses the pictures prove wrong, and the fault that explains it: what, undone, makes their matches fit."""

from dataclasses import dataclass, replace
from itertools import combinations
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize_scalar
from scipy.spatial.transform import Rotation

from avp_habitat.poses import Intrinsics
from avp_nerfstudio.check import mistakes
from avp_nerfstudio.check.agreement import Cameras
from avp_nerfstudio.check.mistakes import zoomed
from avp_nerfstudio.check.pictures.rays import Stacked, pair_medians, ray_errors

Float = NDArray[np.floating]
Mask = NDArray[np.bool_]

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
    """Greatest gain that chance explains: it grows as the evidence shrinks, and with the number of frames tested."""
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
    """Free one pose and let its matches choose another, from the given pose and from that of its richest partner."""
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
            lambda change, start: errors(_moved(start, change)),
            np.zeros(6),
            args=(start,),
            loss="cauchy",
            f_scale=_SCALE_PX,
            max_nfev=40,
        )
        pose = _moved(start, found.x)
        share = float(np.mean(errors(pose) < FIT_PX))
        if share > best:
            best, best_pose = share, pose
    return FreedFit(len(own), given, best, best_pose)


def frames_off(stacked: Stacked, poses: Float, intrinsics: Intrinsics, *, proved: Mask) -> dict[int, FreedFit]:
    """Free each pose that may be wrong, and keep, by picture, those that gain more than chance explains.

    `(n,)` poses are proved right by something else: only a gain of `PROVED_GAIN` in `PROVED_PAIRS` pairs or more
    speaks against these.
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


def _moved(pose: Float, change: Float) -> Float:
    moved = pose.copy()
    moved[:3, 3] += change[:3]
    moved[:3, :3] = Rotation.from_rotvec(change[3:]).as_matrix() @ pose[:3, :3]
    return moved


def best_focal_factor(stacked: Stacked, poses: Float, intrinsics: Intrinsics) -> float:
    """Factor on the focal length with which the matches agree best with the poses; 1.0 when it is right.

    A walk without turns shows the same epipolar geometry at every focal length: 1.0 too where no factor is better than
    the focal length as given by `FOCAL_GAIN_PX`, and by `FOCAL_GAIN_NOISES` times what it varies by between pairs.
    """

    def medians(factor: float) -> Float:
        errors = ray_errors(stacked, poses, zoomed(intrinsics, factor)) / factor
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
    given: Cameras,
    *,
    focal_factor: float,
    off: dict[int, FreedFit],
    frames: NDArray[np.int64],
    proved: Mask,
) -> str | None:
    """The fault that explains why the pictures contradict the poses, in words; None when no known one does.

    Args:
        stacked: the matches.
        given: the cameras of the n pictures.
        focal_factor: of `best_focal_factor`.
        off: the pictures whose poses do not fit, of `frames_off`.
        frames: `(n,)` frame numbers, for the text.
        proved: `(n,)` pictures whose poses something else proves right.
    """
    wrong_focal = abs(focal_factor - 1) >= FOCAL_TOLERANCE
    if 0 < len(off) <= max(2, _FEW_FRAMES * len(given.poses)) and not wrong_focal:
        return _cause_in_frames(stacked, given, off, frames, proved)
    best, most = None, max(_HEALED, _mean_share(stacked, given) + _BETTER)
    known = [mistakes.focal_factor(given, 1 / focal_factor, evidence="pictures")] if wrong_focal else []
    for mistake in (*known, *mistakes.usual(given)):
        share = _mean_share(stacked, mistake.cameras)
        if share > most:
            best, most = mistake.cause, share
    return best


def _mean_share(stacked: Stacked, cameras: Cameras) -> float:
    return float(np.nanmean(frame_shares(stacked, cameras.poses, cameras.intrinsics)))


def _cause_in_frames(
    stacked: Stacked, given: Cameras, off: dict[int, FreedFit], frames: NDArray[np.int64], proved: Mask
) -> str:
    pictures = sorted(off)
    what, other = ("pictures", "poses") if proved[pictures].all() else ("poses", "pictures")
    known = ": the depth proves the poses right" if what == "pictures" else ""
    for first, second in combinations(pictures, 2):
        exchanged = given.poses.copy()
        exchanged[[first, second]] = given.poses[[second, first]]
        shares = frame_shares(stacked, exchanged, given.intrinsics)
        if all(shares[picture] - off[picture].given > off[picture].gain / 2 for picture in (first, second)):
            return f"the {what} of frames {frames[first]} and {frames[second]} look exchanged{known}"
    names = ", ".join(str(frame) for frame in frames[pictures])
    if len(pictures) > 1:
        return f"the {what} of frames {names} do not fit their {other}, those of the others do{known}"
    if known:
        return f"the picture of frame {names} does not fit its pose{known}"
    pose, fit = given.poses[pictures[0]], off[pictures[0]].pose
    shift_cm = 100 * np.linalg.norm(pose[:3, 3] - fit[:3, 3])
    turn_deg = np.degrees(Rotation.from_matrix(pose[:3, :3] @ fit[:3, :3].T).magnitude())
    return f"the pose of frame {names} looks {shift_cm:.1f} cm and {turn_deg:.1f} degrees off, those of the others fit"
