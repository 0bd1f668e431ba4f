"""Whether a shape lies in a scene's frame, and in which other one it seems to lie."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.geometry.shape import Shape
from avp_habitat.geometry.truth import SceneTruth

_SAMPLES = 2000
_NEAR_M = 0.1
"""Coarser than the figures': a reconstruction is no exact copy."""
_CLEARLY = 0.2
"""Another frame explains a shape in which so much more of the scene would be found."""
_WHOLE, _NOT_WHOLE = 0.95, 0.9
"""Or one in which all of it is found, where it was not."""
_DOUBTFUL = 0.5
"""A shape of which more lies near the scene is not said to be merely moved."""
_AXES = "XYZ"


@dataclass(frozen=True)
class _Frame:
    """p' = scale · turn · p + shift, from the shape's frame to one that may be the scene's."""

    words: str
    """What is wrong with the shape where this puts it right."""
    turn: NDArray[np.float64]
    """`(3, 3)`, orthogonal."""
    scale: float
    shift: NDArray[np.float64]


def misplacement(shape: Shape, truth: SceneTruth) -> str | None:
    """What seems to be wrong with where a shape lies, in words; None where nothing does, or nothing explains it.

    Turned and mirrored frames are tried as they are, and with middle and size brought to the scene's. One explains a
    shape when much more of the scene is found in it then, and no less of it lies near the scene.

    Args:
        shape: in the frame that is to be the scene's.
        truth: of the scene.
    """
    points = shape.samples(_SAMPLES).astype(np.float64)
    seen = truth.observable[:: max(1, len(truth.observable) // _SAMPLES)].astype(np.float64)
    near, found = _near(_Frame("", np.eye(3), 1.0, np.zeros(3)), shape, points, truth, seen)
    best, words = found, None
    for frame in _frames(points, truth, moved=near < _DOUBTFUL):
        then_near, then_found = _near(frame, shape, points, truth, seen)
        if then_found > best and then_near >= max(_DOUBTFUL, near - 0.05):
            best, words = then_found, frame.words
    # The walls of a room that is mirrored are where they were: much else is not.
    explained = best >= found + _CLEARLY or (best >= _WHOLE and found <= _NOT_WHOLE)
    if words is None or not explained:
        return None
    of = f"of what can be seen {100 * found:.0f} % lie within {100 * _NEAR_M:g} cm of it"
    return f"it lies {words}: {of}, {100 * best:.0f} % would, were it put right"


def _near(
    frame: _Frame, shape: Shape, points: NDArray[np.float64], truth: SceneTruth, seen: NDArray[np.float64]
) -> tuple[float, float]:
    """Shares of the shape near the scene, and of the observable surface near the shape, by another frame."""
    there = frame.scale * points @ frame.turn.T + frame.shift
    back = (seen - frame.shift) @ frame.turn / frame.scale
    near = truth.whole.distance(there) <= _NEAR_M
    return float(near.mean()), float((frame.scale * shape.distance(back) <= _NEAR_M).mean())


def _frames(points: NDArray[np.float64], truth: SceneTruth, *, moved: bool) -> Iterator[_Frame]:
    """Turned, mirrored and scaled ones; with `moved` also such as are only moved."""
    seen = np.percentile(truth.observable, [1, 99], axis=0)
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            words = _described(order, turn)
            if words:
                yield _Frame(words, turn, 1.0, np.zeros(3))
            own = np.percentile(points @ turn.T, [1, 99], axis=0)
            scale = float(np.median((seen[1] - seen[0]) / np.maximum(own[1] - own[0], 1e-9)))
            sized = abs(scale - 1) > 0.05
            if words or sized or moved:
                size = f"{1 / scale:.4g} times as large as the scene" if sized else "elsewhere"
                shift = seen.mean(axis=0) - scale * own.mean(axis=0)
                yield _Frame(" and ".join(filter(None, [words, size])), turn, scale, shift)


def _described(order: tuple[int, ...], turn: NDArray[np.float64]) -> str:
    """How axes are exchanged, in words; nothing for axes that are right."""
    if (turn == np.eye(3)).all():
        return ""
    names = (f"{_AXES[row]} is its {'-' if turn[row, own] < 0 else ''}{_AXES[own]}" for row, own in enumerate(order))
    return f"{'turned' if np.linalg.det(turn) > 0 else 'mirrored'} (the scene's {', '.join(names)})"
