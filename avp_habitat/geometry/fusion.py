"""A mesh out of depth pictures, by a truncated signed distance function (Curless and Levoy, 1996), through Open3D."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from avp_habitat.geometry.shape import Shape
from avp_habitat.poses import Intrinsics, habitat_to_opencv

VOXEL_M = 0.0125
"""Side of a voxel, metres."""
TRUNCATION_M = 0.04
"""Distances to the surface are known up to this, metres. More of it lets silhouettes leave more false surface."""
_BLOCK, _BLOCKS = 8, 20_000


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
    # Open3D cuts a pixel's coordinates to whole numbers, so that it counts from corners, as `Intrinsics` does.
    camera = core.Tensor(
        np.array([[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1]], np.float64)
    )
    for depth, pose in views:
        image = open3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(depth, np.float32)))
        extrinsic = core.Tensor(np.linalg.inv(habitat_to_opencv(np.asarray(pose, np.float64))))
        if not ((depth > 0) & (depth <= far)).any():
            continue
        multiplier = truncation_m / voxel_m
        blocks = voxels.compute_unique_block_coordinates(image, camera, extrinsic, 1.0, far, multiplier)
        voxels.integrate(blocks, image, camera, extrinsic, 1.0, far, multiplier)
    if not voxels.hashmap().size():
        return None
    # A surface that a single view shows is kept.
    mesh = voxels.extract_triangle_mesh(weight_threshold=0.5)
    vertices, triangles = mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()
    if not len(triangles):
        return None
    # Open3D's threads give them in any order, and samples of the surface depend on it.
    return Shape(vertices, triangles[np.lexsort(vertices[triangles].sum(axis=1).T)])
