"""Greedy set cover over bit sets."""

import numpy as np
from numpy.typing import NDArray

Bits = NDArray[np.uint64]


def greedy_cover(sets: Bits, wanted: Bits, limit: int | None = None) -> list[int]:
    """Take the set that adds most, again and again, until nothing is added.

    After k sets the cover is at least 1 - 1/e of the largest that any k sets reach (Nemhauser, Wolsey and Fisher
    1978, "An analysis of approximations for maximizing submodular set functions", proposition 4.3).

    Args:
        sets: `(n, words)` bit sets.
        wanted: `(words,)` the members that count.
        limit: most sets to take; all that add something when left out.

    Returns:
        Numbers of the chosen sets in the order of choice; of equals the first.
    """
    from avp_habitat.oracle.kernels import gains

    chosen: list[int] = []
    missing = wanted.copy()
    while len(sets) and (limit is None or len(chosen) < limit):
        gain = gains(sets, missing)
        best = int(np.argmax(gain))
        if gain[best] == 0:
            break
        chosen.append(best)
        missing &= ~sets[best]
    return chosen
