"""The embedded simulator: Embree ray casting, through Open3D, on the CPU."""

from functools import cached_property, lru_cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, pixel_directions
from avp_habitat.simulators.base import Frames

if TYPE_CHECKING:
    from avp_habitat.navigation.area import NavigableArea
    from avp_habitat.scenes.loader import Scene
    from avp_habitat.scenes.mesh import TexturedMesh
    from avp_habitat.simulators.shading import Surface

_RAYS_PER_CALL = 1 << 20
_BEYOND_M = np.float32(1e-4)
"""How far behind a hole of a surface its rays begin anew, in metres."""


class RaycastSimulator:
    """A scene seen by casting rays; surfaces are unlit and seen from both sides.

    Rendering is deterministic: the same poses give the same bytes on any number of threads.
    """

    name = "raycast"

    def __init__(self, scene: "Scene", navmesh: Path | None = None) -> None:
        """Build the ray-tracing structure of `scene` (about a second per million triangles).

        Args:
            scene: in memory.
            navmesh: file of the scene's NavMesh, as Habitat-Sim keeps it, instead of the area that is computed.
        """
        self.scene = scene.name
        self.scene_digest = scene.digest
        self.scene_frame = scene.frame
        self.version = f"open3d {metadata.version('open3d')}"
        self._mesh, self._navmesh = scene.mesh, navmesh
        self._rays = _Rays(scene.mesh)

    @property
    def area(self) -> "NavigableArea":
        """Where agents can stand; computed when first asked for.

        Raises:
            SceneError: the scene has no floor on which an agent can stand, or the NavMesh is not that of the scene.
        """
        return self._area

    @cached_property
    def _area(self) -> "NavigableArea":
        from avp_habitat.navigation.build import build_area
        from avp_habitat.navigation.settings import NavigationSettings
        from avp_habitat.scenes.mesh import without_holes

        solid = without_holes(self._mesh, NavigationSettings.voxel_m)
        own = build_area(solid, self.surface_below)
        if self._navmesh is None:
            return own
        from avp_habitat.navigation.navmesh import area_of_file

        vertices = self._mesh.vertices[np.unique(self._mesh.triangles)]
        bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)]).astype(np.float64)
        return area_of_file(self._navmesh, own, self.surface_below, bounds)

    @cached_property
    def _surface(self) -> "Surface":
        from avp_habitat.simulators.shading import pack_surface

        return pack_surface(self._mesh)

    def render(self, camera_to_world: NDArray[np.floating], intrinsics: Intrinsics, *, rgb: bool) -> Frames:
        """Depth, and colour when asked for, of `(n, 4, 4)` habitat poses; black where a ray leaves the scene."""
        poses = np.asarray(camera_to_world, dtype=np.float64)
        shape = (len(poses), intrinsics.height, intrinsics.width)
        depth = np.empty(shape, np.float32)
        colour = np.empty((*shape, 3), np.uint8) if rgb else None
        count = max(1, _RAYS_PER_CALL // (intrinsics.height * intrinsics.width))
        for start in range(0, len(poses), count):
            chunk = slice(start, start + count)
            rays = _camera_rays(poses[chunk], intrinsics)
            hits = self._rays.cast(rays)
            distance = hits["t_hit"]
            depth[chunk] = np.where(np.isfinite(distance), distance, 0).reshape(depth[chunk].shape)
            if colour is not None:
                colour[chunk] = self._shade(poses[chunk], intrinsics, rays, hits).reshape(colour[chunk].shape)
        return Frames(colour, depth)

    def _shade(
        self, poses: NDArray[np.floating], intrinsics: Intrinsics, rays: NDArray[np.float32], hits: dict[str, NDArray]
    ) -> NDArray[np.uint8]:
        from avp_habitat.simulators.shading import Hits, shade

        # Directions are linear in the pixel coordinates, so their differences are the same all over the image.
        corner = pixel_directions(Intrinsics(2, 2, intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy))
        right, down = corner[0, 1] - corner[0, 0], corner[1, 0] - corner[0, 0]
        rotation = poses[:, :3, :3]
        return shade(
            self._surface,
            Hits(
                rays[..., 3:],
                hits["t_hit"],
                hits["primitive_ids"],
                hits["primitive_uvs"],
                np.ascontiguousarray(rotation @ right),
                np.ascontiguousarray(rotation @ down),
            ),
        )

    def visible(
        self,
        camera_to_world: NDArray[np.floating],
        intrinsics: Intrinsics,
        points: NDArray[np.floating],
        pairs: NDArray[np.integer],
        *,
        tolerance_m: float,
    ) -> NDArray[np.bool_]:
        """Whether cameras see points; see `simulators.base.Simulator.visible`."""
        from avp_habitat.sight.rules import pairs_in_image

        seen = pairs_in_image(camera_to_world, intrinsics, points, pairs)
        eye = np.asarray(camera_to_world)[:, :3, 3]
        seen[seen] = self.reached(eye, points, pairs[seen], tolerance_m=tolerance_m)
        return seen

    def reached(
        self, eye: NDArray[np.floating], points: NDArray[np.floating], pairs: NDArray[np.integer], *, tolerance_m: float
    ) -> NDArray[np.bool_]:
        """Whether rays reach points in any direction; see `simulators.base.SingleRays.reached`."""
        from avp_habitat.sight.rules import rays_to_points

        rays, near = rays_to_points(eye, points, pairs, tolerance_m)
        return near | ~self._rays.blocked(rays)

    def distance(self, origin: NDArray[np.floating], direction: NDArray[np.floating]) -> NDArray[np.float32]:
        """Length of rays up to the first surface; see `simulators.base.SingleRays.distance`."""
        return self._rays.cast(np.concatenate([origin, direction], axis=1, dtype=np.float32))["t_hit"]

    def surface_below(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """`(n,)` heights y in metres of the first surface straight below `(n, 3)` points; NaN where there is none."""
        points = np.asarray(points, dtype=np.float64)
        rays = np.concatenate([points, np.broadcast_to([0.0, -1.0, 0.0], points.shape)], axis=1).astype(np.float32)
        distance = self._rays.cast(rays)["t_hit"].astype(np.float64)
        height = points[:, 1] - distance
        height[~np.isfinite(distance)] = np.nan
        return height

    def surface_mesh(self) -> "TexturedMesh":
        """All surfaces; see `simulators.base.Meshed.surface_mesh`."""
        return self._mesh

    def close(self) -> None:
        """Free nothing: the memory goes with the object."""


@lru_cache(maxsize=8)
def _pixel_columns(intrinsics: Intrinsics) -> NDArray[np.floating]:
    """`(3, pixels)` camera-frame directions, one contiguous row per axis."""
    return np.ascontiguousarray(pixel_directions(intrinsics).reshape(-1, 3).T)


def _camera_rays(poses: NDArray[np.floating], intrinsics: Intrinsics) -> NDArray[np.float32]:
    """`(n, pixels, 6)` origins and directions, world frame.

    Written out as sums instead of a matrix product: BLAS may add in another order on another number of threads.
    """
    x, y, z = _pixel_columns(intrinsics)
    rays = np.empty((len(poses), len(x), 6), np.float32)
    rays[..., :3] = poses[:, None, :3, 3]
    for axis in range(3):
        row = poses[:, axis, :3, None]
        rays[..., 3 + axis] = row[:, 0] * x + row[:, 1] * y + row[:, 2] * z
    return rays


class _Rays:
    """Open3D's ray-casting scene with numpy arrays going in and out; rays go on through holes of masked surfaces."""

    def __init__(self, mesh: "TexturedMesh") -> None:
        import open3d

        self._masked = mesh if mesh.masks else None
        self._tensor = open3d.core.Tensor.from_numpy
        self._scene: Any = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(mesh.vertices, np.float32)),
            self._tensor(np.ascontiguousarray(mesh.triangles, np.uint32)),
        )

    def cast(self, rays: NDArray[np.float32]) -> dict[str, NDArray]:
        """First hits of `(..., 6)` rays: `t_hit` (inf for none), `primitive_ids`, `primitive_uvs`."""
        found = self._scene.cast_rays(self._tensor(rays))
        hits = {key: found[key].numpy() for key in ("t_hit", "primitive_ids", "primitive_uvs")}
        if self._masked is not None and rays.size:
            self._go_on(rays.reshape(-1, 6), *(hits[key].reshape(rays[..., 0].size, -1) for key in hits))
        return hits

    def _go_on(self, rays: NDArray[np.float32], t_hit: NDArray, ids: NDArray, uvs: NDArray) -> None:
        """Replace the hits of `(n, 6)` rays in holes by the next ones behind; all have n rows, and change in place."""
        from avp_habitat.scenes.mesh import is_hole

        mesh = self._masked
        assert mesh is not None
        through = np.flatnonzero(is_hole(mesh, ids[:, 0], uvs))
        while len(through):
            direction = rays[through, 3:]
            step = _BEYOND_M / np.sqrt((direction * direction).sum(axis=1))
            gone = np.maximum(t_hit[through, 0] + step, np.nextafter(t_hit[through, 0], np.float32(np.inf)))
            origin = rays[through, :3] + direction * gone[:, None]
            found = self._scene.cast_rays(self._tensor(np.concatenate([origin, direction], axis=1)))
            t_hit[through, 0] = gone + found["t_hit"].numpy()
            ids[through, 0], uvs[through] = found["primitive_ids"].numpy(), found["primitive_uvs"].numpy()
            through = through[is_hole(mesh, ids[through, 0], uvs[through])]

    def blocked(self, rays: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Whether `(n, 6)` rays hit anything at t <= 1."""
        blocked = self._scene.test_occlusions(self._tensor(rays), tnear=0.0, tfar=1.0).numpy()
        if self._masked is not None:
            doubtful = np.flatnonzero(blocked)
            blocked[doubtful] = self.cast(rays[doubtful])["t_hit"] <= 1
        return blocked
