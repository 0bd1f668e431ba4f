"""Means over episodes with their confidence intervals, and curves over views."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating]
CONFIDENCE = 0.95


def mean_and_half_width(values: Float, *, confidence: float = CONFIDENCE) -> tuple[Float, Float]:
    """Mean over episodes, and half the width of its confidence interval (Student's t with n - 1 degrees of freedom).

    Args:
        values: `(n, ...)` a figure of each of n episodes, n at least 1.
        confidence: within (0, 1).

    Returns:
        `(...)` each; the half width is nan for one episode, of whose spread nothing is known.
    """
    from scipy import stats

    values = np.asarray(values, dtype=np.float64)
    n = len(values)
    mean = values.mean(axis=0)
    if n < 2:
        return mean, np.full_like(mean, np.nan)
    error = values.std(axis=0, ddof=1) / np.sqrt(n)
    return mean, stats.t.ppf((1 + confidence) / 2, n - 1) * error


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
