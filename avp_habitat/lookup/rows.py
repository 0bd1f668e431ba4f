"""A table with a row for every place of a lattice, growing tile by tile with the places that are asked for."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from avp_habitat.lookup.disk import TileFiles
from avp_habitat.lookup.lattice import TILE, Lattice

_PLACES_PER_CALL = 64


def words_for(bits: int) -> int:
    """Words of 64 bits that hold so many bits."""
    return -(-bits // 64)


class PlaceRows:
    """The rows of the places asked for so far; whole tiles of them are kept on disk."""

    def __init__(
        self,
        lattice: Lattice,
        files: TileFiles,
        empty: dict[str, NDArray],
        compute: Callable[[NDArray[np.floating]], dict[str, NDArray]],
    ) -> None:
        """Make an empty table.

        Args:
            lattice: the places.
            files: where finished tiles lie.
            empty: each column by name, without rows.
            compute: the columns of `(k, 3)` feet, metres.
        """
        self.columns = dict(empty)
        """By name; the first axis of each is the slot."""
        self._empty = empty
        self._lattice = lattice
        self._files = files
        self._compute = compute
        self._slot = np.full(lattice.shape, -1, dtype=np.int32)
        self._slots = 0
        self._tiles: set[tuple[int, int]] = set()

    def around(self, position: NDArray[np.floating]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """The slots around places, made now where they are new.

        Args:
            position: `(k, 3)` feet, metres.

        Returns:
            `(k, 4)` slots and `(k, 4)` weights that sum to 1.
        """
        points, weight = self._lattice.around(position)
        slots = self._slot[points[..., 0], points[..., 1]]
        if (slots < 0).any():
            self._make(points[slots < 0])
            slots = self._slot[points[..., 0], points[..., 1]]
        return slots, weight.astype(np.float32)

    def _make(self, points: NDArray[np.integer]) -> None:
        for tile in sorted({(int(i), int(j)) for i, j in points // TILE} - self._tiles):
            self._tiles.add(tile)
            wanted = self._lattice.points_of_tile(tile)
            rows = self._files.read(tile, wanted, self._empty)
            if rows is None:
                rows = self._rows_of(wanted)
                self._files.write(tile, wanted, rows)
            self._add(wanted, rows)
        # An agent in a sliver of floor too thin to hold a cell's centre stands beside points that no tile has.
        lacking = np.unique(points[self._slot[points[:, 0], points[:, 1]] < 0], axis=0)
        if len(lacking):
            self._add(lacking, self._rows_of(lacking))

    def _add(self, points: NDArray[np.integer], rows: dict[str, NDArray]) -> None:
        self._slot[points[:, 0], points[:, 1]] = np.arange(len(points)) + self._slots
        self._slots += len(points)
        for name, column in rows.items():
            self.columns[name] = np.concatenate([self.columns[name], column])

    def _rows_of(self, points: NDArray[np.integer]) -> dict[str, NDArray]:
        feet = self._lattice.feet(points)
        parts = [self._empty]
        for start in range(0, len(feet), _PLACES_PER_CALL):
            parts.append(self._compute(feet[start : start + _PLACES_PER_CALL]))
        return {name: np.concatenate([part[name] for part in parts]) for name in self._empty}
