"""Means with their confidence intervals."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

CONFIDENCE = 0.95


def mean_and_half_width(values: ArrayLike, *, confidence: float = CONFIDENCE) -> tuple[NDArray, NDArray]:
    """Mean over episodes or runs, and half the width of its confidence interval (Student's t, n - 1 degrees).

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
