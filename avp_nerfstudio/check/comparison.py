"""Judging cameras by the depth: which frames agree, and which do not."""

import numpy as np
from numpy.typing import NDArray

from avp_nerfstudio.check.agreement import Agreement, Pairs, choose_pairs, compare
from avp_nerfstudio.check.depth_maps import DepthMaps
from avp_nerfstudio.check.hypotheses import Cameras

Mask = NDArray[np.bool_]

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
        return compare(self.maps, cameras.poses, cameras.intrinsics, self.all_pairs)

    def quick(self, cameras: Cameras, *, tolerance_m: float = 0.02) -> float:
        """Score on few pairs, by which hypotheses are ranked: `score` of all kept frames."""
        found = compare(self.maps, cameras.poses, cameras.intrinsics, self.few_pairs, tolerance_m=tolerance_m)
        return found.score(cameras.kept)

    def some(self, cameras: Cameras, targets: list[int], sources: NDArray[np.int64]) -> Agreement:
        """Agreement of the points of some frames with the depth of a few others."""
        rows = [np.resize(sources[sources != target], len(sources)) for target in targets]
        pairs = Pairs(np.array(targets), np.stack(rows), _POINTS_OF_SOME)
        return compare(self.maps, cameras.poses, cameras.intrinsics, pairs)


def bad_frames(agreement: Agreement, kept: Mask) -> Mask:
    """Frames that disagree with the rest: the worst is put aside until those that remain agree.

    Args:
        agreement: of all.
        kept: `(n,)` those to judge.

    Returns:
        `(n,)`; when a quarter is put aside and the rest still disagrees, the mistake is not one of single frames, and
        all frames that disagree with all others are given.
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
    return not (agreement.share(kept) < AGREEING_SHARE or bad_frames(agreement, kept).any())


def overlap(agreement: Agreement, count: int) -> NDArray[np.int64]:
    """`(n, n)` comparable points between each two of n frames, both ways; where they were compared at all."""
    table = np.zeros((count, count), np.int64)
    table[agreement.pairs.targets[:, None], agreement.pairs.sources] = agreement.agreeing + agreement.contradicting
    return table + table.T
