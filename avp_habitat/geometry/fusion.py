"""A mesh out of depth pictures, by a truncated signed distance function (Curless and Levoy, 1996), through Open3D."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.geometry.shape import Shape
from avp_habitat.poses import Intrinsics, habitat_to_opencv

VOXEL_M = 0.0125
"""Side of a voxel, metres."""
TRUNCATION_M = 0.04
"""Distances to the surface are known up to this, metres. More of it lets silhouettes leave more false surface."""
_BLOCK, _BLOCKS, _STRIDE = 8, 20_000, 4


def fuse(
    views: Iterable[tuple[NDArray[np.floating], NDArray[np.floating]]],
    intrinsics: Intrinsics,
    *,
    max_range_m: float,
    voxel_m: float = VOXEL_M,
    truncation_m: float = TRUNCATION_M,
) -> Shape | None:
    """Fuse depth images, one at a time; 80 of 640x480 pixels take three seconds.

    Args:
        views: `(height, width)` planar depth in metres, 0 where nothing was hit, and `(4, 4)` habitat camera_to_world.
        intrinsics: of the images.
        max_range_m: depth beyond this is left out, metres.
        voxel_m: side of a voxel, metres.
        truncation_m: see `TRUNCATION_M`.

    Returns:
        The surface that any of them shows; None where none shows any.
    """
    import open3d

    core, far = open3d.core, float(max_range_m)
    one = core.SizeVector([1])
    voxels = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), (one, one), voxel_m, _BLOCK, _BLOCKS
    )

    def camera(by: int) -> Any:
        """For images enlarged by a factor; Open3D cuts a pixel's coordinates, so it counts from corners as we do."""
        fx, fy, cx, cy = (by * each for each in (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy))
        return core.Tensor(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64))

    def image(depth: NDArray[np.float32]) -> Any:
        return open3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(depth)))

    multiplier = truncation_m / voxel_m
    for depth, pose in views:
        planar = np.where((depth > 0) & (depth <= far), depth, 0.0).astype(np.float32)
        if not planar.any():
            continue
        extrinsic = core.Tensor(np.linalg.inv(habitat_to_opencv(np.asarray(pose, np.float64))))
        # It looks for the blocks to fill at every fourth pixel only, between which there would be holes.
        larger = planar.repeat(_STRIDE, axis=0).repeat(_STRIDE, axis=1)
        blocks = voxels.compute_unique_block_coordinates(
            image(larger), camera(_STRIDE), extrinsic, 1.0, far, multiplier
        )
        voxels.integrate(blocks, image(planar), camera(1), extrinsic, 1.0, far, multiplier)
    if not voxels.hashmap().size():
        return None
    # A surface that a single view shows is kept.
    mesh = voxels.extract_triangle_mesh(weight_threshold=0.5)
    vertices, triangles = mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()
    if not len(triangles):
        return None
    # Open3D's threads give them in any order, and samples of the surface depend on it.
    return Shape(vertices, triangles[np.lexsort(vertices[triangles].sum(axis=1).T)])
