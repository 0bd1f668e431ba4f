"""Whether a shape lies in a scene's frame, and in which other one it seems to lie."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.geometry.shape import Shape
from avp_habitat.geometry.truth import SceneTruth

_SAMPLES = 4000
_NEAR_M = 0.1
"""Coarser than the figures': a reconstruction is no exact copy."""
_DOUBTFUL, _CLEAR = 0.9, 0.2
"""A shape is doubtful where less of it lies near the scene; another frame explains it where so much more would."""
_AXES = "XYZ"


@dataclass(frozen=True)
class _Guess:
    words: str
    points: NDArray[np.floating]


def misplacement(shape: Shape, truth: SceneTruth) -> str | None:
    """What seems to be wrong with where a shape lies, in words; None where nothing does, or nothing explains it.

    Mirrored and turned frames are tried as they are, and, for shapes of another size, with their middle and size
    brought to the scene's.

    Args:
        shape: in the frame that is to be the scene's.
        truth: of the scene.
    """
    points = shape.samples(_SAMPLES).astype(np.float64)
    least = _share_near(points, truth)
    if least >= _DOUBTFUL:
        return None
    guesses = [(_share_near(guess.points, truth), guess.words) for guess in _guesses(points, truth)]
    best, words = max(guesses, key=lambda each: each[0])
    if best < least + _CLEAR:
        return None
    near = f"within {100 * _NEAR_M:g} cm of the scene"
    return f"it lies {words}: {100 * least:.0f} % of it are {near}, {100 * best:.0f} % would be, were it put right"


def _share_near(points: NDArray[np.floating], truth: SceneTruth) -> float:
    return float((truth.whole.distance(points) <= _NEAR_M).mean())


def _guesses(points: NDArray[np.floating], truth: SceneTruth) -> Iterator[_Guess]:
    seen = np.percentile(truth.observable, [1, 99], axis=0)
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turned = points[:, order] * signs
            words = _described(order, signs)
            if words:
                yield _Guess(words, turned)
            own = np.percentile(turned, [1, 99], axis=0)
            scale = float(np.median((seen[1] - seen[0]) / np.maximum(own[1] - own[0], 1e-9)))
            moved = (turned - own.mean(axis=0)) * scale + seen.mean(axis=0)
            size = f"{1 / scale:.4g} times as large as the scene" if abs(scale - 1) > 0.05 else "elsewhere"
            yield _Guess(" and ".join(filter(None, [words, size])), moved)


def _described(order: tuple[int, ...], signs: tuple[float, ...]) -> str:
    """How axes are exchanged, in words; nothing for axes that are right."""
    if order == (0, 1, 2) and signs == (1.0, 1.0, 1.0):
        return ""
    matrix = np.zeros((3, 3))
    matrix[range(3), order] = signs
    names = ", ".join(f"{_AXES[row]} is its {'-' if signs[row] < 0 else ''}{_AXES[order[row]]}" for row in range(3))
    return f"{'turned' if np.linalg.det(matrix) > 0 else 'mirrored'} (the scene's {names})"
