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
_ORDER = np.array([1.0, np.sqrt(2), np.pi])
"""A direction along which no two triangles of a grid lie alike, in float64."""


class Fusion:
    """Depth images become a surface one at a time; what there is by now can be taken at any time.

    80 images of 640x480 pixels take about five seconds of a core.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        *,
        max_range_m: float,
        voxel_m: float = VOXEL_M,
        truncation_m: float = TRUNCATION_M,
    ) -> None:
        """Begin with nothing.

        Args:
            intrinsics: of the images.
            max_range_m: depth beyond this is left out, metres.
            voxel_m: side of a voxel, metres.
            truncation_m: see `TRUNCATION_M`.
        """
        import open3d

        core: Any = open3d.core
        self._core = core
        self._image, self._intrinsics, self._far = open3d.t.geometry.Image, intrinsics, float(max_range_m)
        self._multiplier = truncation_m / voxel_m
        one = core.SizeVector([1])
        self._voxels = open3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight"), (core.float32, core.float32), (one, one), voxel_m, _BLOCK, _BLOCKS
        )

    def add(self, depth: NDArray[np.floating], pose: NDArray[np.floating]) -> None:
        """Add a `(height, width)` planar depth in metres, 0 where nothing was hit, of a `(4, 4)` habitat pose."""
        planar = np.where((depth > 0) & (depth <= self._far), depth, 0.0).astype(np.float32)
        if not planar.any():
            return
        extrinsic = self._core.Tensor(np.linalg.inv(habitat_to_opencv(np.asarray(pose, np.float64))))
        # It looks for the blocks to fill at every fourth pixel only, between which there would be holes.
        larger = planar.repeat(_STRIDE, axis=0).repeat(_STRIDE, axis=1)
        ending = (extrinsic, 1.0, self._far, self._multiplier)
        blocks = self._voxels.compute_unique_block_coordinates(self._of(larger), self._camera(_STRIDE), *ending)
        self._voxels.integrate(blocks, self._of(planar), self._camera(1), *ending)

    def shape(self) -> Shape | None:
        """The surface that any of the images shows; None where none shows any."""
        if not self._voxels.hashmap().size():
            return None
        # A surface that a single view shows is kept.
        mesh = self._voxels.extract_triangle_mesh(weight_threshold=0.5)
        vertices, triangles = mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()
        if not len(triangles):
            return None
        # Open3D's threads give them in any order, and samples of the surface depend on it.
        place = (vertices.astype(np.float64) @ _ORDER)[triangles].sum(axis=1)
        return Shape(vertices, triangles[np.argsort(place, kind="stable")])

    def _camera(self, by: int) -> Any:
        """For images enlarged by a factor; Open3D cuts a pixel's coordinates, so it counts from corners as we do."""
        of = self._intrinsics
        fx, fy, cx, cy = (by * each for each in (of.fx, of.fy, of.cx, of.cy))
        return self._core.Tensor(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64))

    def _of(self, depth: NDArray[np.float32]) -> Any:
        return self._image(self._core.Tensor(np.ascontiguousarray(depth)))


def fuse(
    views: Iterable[tuple[NDArray[np.floating], NDArray[np.floating]]], intrinsics: Intrinsics, **settings: float
) -> Shape | None:
    """The surface that depth images with their poses show, `Fusion` of all of them by its settings."""
    fusion = Fusion(intrinsics, **settings)
    for depth, pose in views:
        fusion.add(depth, pose)
    return fusion.shape()
