"""Figures that describe a whole episode or many of them: coverage, ANND, EI, CpV, path length."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating]


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
