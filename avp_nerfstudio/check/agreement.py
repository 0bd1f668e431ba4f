"""Judging cameras by the depth: points of some frames looked for in others, and which frames agree."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, project
from avp_nerfstudio.check.depth_maps import DepthMaps

Float = NDArray[np.floating]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

TOLERANCE_M = 0.02
"""Depths this close agree, metres."""
NEIGHBOURS = 4
"""Frames before and after in time that every frame is compared with."""


@dataclass(frozen=True)
class Cameras:
    """Poses and intrinsics as they are believed to be."""

    poses: Float
    """`(n, 4, 4)` camera_to_world, habitat axes; first the captured frames in order, then the held-out views."""
    intrinsics: Intrinsics
    """Of all n."""
    captured: int
    """How many of the n are captured frames."""
    kept: Mask
    """`(n,)` those of which something is believed."""

    def select(self, group: str) -> Mask:
        """`(n,)` the members of a group: "all", "captured" or "held-out"."""
        captured = np.arange(len(self.poses)) < self.captured
        return {"all": captured | True, "captured": captured, "held-out": ~captured}[group]


@dataclass(frozen=True)
class Pairs:
    """Which points are looked for in which pictures."""

    targets: Index
    """`(t,)` the pictures."""
    sources: Index
    """`(t, k)` the frames whose points are projected into each of them."""
    points: int
    """How many points of each source."""


@dataclass(frozen=True)
class Agreement:
    """Counts of points per pair, in the order of the pairs.

    A point that lies behind what a picture shows is hidden there and says nothing; one that lies before it stands where
    that picture saw through, which is a contradiction.
    """

    pairs: Pairs
    """What was compared."""
    agreeing: Index
    """`(t, k)` points within the tolerance."""
    contradicting: Index
    """`(t, k)` points that stand in space seen to be empty."""
    deviation_m: Float
    """`(t, k)` sum over the agreeing points of the absolute difference in metres."""

    def among(self, kept: Mask) -> "Agreement":
        """What `(n,)` kept frames say of each other."""
        between = kept[self.pairs.sources] & kept[self.pairs.targets][:, None]
        return Agreement(self.pairs, self.agreeing * between, self.contradicting * between, self.deviation_m * between)

    def compared(self) -> int:
        """Number of comparable points."""
        return int((self.agreeing + self.contradicting).sum())

    def share(self) -> float:
        """Share of the comparable points that agree; NaN when there is none."""
        return float(self.agreeing.sum() / self.compared()) if self.compared() else float("nan")

    def score(self) -> float:
        """Number of agreeing points times their share: poses under which hardly anything is comparable score low."""
        return float(self.agreeing.sum()) ** 2 / max(self.compared(), 1)

    def mean_deviation_m(self) -> float:
        """Mean absolute difference of the points that agree, metres."""
        return float(self.deviation_m.sum() / max(self.agreeing.sum(), 1))

    def cost_m(self) -> float:
        """Mean absolute difference of all comparable points, none counting more than the tolerance, metres."""
        clipped = self.deviation_m.sum() + TOLERANCE_M * self.contradicting.sum()
        return float(clipped / max(self.compared(), 1))

    def per_frame(self, kept: Mask) -> tuple[Float, Index]:
        """Share of agreeing points of each frame's pairs with the `(n,)` kept frames, as source and as target.

        Returns:
            `(n,)` shares, NaN without a comparable point, and `(n,)` numbers of comparable points.
        """
        agreeing, compared = self._sums(self.agreeing, kept), self._sums(self.agreeing + self.contradicting, kept)
        with np.errstate(invalid="ignore"):
            return agreeing / compared, compared

    def _sums(self, counts: Index, kept: Mask) -> Index:
        targets, sources = self.pairs.targets, self.pairs.sources
        as_target = np.bincount(targets, (counts * kept[sources]).sum(axis=1), minlength=len(kept))
        by_kept = counts * kept[targets][:, None]
        as_source = np.bincount(sources.ravel(), by_kept.ravel(), minlength=len(kept))
        return (as_target + as_source).astype(np.int64)


def choose_pairs(count: int, *, partners: int, points: int, targets: int | None = None) -> Pairs:
    """Pair frames with their neighbours in time and with others spread over the whole rollout, whatever the poses are.

    Args:
        count: number of frames.
        partners: how many sources per picture, at most.
        points: of each source.
        targets: how many pictures, spread evenly; all when omitted.
    """
    near = np.concatenate([np.arange(-NEIGHBOURS, 0), np.arange(1, NEIGHBOURS + 1)])
    if count - 1 <= partners:
        offsets = np.arange(1, count)
    else:
        far = np.linspace(NEIGHBOURS + 1, count - NEIGHBOURS - 1, max(partners - len(near), 0)).round().astype(int)
        offsets = np.unique(np.concatenate([near, far]) % count)
    chosen = np.unique(np.linspace(0, count - 1, min(count, targets or count)).round().astype(np.int64))
    return Pairs(chosen, (chosen[:, None] + offsets) % count, points)


def compare(maps: DepthMaps, cameras: Cameras, pairs: Pairs, *, tolerance_m: float = TOLERANCE_M) -> Agreement:
    """Look for points of some frames in other frames' depth; differences up to the tolerance agree."""
    poses, intrinsics = cameras.poses, cameras.intrinsics
    camera = maps.camera(intrinsics)
    used, sources_in_world = np.unique(pairs.sources, return_inverse=True)
    sources_in_world = sources_in_world.reshape(pairs.sources.shape)
    local = maps.local_points(intrinsics, used, pairs.points)
    world = local @ np.swapaxes(poses[used, :3, :3], 1, 2) + poses[used, None, :3, 3]
    usable = maps.counts > 0
    shape = pairs.sources.shape
    agreeing, contradicting = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    deviation = np.zeros(shape)
    for row, (target, sources) in enumerate(zip(pairs.targets, pairs.sources, strict=True)):
        pixel, depth = project(world[sources_in_world[row]].reshape(-1, 3), poses[target, None], camera)
        seen, smooth = maps.look_up(int(target), pixel[0])
        difference = (depth[0] - seen).reshape(len(sources), local.shape[1])
        comparable = (smooth & (depth[0] > 0)).reshape(difference.shape) & usable[sources, None]
        close = comparable & (np.abs(difference) <= tolerance_m)
        agreeing[row] = close.sum(axis=1)
        contradicting[row] = (comparable & (difference < -tolerance_m)).sum(axis=1)
        deviation[row] = np.where(close, np.abs(difference), 0).sum(axis=1)
    return Agreement(pairs, agreeing, contradicting, deviation)


AGREEING_SHARE = 0.995
"""Least share of comparable points that agree within 2 cm. Correct rollouts by heuristic, random, frontier, greedy,
oracle and spin in four rooms had at least 0.9999 at 640x480 and 0.9995 at 160x120."""
AGREEING_SHARE_OF_FRAME = 0.98
"""The same for the pairs of each single frame; of those rollouts at least 0.9999 at 640x480, 0.993 at 160x120."""
LEAST_COMPARED = 50
"""A frame with fewer comparable points is not judged."""
_POINTS_OF_SOME = 300


class Comparison:
    """Compares cameras with the depth: quickly on some pairs, to look for mistakes, and fully, to judge."""

    def __init__(self, maps: DepthMaps) -> None:
        """Choose the pairs; none of the choices depends on poses."""
        self.maps = maps
        self.all_pairs = choose_pairs(len(maps), partners=100, points=300)
        self.few_pairs = choose_pairs(len(maps), partners=24, points=100, targets=120)

    def full(self, cameras: Cameras) -> Agreement:
        """Agreement of all frames."""
        return compare(self.maps, cameras, self.all_pairs)

    def quick(self, cameras: Cameras, *, tolerance_m: float = TOLERANCE_M) -> float:
        """Score of the kept frames on few pairs, by which mistakes are ranked."""
        return compare(self.maps, cameras, self.few_pairs, tolerance_m=tolerance_m).among(cameras.kept).score()

    def some(self, cameras: Cameras, target: int, sources: Index) -> Agreement:
        """Agreement of the points of some frames with the depth of another."""
        pairs = Pairs(np.array([target]), sources[None, sources != target], _POINTS_OF_SOME)
        return compare(self.maps, cameras, pairs)


def bad_frames(agreement: Agreement, kept: Mask) -> Mask:
    """`(n,)` kept frames that disagree with the rest: the worst is put aside until those that remain agree.

    When a quarter is put aside and the rest still disagrees, the mistake is not one of single frames, and all frames
    that disagree with all others are given.
    """
    bad, trusted = np.zeros(len(kept), bool), kept.copy()
    while bad.sum() <= max(2, 0.25 * kept.sum()):
        share, compared = agreement.per_frame(trusted)
        judged = trusted & (compared >= LEAST_COMPARED)
        worst = int(np.argmin(np.where(judged, share, np.inf)))
        if not judged.any() or share[worst] >= AGREEING_SHARE_OF_FRAME:
            return bad
        bad[worst], trusted[worst] = True, False
    share, compared = agreement.per_frame(kept)
    return kept & (compared >= LEAST_COMPARED) & (share < AGREEING_SHARE_OF_FRAME)


def agrees(agreement: Agreement, kept: Mask) -> bool:
    """Whether the share of agreeing points keeps its limits, over all and for each frame."""
    return not (agreement.among(kept).share() < AGREEING_SHARE or bad_frames(agreement, kept).any())


def overlap(agreement: Agreement, count: int) -> NDArray[np.int64]:
    """`(n, n)` comparable points between each two of n frames, both ways; where they were compared at all."""
    table = np.zeros((count, count), np.int64)
    table[agreement.pairs.targets[:, None], agreement.pairs.sources] = agreement.agreeing + agreement.contradicting
    return table + table.T
