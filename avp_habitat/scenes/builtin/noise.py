"""Random numbers, noise and colours that come out the same on every platform and version."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Choice = TypeVar("Choice")
Field = NDArray[np.floating]
Picture = NDArray[np.uint8]
Colour = tuple[float, float, float]
Size = tuple[int, int]


class Random:
    """Random decisions drawn from PCG64's doubles alone, whose bits numpy guarantees."""

    def __init__(self, seed: int, stream: int = 0) -> None:
        """Start one of the independent streams of a seed of 0 or more."""
        self._random = np.random.Generator(np.random.PCG64([seed, stream])).random

    def array(self, shape: int | tuple[int, ...]) -> NDArray[np.float32]:
        """Uniform numbers in [0, 1) of the given shape."""
        return self._random(shape).astype(np.float32)

    def uniform(self, low: float, high: float) -> float:
        """A number in [low, high), rounded to a hundredth, so that later comparisons are robust."""
        return round(low + (high - low) * float(self._random()), 2)

    def integer(self, low: int, high: int) -> int:
        """A whole number from low to high, both included."""
        return low + int(float(self._random()) * (high - low + 1))

    def chance(self, probability: float) -> bool:
        """True with the given probability."""
        return float(self._random()) < probability

    def choice(self, options: Sequence[Choice]) -> Choice:
        """One of the options, with equal odds."""
        return options[self.integer(0, len(options) - 1)]

    def spawn(self) -> "Random":
        """Another stream, so that what is drawn from it, or not, changes nothing here."""
        return Random(self.integer(0, 1 << 40))

    def shuffled(self, options: Sequence[Choice]) -> list[Choice]:
        """The options in random order (Fisher-Yates)."""
        order = list(options)
        for last in range(len(order) - 1, 0, -1):
            other = self.integer(0, last)
            order[last], order[other] = order[other], order[last]
        return order


def _stretch(lattice: Field, length: int) -> Field:
    """Rows of a periodic lattice, interpolated smoothly to `length` rows."""
    rows = len(lattice)
    position = np.arange(length, dtype=np.float32) * np.float32(rows / length)
    index = position.astype(np.int64)
    part = position - index
    part = (part * part * (3 - 2 * part)).reshape(-1, *[1] * (lattice.ndim - 1))
    return lattice[index % rows] * (1 - part) + lattice[(index + 1) % rows] * part


def value_noise(rng: Random, size: Size, cells: Size) -> Field:
    """`(height, width)` periodic noise in [0, 1] with `cells` (rows, columns) of random values."""
    lattice = rng.array(cells)
    return np.ascontiguousarray(_stretch(np.ascontiguousarray(_stretch(lattice, size[0]).T), size[1]).T)


def fractal(rng: Random, size: Size, cells: Size, octaves: int = 4, gain: float = 0.5) -> Field:
    """`(height, width)` periodic sum of ever finer and weaker noise, in [0, 1]."""
    total, weight, sum_of_weights = np.zeros(size, np.float32), 1.0, 0.0
    rows, columns = cells
    for _ in range(octaves):
        total += np.float32(weight) * value_noise(rng, size, (min(rows, size[0]), min(columns, size[1])))
        sum_of_weights += weight
        rows, columns, weight = rows * 2, columns * 2, weight * gain
    return total / np.float32(sum_of_weights)


def grid(height: int, width: int) -> tuple[Size, Field, Field]:
    """The size of a picture, and of its shape u to the right and v downwards in (0, 1), at pixel centres."""
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    return (height, width), (u + np.float32(0.5)) / np.float32(width), (v + np.float32(0.5)) / np.float32(height)


def plain(size: Size, colour: Colour) -> Field:
    """`(height, width, 3)` of one colour."""
    return np.broadcast_to(np.asarray(colour, np.float32), (*size, 3)).copy()


def mix(first: Field, second: Colour | Field, share: Field | float) -> Field:
    """Blend two colour fields; `share` (height, width) in [0, 1] is that of the second."""
    share = np.asarray(share, np.float32)
    share = share[..., None] if share.ndim == 2 else share
    blended = np.asarray(second, np.float32) - first
    blended *= share
    blended += first
    return blended


def shade(colour: Colour, factor: float) -> Colour:
    """A lighter or darker colour, within [0, 1]."""
    red, green, blue = (min(max(part * factor, 0.0), 1.0) for part in colour)
    return red, green, blue


def blend(first: Colour, second: Colour, share: float) -> Colour:
    """The colour between two colours; `share` is that of the second."""
    red, green, blue = (a + (b - a) * share for a, b in zip(first, second, strict=True))
    return red, green, blue


def step(value: Field, edge: float | Field, width: float) -> Field:
    """0 below the edge, 1 above it, with a linear transition of the given width."""
    risen = (value - np.float32(edge)) * np.float32(1 / width)
    risen += np.float32(0.5)
    return np.clip(risen, 0, 1, out=risen)


def wave(value: Field) -> Field:
    """Triangle wave of period 1 in [0, 1]; 0 at whole numbers."""
    rest = value - np.floor(value)
    return 2 * np.minimum(rest, 1 - rest)


def cosine_of_multiple(u: Field, v: Field, count: int) -> Field:
    """cos(count x angle) of the direction (u, v), by Chebyshev's recurrence.

    Arithmetic alone, because processors differ in the last bits of their cosines and pictures must not.
    """
    cosine = u / np.sqrt(u * u + v * v + np.float32(1e-12))
    before, now = np.ones_like(cosine), cosine
    for _ in range(count - 1):
        before, now = now, 2 * cosine * now - before
    return now


def turn_of(u: Field, v: Field) -> Field:
    """A number that rises from 0 to 1 with the direction of (u, v) around the origin, though not evenly."""
    share = u / (np.abs(u) + np.abs(v) + np.float32(1e-12))
    return np.where(v >= 0, 1 - share, 3 + share) / 4


def to_picture(rgb: Field) -> Picture:
    """`(height, width, 3)` colours in [0, 1] as bytes."""
    return np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
