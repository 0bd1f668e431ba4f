"""Triangles that can be sampled, measured from, and looked at."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, pixel_directions

Float = NDArray[np.floating]


class Shape:
    """A triangle mesh, world frame, metres; both sides of its triangles are surface."""

    def __init__(self, vertices: Float, triangles: NDArray[np.integer]) -> None:
        """Take `(v, 3)` vertices and `(t, 3)` indices of them, at least one triangle."""
        import open3d

        self.vertices = np.ascontiguousarray(vertices, np.float32)
        self.triangles = np.ascontiguousarray(triangles, np.uint32)
        self._tensor = open3d.core.Tensor.from_numpy
        self._rays = open3d.t.geometry.RaycastingScene()
        self._rays.add_triangles(self._tensor(self.vertices), self._tensor(self.triangles))

    @property
    def bounds(self) -> NDArray[np.float64]:
        """`(2, 3)` least and greatest corner of the triangles, metres."""
        used = self.vertices[np.unique(self.triangles)].astype(np.float64)
        return np.stack([used.min(axis=0), used.max(axis=0)])

    def samples(self, count: int, seed: int = 0) -> NDArray[np.float32]:
        """`(count, 3)` points, uniform over the area; the same ones for the same seed."""
        a, b, c = self.vertices[self.triangles].astype(np.float64).transpose(1, 0, 2)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        if not area.sum() > 0:
            area[:] = 1.0  # Triangles that are all lines or points.
        rng = np.random.default_rng(seed)
        chosen = rng.choice(len(area), count, p=area / area.sum())
        along = rng.random((2, count))
        # What lies beyond the triangle in its parallelogram is turned back into it.
        u, v = np.where(along.sum(axis=0) > 1, 1 - along, along)[..., None]
        return (a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]).astype(np.float32)

    def distance(self, points: Float) -> NDArray[np.float32]:
        """`(n,)` metres from `(n, 3)` points to the nearest place of any triangle."""
        return self._rays.compute_distance(self._tensor(np.ascontiguousarray(points, np.float32))).numpy()

    def reached(self, eye: Float, points: Float, tolerance_m: float) -> NDArray[np.bool_]:
        """`(n,)` whether nothing lies between a place and `(n, 3)` points but within the tolerance before them."""
        offset = points - eye
        distance = np.linalg.norm(offset, axis=1, keepdims=True)
        ends = offset * np.maximum(1 - tolerance_m / np.maximum(distance, 1e-9), 0.0)
        rays = np.concatenate([np.broadcast_to(eye, points.shape), ends], axis=1, dtype=np.float32)
        return ~self._rays.test_occlusions(self._tensor(rays), tnear=0.0, tfar=1.0).numpy()

    def depth(self, camera_to_world: Float, intrinsics: Intrinsics) -> NDArray[np.float32]:
        """`(n, height, width)` planar depth in metres of `(n, 4, 4)` habitat poses, 0 where nothing is hit."""
        directions = np.einsum("nij,hwj->nhwi", camera_to_world[:, :3, :3], pixel_directions(intrinsics))
        origins = np.broadcast_to(camera_to_world[:, None, None, :3, 3], directions.shape)
        rays = np.concatenate([origins, directions], axis=-1, dtype=np.float32)
        found = self._rays.cast_rays(self._tensor(rays))["t_hit"].numpy()
        return np.where(np.isfinite(found), found, 0.0)
