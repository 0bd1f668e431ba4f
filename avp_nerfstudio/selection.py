"""Which of the captured frames to train with."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from avp_habitat.rollout import View

Order = Literal["steps", "spread", "random"]

_SEED = 0


def chosen_views(frames: Sequence[View], *, every: int = 1, max_views: int = 0, order: Order = "steps") -> list[View]:
    """Every n-th frame, and of these the first few in some order.

    Args:
        frames: in the order of the steps.
        every: n; the first frame is one of them.
        max_views: how many at most; 0 for all.
        order: `steps` as captured; `spread` so that each next view is the farthest from those before it (see
            `spread_order`); `random` in an order that is the same for every rollout of that length.

    Returns:
        Them in that order; in the order of the steps when nothing is left out, because training then sees them all.
    """
    thinned = list(frames[::every])
    if not 0 < max_views < len(thinned):
        return thinned
    if order == "steps":
        return thinned[:max_views]
    if order == "random":
        indices = np.random.default_rng(_SEED).permutation(len(thinned))[:max_views]
    else:
        indices = spread_order(np.stack([view.camera_to_world for view in thinned]), max_views)
    return [thinned[index] for index in indices]


def spread_order(poses: NDArray[np.floating], count: int) -> NDArray[np.intp]:
    """Indices of views that are far from each other: the first one, then always the farthest from all before it.

    Two views are as far apart as their camera centres, in metres, and their viewing directions, as unit vectors,
    together (the root of the sum of squares): turning by 60° counts like walking a metre. Farthest-point sampling,
    Gonzalez 1985, https://doi.org/10.1016/0304-3975(85)90224-5.

    Args:
        poses: `(n, 4, 4)` camera_to_world, habitat axes, metres.
        count: how many, at most n.

    Returns:
        `(count,)` indices.
    """
    # The third column points backwards; distances between directions are the same for their opposites.
    features = np.concatenate([poses[:, :3, 3], poses[:, :3, 2]], axis=1)
    indices = np.zeros(min(count, len(poses)), dtype=np.intp)
    nearest = np.full(len(poses), np.inf)
    for k in range(1, len(indices)):
        nearest = np.minimum(nearest, ((features - features[indices[k - 1]]) ** 2).sum(axis=1))
        nearest[indices[:k]] = -1
        indices[k] = nearest.argmax()
    return indices
