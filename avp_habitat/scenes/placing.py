"""From a file's coordinates to the world's: axes, a local origin, and whether the result looks like a room."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from avp_habitat.errors import SceneError
from avp_habitat.poses import axes_to_world
from avp_habitat.scenes.mesh import TexturedMesh
from avp_habitat.scenes.stage_config import Y_UP, Axes

_FAR_M = 1000.0
"""From here on, float32 has steps of more than 0.06 mm."""
_LARGEST_M = 1e6
_LARGEST_ROOM_M = 200
_MOST_LOOKED_AT = 200_000


def check_numbers(mesh: TexturedMesh, path: Path) -> None:
    """Refuse what a renderer could not use.

    Raises:
        SceneError: there is no triangle, or a number is NaN or infinite.
    """
    if not len(mesh.triangles):
        raise SceneError(f"{path}: expected a mesh with triangles, found none")
    for name, values in (("position", mesh.vertices), ("texture coordinate", mesh.uv), ("colour", mesh.colours)):
        wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(wrong):
            raise SceneError(
                f"{path}: expected finite numbers, but {len(wrong)} of {len(values)} vertices have a {name} that "
                f"is NaN or infinite (the first is vertex {wrong[0]})"
            )


def lost_mm(mesh: TexturedMesh) -> float:
    """Step in millimetres of the greatest coordinate, when the file's numbers are no finer than float32; else 0."""
    largest = np.abs(mesh.vertices).max()
    if not largest < np.finfo(np.float32).max or (mesh.vertices.astype(np.float32) != mesh.vertices).any():
        return 0.0
    return 1000 * float(np.spacing(np.float32(largest)))


def place(
    mesh: TexturedMesh, axes: Axes, origin: Sequence[float] | None, name: str
) -> tuple[TexturedMesh, tuple[float, float, float]]:
    """Turn a mesh to the world's axes and move it to a local origin, in float64, before it is cut to float32.

    Along each axis on which all triangles are farther than a kilometre from zero (georeferenced scenes: UTM, ECEF),
    whole metres are taken off so that the middle comes to zero.

    Args:
        mesh: in the file's coordinates, metres.
        axes: the file's up and front.
        origin: what to take off instead, `(3,)` metres, Y up.
        name: of the scene, for errors.

    Returns:
        The mesh, and what was taken off.

    Raises:
        SceneError: it is so large, or so far from the given origin, that float32 would not hold it.
    """
    vertices = mesh.vertices.astype(np.float64)
    if axes != Y_UP:
        # Written out, because BLAS may add in another order on other machines.
        x, y, z = vertices.T
        vertices = np.stack([row[0] * x + row[1] * y + row[2] * z for row in axes_to_world(*axes)], axis=1)
    used = np.zeros(len(vertices), bool)
    used[mesh.triangles] = True
    low, high = vertices[used].min(axis=0), vertices[used].max(axis=0)
    if origin is None:
        far = (low > _FAR_M) | (high < -_FAR_M)
        origin = np.where(far, np.round(low / 2 + high / 2), 0.0).tolist()
    shift = np.asarray(origin, np.float64)
    largest = np.abs(np.stack([low - shift, high - shift])).max()
    if largest > _LARGEST_M:
        raise SceneError(
            f"{name}: has coordinates of {largest:.3g} m, where float32 cannot hold millimetres: expected a room in "
            "metres, at most 1000 km wide"
        )
    # What no triangle uses may lie anywhere.
    moved = np.clip(vertices - shift, -_LARGEST_M, _LARGEST_M).astype(np.float32)
    return replace(mesh, vertices=moved), (float(shift[0]), float(shift[1]), float(shift[2]))


def looks_z_up(mesh: TexturedMesh) -> bool:
    """Whether a mesh that is taken as Y-up looks like a room with Z up that lies on its side.

    All of these hold: along Z it is as high as a storey, and along Y clearly larger than that and than a storey; the
    two largest level planes (floor and ceiling, which nothing breaks up as windows and doors do walls) are those
    across Z; what is not a large plane, the furniture, keeps to the lower end of Z, and more so than to that of Y; and
    what is level across Y is not spread evenly as the steps of a stairwell are. The shares are those that part 31
    generated rooms, two scanned ones and a box room, laid on their sides, from 500 corridors, stairwells, attics and
    lofts that stand upright.
    """
    triangles = mesh.triangles[:: max(1, len(mesh.triangles) // _MOST_LOOKED_AT)]
    corners = mesh.vertices[triangles].astype(np.float64)
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.sqrt((crossed * crossed).sum(axis=1)) / 2
    level = np.abs(crossed) > 0.98 * 2 * area[:, None]
    middle = corners.mean(axis=1)
    middle -= middle.min(axis=0)
    extent = middle.max(axis=0)
    if not (1.9 <= extent[2] <= 5.0 and max(3.3, 1.15 * extent[2]) < extent[1] < _LARGEST_ROOM_M):
        return False
    planes, small = np.zeros(3), np.ones(len(area), bool)
    for axis in range(3):
        bins = np.minimum(middle[:, axis] / 0.1, 10 * _LARGEST_ROOM_M).astype(np.int64)
        in_bin = np.bincount(bins, weights=area * level[:, axis])
        planes[axis] = np.sort(in_bin)[-2:].sum()
        small &= ~(level[:, axis] & (in_bin[bins] > 0.02 * area.sum()))
    lower = [(area * (small & (middle[:, k] < 0.4 * extent[k]))).sum() / max(area[small].sum(), 1e-9) for k in (1, 2)]
    share = np.bincount((16 * middle[:, 1] / extent[1]).astype(np.int64), weights=area * level[:, 1])[1:15]
    return bool(
        planes[2] > 1.2 * max(planes[0], planes[1])
        and lower[1] > max(0.55, lower[0])
        and lower[0] < 0.75
        and share.std() > 0.4 * share.mean()
    )
