"""Random decisions that come out the same on every platform and version."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Choice = TypeVar("Choice")


class Dice:
    """A stream of decisions drawn from PCG64's doubles alone, whose bits numpy guarantees."""

    def __init__(self, seed: int, stream: int = 0) -> None:
        """Start the stream.

        Args:
            seed: 0 or greater, of any size.
            stream: which of the independent streams of that seed.
        """
        self._random = np.random.Generator(np.random.PCG64([seed, stream]))

    def array(self, shape: int | tuple[int, ...]) -> NDArray[np.float32]:
        """Uniform numbers in [0, 1) of the given shape."""
        return self._random.random(shape).astype(np.float32)

    def number(self, low: float, high: float) -> float:
        """A number in [low, high), rounded to a hundredth, so that later comparisons are robust."""
        return round(low + (high - low) * float(self._random.random()), 2)

    def whole(self, low: int, high: int) -> int:
        """A whole number from low to high, both included."""
        return low + int(float(self._random.random()) * (high - low + 1))

    def chance(self, probability: float) -> bool:
        """True with the given probability."""
        return float(self._random.random()) < probability

    def pick(self, options: Sequence[Choice]) -> Choice:
        """One of the options, with equal odds."""
        return options[self.whole(0, len(options) - 1)]

    def child(self) -> "Dice":
        """Another stream, so that what is drawn from it, or not, changes nothing here."""
        return Dice(self.whole(0, 1 << 40))

    def shuffled(self, options: Sequence[Choice]) -> list[Choice]:
        """The options in random order (Fisher-Yates)."""
        order = list(options)
        for last in range(len(order) - 1, 0, -1):
            other = self.whole(0, last)
            order[last], order[other] = order[other], order[last]
        return order
