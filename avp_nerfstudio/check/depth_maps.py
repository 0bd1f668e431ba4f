"""A rollout's depth pictures, thinned so that thousands of frames fit in memory and can be compared with each other."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, pixel_directions
from avp_habitat.rollout.format import View
from avp_habitat.rollout.images import read_depth

Float = NDArray[np.floating]

GRID_WIDTH = 160
"""Columns of the thinned depth: every fourth pixel of a 640 wide picture."""
BEND_M = 0.02
"""A cell is compared only where its depth is that of a plane within so much, metres; edges are left out."""
POINTS = 2400
"""Points of a frame, at most, that are looked for in other frames."""


@dataclass(frozen=True)
class DepthMaps:
    """Thinned depth of n pictures as inverse depth, which is linear in the pixel coordinates on every plane.

    A *cell* lies between four neighbouring samples of the grid; on planes, interpolation within it is exact.
    """

    stride: int
    """Pixels of the picture from one sample to the next."""
    inverse: NDArray[np.float32]
    """`(n, rows, columns)` 1/m at the pixels (stride * row, stride * column), 0 where there is no depth."""
    flat: NDArray[np.bool_]
    """`(n, rows - 1, columns - 1)` cells that hold one smooth surface."""
    samples: NDArray[np.int32]
    """`(n, p)` flat indices (row * columns + column) of each frame's points; repeated where a frame has fewer."""
    counts: NDArray[np.int64]
    """`(n,)` points that are not repetitions; 0 for a frame without a smooth surface."""

    def __len__(self) -> int:
        """Number of pictures."""
        return len(self.inverse)

    def camera(self, intrinsics: Intrinsics) -> Intrinsics:
        """The camera whose pixel centres are the grid's samples, from that of the whole pictures."""
        (rows, columns), s, k = self.inverse.shape[1:], self.stride, intrinsics
        return Intrinsics(columns, rows, k.fx / s, k.fy / s, (k.cx - 0.5) / s + 0.5, (k.cy - 0.5) / s + 0.5)

    def local_points(self, intrinsics: Intrinsics, frames: NDArray[np.integer], count: int) -> Float:
        """`(m, min(p, count), 3)` points in metres of m frames, each in its own camera's habitat axes."""
        directions = pixel_directions(self.camera(intrinsics)).reshape(-1, 3)
        samples = self.samples[frames, :count]
        inverse = self.inverse.reshape(len(self), -1)[frames[:, None], samples]
        return directions[samples] / np.maximum(inverse, 1e-3)[..., None]

    def surface(self, frame: int, pose: Float, intrinsics: Intrinsics, count: int = POINTS) -> tuple[Float, Float]:
        """At most `count` world points of one picture with their surface normals.

        Returns:
            `(m, 3)` metres and `(m, 3)` unit vectors, whose sense means nothing.
        """
        columns = self.inverse.shape[2]
        first = self.samples[frame, : min(count, int(self.counts[frame]))]
        directions = pixel_directions(self.camera(intrinsics)).reshape(-1, 3)
        inverse = self.inverse[frame].reshape(-1)
        point, right, below = (directions[i] / inverse[i, None] for i in (first, first + 1, first + columns))
        normal = np.cross(right - point, below - point)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        return point @ pose[:3, :3].T + pose[:3, 3], normal @ pose[:3, :3].T

    def look_up(self, frame: int, pixel: Float) -> tuple[Float, NDArray[np.bool_]]:
        """Depth of one picture at `(m, 2)` pixels of the grid's camera, sample centres at +0.5; any number, also NaN.

        Returns:
            `(m,)` metres and `(m,)` whether there is a smooth surface there; elsewhere the depth means nothing.
        """
        rows, columns = self.inverse.shape[1:]
        place = np.asarray(pixel, dtype=np.float32) - np.float32(0.5)
        with np.errstate(invalid="ignore"):
            inside = (place >= 0).all(axis=1) & (place[:, 0] < columns - 1) & (place[:, 1] < rows - 1)
        place = np.where(inside[:, None], place, np.float32(0))
        column, row = place.astype(np.int32).T
        right, down = place[:, 0] - column, place[:, 1] - row
        index = row * columns + column
        flat = self.inverse[frame].reshape(-1)
        upper = flat[index] * (1 - right) + flat[index + 1] * right
        lower = flat[index + columns] * (1 - right) + flat[index + columns + 1] * right
        inverse = upper * (1 - down) + lower * down
        return 1 / np.maximum(inverse, np.float32(1e-3)), inside & self.flat[frame, row, column]


def load_depth_maps(
    views: Sequence[View], intrinsics: Intrinsics, *, progress: Callable[[], object] = lambda: None
) -> DepthMaps:
    """Decode and thin the depth of at least one view; `progress` is called after each.

    Raises:
        RolloutError: a depth picture cannot be decoded.
    """
    stride = max(1, round(intrinsics.width / GRID_WIDTH))
    parts = []
    for index, view in enumerate(views):
        parts.append(_thin(read_depth(view.depth), stride, np.random.default_rng(index)))
        progress()
    inverse, flat, samples, counts = (np.stack(values) for values in zip(*parts, strict=True))
    return DepthMaps(stride, inverse, flat, samples, counts)


def _thin(depth: Float, stride: int, rng: np.random.Generator) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Inverse depth at the samples, smooth cells, and where this picture's points are."""
    with np.errstate(divide="ignore"):
        full = np.where(depth > 0, 1 / depth, 0).astype(np.float32)
    inverse = full[::stride, ::stride]
    flat = _flat_cells(inverse) & _flat_inside(full, inverse, stride)
    usable = np.zeros(inverse.shape, bool)
    usable[:-1, :-1] = flat
    found = np.flatnonzero(usable)
    if not len(found):
        return inverse, flat, np.zeros(POINTS, np.int32), np.array(0)
    # Drawn at random, so that the first few of them are spread over the picture too.
    order = rng.permutation(found)[:POINTS].astype(np.int32)
    return inverse, flat, np.resize(order, POINTS), np.array(len(order))


def _flat_cells(inverse: Float) -> NDArray[np.bool_]:
    """Cells at whose four corners the inverse depth bends little; a bend b of 1/z is one of b z² in depth."""
    padded = np.pad(inverse, 1, mode="reflect", reflect_type="odd")
    bend = np.maximum(
        np.abs(padded[1:-1, 2:] - 2 * inverse + padded[1:-1, :-2]),
        np.abs(padded[2:, 1:-1] - 2 * inverse + padded[:-2, 1:-1]),
    )
    smooth = (inverse > 0) & (bend < BEND_M * inverse**2)
    twist = np.abs(inverse[1:, 1:] + inverse[:-1, :-1] - inverse[1:, :-1] - inverse[:-1, 1:])
    corners = smooth[1:, 1:] & smooth[:-1, :-1] & smooth[1:, :-1] & smooth[:-1, 1:]
    return corners & (twist < BEND_M * inverse[1:, 1:] ** 2)


def _flat_inside(full: Float, inverse: Float, stride: int) -> NDArray[np.bool_]:
    """Cells all of whose pixels lie on the surface spanned by the corners: nothing thin stands between them."""
    rows, columns = inverse.shape[0] - 1, inverse.shape[1] - 1
    flat = np.ones((rows, columns), bool)
    limit = BEND_M * inverse[:-1, :-1] ** 2
    for down in range(stride):
        for right in range(stride):
            y, x = down / stride, right / stride
            upper = inverse[:-1, :-1] * (1 - x) + inverse[:-1, 1:] * x
            lower = inverse[1:, :-1] * (1 - x) + inverse[1:, 1:] * x
            seen = full[down::stride, right::stride][:rows, :columns]
            flat &= np.abs(seen - (upper * (1 - y) + lower * y)) < limit
    return flat
