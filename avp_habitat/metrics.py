"""Figures of episodes and rollouts, what their names mean, and means with their confidence intervals."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from avp_habitat.sight.visibility import ALIKE_DEG, ALIKE_DISTANCE, PARALLAX_DEG

Float = NDArray[np.floating]

TERMS = {
    "coverage": "share of the navigable floor that some picture shows",
    "views": "pictures taken, one for each step",
    "CpV": "coverage per view, mean coverage over mean number of views",
    "EI": "efficiency index, coverage over the number of pictures",
    "ANND": "mean distance from each camera to the nearest other one, small where places repeat",
    "redundant views": "like an earlier one in place and direction",
    "stop": "the policy itself ended the episode, with enough coverage",
    "path length": "metres walked",
    "held-out views": "pictures of the room that no reconstruction is trained on",
    "visibility": "share of the held-out views' pixels whose surface a captured picture shows",
    "2 frames": "that, by at least two pictures",
    "3 frames": "that, by at least three pictures",
    "alike": f"that, within {ALIKE_DEG:g} degrees of the held-out ray and at most {ALIKE_DISTANCE:g} times as far away",
    "parallax": f"that, along two rays at least {PARALLAX_DEG:g} degrees apart, which fixes the depth",
    "weighted": "that, weighted by how much the best ray is like the held-out one",
    "PSNR": "likeness of rendered and true held-out views in dB, higher is better",
    "SSIM": "likeness of their structure, 1 is equal",
    "LPIPS": "difference as a network sees it, 0 is equal",
}
"""What the figures' names mean, in one line each: tables, pages and options say it with these words."""


def explained(*terms: str) -> str:
    """One line that says what terms mean.

    Args:
        *terms: of `TERMS`.
    """
    return "; ".join(f"{term}: {TERMS[term]}" for term in terms)


def coverage(observed: NDArray[np.bool_], navigable: NDArray[np.bool_]) -> float:
    """Share of the navigable cells that were observed (C, Eq. 17).

    Args:
        observed: cells seen in a captured frame, any shape.
        navigable: cells where an agent can stand, same shape, at least one.

    Returns:
        Within [0, 1].
    """
    return float(np.sum(observed & navigable) / np.sum(navigable))


def nearest_neighbour_distance(positions: Float) -> float:
    """Mean distance from each camera to its nearest other camera (ANND, Eq. 18).

    Args:
        positions: `(n, 3)` camera centres in metres, any frame.

    Returns:
        Metres; 0.0 for fewer than two cameras.
    """
    positions = np.asarray(positions, dtype=np.float64)
    if len(positions) < 2:
        return 0.0
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    return float(distance.min(axis=1).mean())


def efficiency_index(coverage: float, images: int) -> float:
    """Coverage per captured image (EI = C / N_images); 0.0 without images.

    Args:
        coverage: within [0, 1].
        images: number of captured frames.
    """
    return coverage / images if images else 0.0


def coverage_per_view(coverages: Float, lengths: Float) -> float:
    """Percent of coverage per step (CpV = 100 · mean C / mean episode length).

    Args:
        coverages: `(n,)` final coverage of n episodes, within [0, 1].
        lengths: `(n,)` their lengths in steps.

    Returns:
        Percent per step; 0.0 without episodes.
    """
    return float(100 * np.mean(coverages) / np.mean(lengths)) if len(lengths) else 0.0


def path_length(start: Float, positions: Float) -> float:
    """Length in metres of the way from `(3,)` start through `(n, 3)` positions."""
    points = np.concatenate([np.asarray(start)[None], np.asarray(positions).reshape(-1, 3)])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


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
