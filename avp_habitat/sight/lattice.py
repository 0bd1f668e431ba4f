"""Columns with a row for every place of a lattice over the floor, growing tile by tile where agents come."""

import hashlib
import io
import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.files import atomic_file
from avp_habitat.navigation.area import NavigableArea

Columns = Mapping[str, NDArray]

CACHE_VARIABLE = "AVP_CACHE"
"""Environment variable that names the folder of the cache; empty keeps nothing on disk."""
TILE = 16
"""Lattice points along a tile's side; a tile is the piece that is computed and kept at a time."""
MARGIN_M = 0.08
"""Less than an agent's radius: a camera this far outside of the area is still before the wall."""

_DIGEST_BYTES = 32
_PLACES_PER_CALL = 64


@dataclass(frozen=True)
class Lattice:
    """Points `origin + spacing_m · (i, j)`, i along x and j along z."""

    area: NavigableArea
    """Where agents stand."""
    spacing_m: float
    """Distance between neighbouring points, metres."""

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Number of points along x and z; every place in the area has four points around it."""
        rows, columns = self.area.mask.shape
        share = self.area.cell_m / self.spacing_m
        return int(np.ceil(columns * share)) + 2, int(np.ceil(rows * share)) + 2

    def around(self, position: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The `(k, 4, 2)` i and j of the lattice points around `(k, 3)` places over the area, metres.

        With them their `(k, 4)` weights of bilinear interpolation, which sum to 1.
        """
        return _around(np.asarray(position, dtype=np.float64), self.area.origin, self.spacing_m, self.shape)

    def feet(self, points: NDArray[np.integer]) -> NDArray[np.float64]:
        """`(k, 3)` where a camera's agent stands for `(k, 2)` lattice points, metres.

        A point outside of the area keeps its place as far as `MARGIN_M` from it, so that an agent at a wall lies
        between the places of its lattice points; farther ones are drawn back to that distance, before the wall.
        """
        plane = self.area.origin + self.spacing_m * np.asarray(points)
        wanted = np.stack([plane[:, 0], np.zeros(len(plane)), plane[:, 1]], axis=1)
        inside = self.area.nearest(wanted)
        out = np.linalg.norm(wanted - inside, axis=1, keepdims=True)
        place = inside + (wanted - inside) * np.minimum(1.0, MARGIN_M / np.maximum(out, 1e-9))
        place[:, 1] = self.area.floor_height(place)
        return place

    def points_of_tile(self, tile: tuple[int, int]) -> NDArray[np.int64]:
        """`(k, 2)` the points of a tile that an agent may need: those next to a navigable cell."""
        low = np.array(tile) * TILE
        high = np.minimum(low + TILE, self.shape)
        grid = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1).reshape(-1, 2)
        return grid[self._near_floor()[grid[:, 0], grid[:, 1]]]

    def _near_floor(self) -> NDArray[np.bool_]:
        """`shape` which points have the centre of a navigable cell less than a spacing and a cell away, each way."""
        near = np.zeros(self.shape, dtype=np.bool_)
        row, column = np.nonzero(self.area.mask)
        at = (np.stack([column, row], axis=1) + 0.5) * self.area.cell_m
        reach = self.area.cell_m + self.spacing_m
        low = np.maximum(np.ceil((at - reach) / self.spacing_m), 0).astype(np.int64)
        high = np.minimum(np.floor((at + reach) / self.spacing_m), np.array(self.shape) - 1).astype(np.int64)
        for i in range(int((high - low).max()) + 1):
            for j in range(int((high - low).max()) + 1):
                point = np.minimum(low + [i, j], high)
                near[point[:, 0], point[:, 1]] = True
        return near


@njit(cache=True)
def _around(position, origin, spacing_m, shape):
    """`Lattice.around`; `origin` `(2,)` is x and z of the first point."""
    points, weights = np.empty((len(position), 4, 2), np.int64), np.empty((len(position), 4))
    for k in range(len(position)):
        x, z = (position[k, 0] - origin[0]) / spacing_m, (position[k, 2] - origin[1]) / spacing_m
        i, j = min(max(np.floor(x), 0.0), shape[0] - 2.0), min(max(np.floor(z), 0.0), shape[1] - 2.0)
        across, up = min(max(x - i, 0.0), 1.0), min(max(z - j, 0.0), 1.0)
        for corner in range(4):
            di, dj = corner // 2, corner % 2
            points[k, corner, 0], points[k, corner, 1] = int(i) + di, int(j) + dj
            weights[k, corner] = (across if di else 1 - across) * (up if dj else 1 - up)
    return points, weights


def cache_folder() -> Path | None:
    """Where tables are kept: `$AVP_CACHE`, else `avp` in the user's cache folder.

    None when `$AVP_CACHE` is empty, or the user has no home, as in some containers.
    """
    chosen = os.environ.get(CACHE_VARIABLE)
    if chosen is not None:
        return Path(chosen) if chosen else None
    caches = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return caches / "avp" if caches.is_absolute() else None


class TileFiles:
    """The files of one table: an unsound one is made anew, one that cannot be written costs a warning.

    Each is an `.npz` with the SHA-256 behind it of what it should be (table, tile, points, columns) and what it holds.
    """

    def __init__(self, name: str) -> None:
        """Use the folder `name` of the cache."""
        self._name, folder = name, cache_folder()
        self._folder = None if folder is None else folder / "tables" / name

    def read(self, tile: tuple[int, int], points: NDArray[np.integer], like: Columns) -> dict[str, NDArray] | None:
        """A tile's columns, or None where there is no sound file for these `(k, 2)` points and columns."""
        try:
            data = b"" if self._folder is None else _path(self._folder, tile).read_bytes()
        except OSError:
            return None
        content, digest = data[:-_DIGEST_BYTES], data[-_DIGEST_BYTES:]
        if digest != self._digest(tile, points, like, content):
            return None
        with np.load(io.BytesIO(content)) as file:
            return {name: file[name] for name in like}

    def write(self, tile: tuple[int, int], points: NDArray[np.integer], columns: Columns) -> None:
        """Keep a tile; a full or read-only disk costs a warning."""
        if self._folder is None:
            return
        buffer = io.BytesIO()
        np.savez(buffer, **columns)  # type: ignore[arg-type]
        content = buffer.getvalue()
        try:
            with atomic_file(_path(self._folder, tile)) as partial:
                partial.write_bytes(content + self._digest(tile, points, columns, content))
        except OSError as error:
            warnings.warn(f"{self._folder}: tables are not kept: {error}", stacklevel=2)
            self._folder = None

    def _digest(self, tile: tuple[int, int], points: NDArray[np.integer], columns: Columns, content: bytes) -> bytes:
        layout = [(name, column.dtype.str, column.shape[1:]) for name, column in columns.items()]
        return hashlib.sha256(f"{self._name} {tile} {layout}".encode() + points.tobytes() + content).digest()


def _path(folder: Path, tile: tuple[int, int]) -> Path:
    return folder / f"tile_{tile[0]}_{tile[1]}.npz"


class PlaceTable:
    """The rows of the places asked for so far; whole tiles of them are kept on disk."""

    def __init__(
        self, lattice: Lattice, name: str, empty: Columns, compute: Callable[[NDArray[np.floating]], Columns]
    ) -> None:
        """Make an empty table.

        Args:
            lattice: the places.
            name: of its files: a digest of all that the columns follow from.
            empty: each column by name, without rows.
            compute: the columns of `(k, 3)` feet, metres.
        """
        self.lattice, self.name = lattice, name
        self.columns = dict(empty)
        """By name; the first axis of each is the slot."""
        self._files = TileFiles(name)
        self._empty = empty
        self._compute = compute
        self._slot = np.full(lattice.shape, -1, dtype=np.int32)
        self._slots = 0
        self._tiles: set[tuple[int, int]] = set()

    def around(self, position: NDArray[np.floating]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """The `(k, 4)` slots around `(k, 3)` feet in metres, made now where they are new, and their weights."""
        points, weight = self.lattice.around(position)
        slots = self._slot[points[..., 0], points[..., 1]]
        if (slots < 0).any():
            self._make(points[slots < 0])
            slots = self._slot[points[..., 0], points[..., 1]]
        return slots, weight.astype(np.float32)

    def _make(self, points: NDArray[np.integer]) -> None:
        for tile in sorted({(int(i), int(j)) for i, j in points // TILE} - self._tiles):
            self._tiles.add(tile)
            wanted = self.lattice.points_of_tile(tile)
            rows = self._files.read(tile, wanted, self._empty)
            if rows is None:
                rows = self._rows_of(wanted)
                self._files.write(tile, wanted, rows)
            self._add(wanted, rows)
        # An agent in a sliver of floor too thin to hold a cell's centre stands beside points that no tile has.
        lacking = np.unique(points[self._slot[points[:, 0], points[:, 1]] < 0], axis=0)
        if len(lacking):
            self._add(lacking, self._rows_of(lacking))

    def _add(self, points: NDArray[np.integer], rows: Columns) -> None:
        self._slot[points[:, 0], points[:, 1]] = np.arange(len(points)) + self._slots
        self._slots += len(points)
        for name, column in rows.items():
            self.columns[name] = np.concatenate([self.columns[name], column])

    def _rows_of(self, points: NDArray[np.integer]) -> Columns:
        feet = self.lattice.feet(points)
        calls = [feet[start : start + _PLACES_PER_CALL] for start in range(0, len(feet), _PLACES_PER_CALL)]
        parts = [self._empty, *map(self._compute, calls)]
        return {name: np.concatenate([part[name] for part in parts]) for name in self._empty}
