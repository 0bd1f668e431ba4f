"""Bit sets, 64 members to a word: member j is bit j % 64 of word j // 64."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit

Bits = NDArray[np.uint64]

ONE = np.uint64(1)


def words_for(members: int) -> int:
    """Words that hold so many bits."""
    return -(-members // 64)


def pack(members: NDArray[np.bool_]) -> Bits:
    """Bit sets `(n, words)` of `(n, m)` truth values."""
    padded = np.zeros((len(members), 64 * words_for(members.shape[1])), dtype=np.bool_)
    padded[:, : members.shape[1]] = members
    return np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64)


def unpack(sets: Bits, count: int) -> NDArray[np.bool_]:
    """`(n, count)` truth values of `(n, words)` bit sets."""
    return np.unpackbits(sets.astype("<u8").view(np.uint8), axis=1, bitorder="little")[:, :count].astype(np.bool_)


@njit(cache=True)
def size(word):
    """Number of bits set in a word, summed in parallel over ever wider fields."""
    word = word - ((word >> ONE) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True)
def lowest(word):
    """Index of the lowest bit set in a word that is not 0."""
    return size((word & (~word + ONE)) - ONE)


@njit(cache=True)
def gains(sets, missing):
    """`(n,)` how many members of `missing` `(words,)` each of `(n, words)` sets holds."""
    found = np.zeros(len(sets), np.int64)
    for i in range(len(sets)):
        for k in range(len(missing)):
            found[i] += size(sets[i, k] & missing[k])
    return found
