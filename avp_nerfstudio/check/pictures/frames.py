"""Which poses the pictures prove wrong: most matches of such a frame would fit another pose, and do not fit its own."""

from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from avp_habitat.poses import Intrinsics
from avp_nerfstudio.check.pictures.rays import Stacked, ray_errors

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
