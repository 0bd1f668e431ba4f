"""Means over episodes with their confidence intervals, and curves over views."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from avp_habitat.intervals import CONFIDENCE, mean_and_half_width

__all__ = ["CONFIDENCE", "held_curve", "mean_and_half_width"]

Float = NDArray[np.floating]


def held_curve(values: Sequence[float] | Float, budget: int) -> NDArray[np.float64]:
    """A figure after 1 … T views, of an episode that may have stopped earlier and then holds its last value.

    Args:
        values: `(v,)` after each view, 1 ≤ v ≤ T.
        budget: T.

    Returns:
        `(T,)`.
    """
    values = np.asarray(values, dtype=np.float64)
    return np.concatenate([values, np.full(budget - len(values), values[-1])])
