"""How well agents have seen the surface of their scenes so far in their episodes."""

import hashlib
import weakref
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from avp_habitat.sight import kernels
from avp_habitat.sight.coverage import candidates
from avp_habitat.sight.rows import Lattice, PlaceRows, TileFiles, words_for
from avp_habitat.sight.tables import SPACING_M, seen_bits, single_rays
from avp_habitat.simulators.base import Simulator, SingleRays
from avp_habitat.surface.map import SurfaceMapper
from avp_habitat.surface.points import FULL_DISTANCE_M, SceneSurface, scene_surface, view_quality
from avp_habitat.task.settings import TaskSettings
from avp_habitat.task.views import Views

_VERSION = 1


class SurfaceTables:
    """Which surface points are seen from the places that were asked for."""

    def __init__(self, simulator: SingleRays, settings: TaskSettings) -> None:
        """Make empty tables."""
        # Not held: the tables live as long as their simulator, whose users hold it.
        self._simulator: SingleRays = weakref.proxy(simulator)
        self.surface: SceneSurface = scene_surface(simulator, settings)
        """The points that the bits stand for."""
        self._height_m, self._tolerance_m = settings.sensor_height_m, settings.tolerance_m
        self._reach_m = settings.max_range_m + 2 * SPACING_M
        content = hashlib.sha256(simulator.area.centres.tobytes() + self.surface.points.tobytes())
        numbers = (self._height_m, self._tolerance_m, self._reach_m, SPACING_M)
        content.update(f"{simulator.scene_digest} surface {_VERSION} {numbers}".encode())
        empty = {"visible": np.zeros((0, words_for(len(self.surface.points))), dtype=np.uint64)}
        lattice = Lattice(simulator.area, SPACING_M)
        self._rows = PlaceRows(lattice, TileFiles(content.hexdigest()[:32]), empty, self._compute)

    @property
    def visible(self) -> NDArray[np.uint64]:
        """`(slots, words)`: bit j % 64 of word j // 64 says whether point j is seen from the slot's place."""
        return self._rows.columns["visible"]

    def around(self, position: NDArray[np.floating]) -> NDArray[np.int32]:
        """`(k, 4)` the slots around `(k, 3)` feet, made now where they are new."""
        return self._rows.around(position)[0]

    def _compute(self, feet: NDArray[np.floating]) -> dict[str, NDArray]:
        eye = feet + [0.0, self._height_m, 0.0]
        points, reach, tolerance = self.surface.points, self._reach_m, self._tolerance_m
        return {"visible": seen_bits(self._simulator, eye, points, reach_m=reach, tolerance_m=tolerance)}


class TableSurface:
    """Points on which the tables' places differ are cast as rays, the others looked up."""

    def __init__(self, simulator: Simulator, settings: TaskSettings) -> None:
        """Use the scene's tables.

        Raises:
            UsageError: the simulator cannot cast single rays, or the scene shows no surface.
        """
        self._simulator = single_rays(simulator, "lookup")
        self._settings = settings
        self._tables = surface_tables(self._simulator, settings)
        camera = settings.intrinsics
        self._camera = (
            *(float(camera.width), float(camera.height)),
            *(camera.fx, camera.fy, camera.cx, camera.cy),
        )
        self._doubtful, self._doubtful_q = _room_for(4096)

    def capture(self, views: Views, quality: NDArray[np.float32], rows: NDArray[np.integer]) -> NDArray[np.float64]:
        """See `SurfaceSensor`."""
        slots, points = self._tables.around(views.position), self._tables.surface.points
        gain = np.zeros(len(slots))
        doubts = self._sure_points(views, slots, quality, rows, gain)
        if doubts:
            pairs, value = self._doubtful[:doubts], self._doubtful_q[:doubts]
            eye = views.camera_to_world[:, :3, 3]
            reached = self._simulator.reached(eye, points, pairs, tolerance_m=self._settings.tolerance_m)
            gain += raise_quality(quality, rows, pairs[reached, 0], pairs[reached, 1], value[reached])
        return gain

    def _sure_points(
        self,
        views: Views,
        slots: NDArray[np.int32],
        quality: NDArray[np.float32],
        rows: NDArray[np.integer],
        gain: NDArray[np.float64],
    ) -> int:
        """Raise what is certain; returns how many pairs (view, point) only a ray can decide."""
        while True:
            doubts = kernels.new_surface(
                self._tables.visible,
                slots,
                views.camera_to_world,
                self._tables.surface.points,
                self._tables.surface.normals,
                self._camera,
                self._settings.max_range_m,
                FULL_DISTANCE_M,
                rows,
                quality,
                new := np.empty_like(gain),
                self._doubtful,
                self._doubtful_q,
            )
            gain += new
            if doubts <= len(self._doubtful):
                return doubts
            # Once more with enough room: the sure points are raised by now and not found again.
            self._doubtful, self._doubtful_q = _room_for(2 * doubts)


def _room_for(pairs: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    return np.empty((pairs, 2), dtype=np.int64), np.empty(pairs, dtype=np.float32)


_shared: weakref.WeakKeyDictionary[SingleRays, dict[tuple[float, ...], SurfaceTables]] = weakref.WeakKeyDictionary()


def surface_tables(simulator: SingleRays, settings: TaskSettings) -> SurfaceTables:
    """The tables for a scene and a task; tasks on the same open simulator share them."""
    key = (settings.sensor_height_m, settings.max_range_m, settings.tolerance_m)
    known = _shared.setdefault(simulator, {})
    if key not in known:
        known[key] = SurfaceTables(simulator, settings)
    return known[key]


class SurfaceSensor(Protocol):
    """Perceives how well the views of agents in one scene show its surface."""

    def capture(self, views: Views, quality: NDArray[np.float32], rows: NDArray[np.integer]) -> NDArray[np.float64]:
        """Raise the quality of the points that the views show better, in place.

        Args:
            views: of k agents.
            quality: `(n, m)` how well each surface point was seen so far, 0 for never.
            rows: `(k,)` the agents' rows of it.

        Returns:
            `(k,)` by how much the qualities grew in sum.
        """
        ...


class CastSurface:
    """The definition itself: a ray to every point inside the image that the view would show better than before."""

    def __init__(self, simulator: Simulator, settings: TaskSettings) -> None:
        """Use a simulator's rays."""
        self._simulator = simulator
        self._settings = settings
        self._surface = scene_surface(simulator, settings)

    def capture(self, views: Views, quality: NDArray[np.float32], rows: NDArray[np.integer]) -> NDArray[np.float64]:
        """See `SurfaceSensor`."""
        settings, surface = self._settings, self._surface
        eye = views.camera_to_world[:, None, :3, 3]
        found = view_quality(eye, surface.points[None], surface.normals[None]).astype(np.float32)
        better, reach = found > quality[rows], settings.max_range_m
        pose, camera = views.camera_to_world, settings.intrinsics
        pairs = candidates(pose, camera, surface.points, better, max_range_m=reach)
        reached = self._simulator.visible(pose, camera, surface.points, pairs, tolerance_m=settings.tolerance_m)
        agent, point = pairs[reached].T
        return raise_quality(quality, rows, agent, point, found[agent, point])


def raise_quality(
    quality: NDArray[np.float32],
    rows: NDArray[np.integer],
    agent: NDArray[np.integer],
    point: NDArray[np.integer],
    value: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Enter greater qualities.

    Args:
        quality: `(n, m)`, changed in place.
        rows: `(k,)` the agents' rows of it.
        agent: `(p,)` indices into `rows`.
        point: `(p,)`, each pair (agent, point) at most once.
        value: `(p,)` greater than what is there.

    Returns:
        `(k,)` sums of the growth.
    """
    at = np.asarray(rows)[agent], point
    growth = (value - quality[at]).astype(np.float64)
    grown = np.bincount(agent, weights=growth, minlength=len(rows)).astype(np.float64)
    quality[at] = value
    return grown


def make_surface_sensor(simulator: Simulator, settings: TaskSettings) -> SurfaceSensor:
    """The sensor that the settings ask for.

    Raises:
        UsageError: tables are asked for where they cannot be made, or the scene shows no surface.
    """
    if settings.lookup:
        return TableSurface(simulator, settings)
    return CastSurface(simulator, settings)


Rows = NDArray[np.integer]


class RoomSurface:
    """The memory of the agents in one scene; n is the number of all agents, also those elsewhere."""

    def __init__(self, simulator: Simulator, settings: TaskSettings, agents: int, rows: Rows) -> None:
        """Make room.

        Args:
            simulator: of the scene.
            settings: of the task.
            agents: n.
            rows: `(k,)` which of them are in this scene.

        Raises:
            UsageError: the simulator cannot do what the settings ask for, or the scene shows no surface.
        """
        surface = scene_surface(simulator, settings)
        self._sensor = make_surface_sensor(simulator, settings)
        self._mapper = SurfaceMapper(surface, settings.sensor_height_m)
        self._row = np.zeros(agents, dtype=np.int64)
        self._row[rows] = np.arange(len(rows))
        self._quality = np.zeros((len(rows), len(surface.points)), dtype=np.float32)

    def reset(self, rows: Rows) -> None:
        """Forget what some agents saw."""
        self._quality[self._row[rows]] = 0.0

    def capture(self, views: Views, rows: Rows) -> NDArray[np.float64]:
        """`(k,)` ΔS of the newest views of k agents, which are remembered."""
        return self._sensor.capture(views, self._quality, self._row[rows])

    def observe(self, rows: Rows, position: NDArray[np.floating], yaw: NDArray[np.floating]) -> NDArray[np.float32]:
        """`(k, map.SIZE)` what k agents know of the surface; see `SurfaceMapper.observe`."""
        return self._mapper.observe(self._quality, self._row[rows], position, yaw)

    def quality(self, row: int) -> NDArray[np.float32]:
        """`(m,)` how well one agent has seen each point of its scene's surface, within [0, 1]."""
        return self._quality[self._row[row]]


def room_surfaces(
    simulators: Sequence[Simulator], settings: TaskSettings, room_of: NDArray[np.integer]
) -> list[RoomSurface | None]:
    """A memory for each scene; None where the settings need none.

    Args:
        simulators: one for each scene.
        settings: of the task.
        room_of: `(n,)` the scene of each agent.
    """
    if not settings.with_surface:
        return [None] * len(simulators)
    return [
        RoomSurface(scene, settings, len(room_of), np.flatnonzero(room_of == index))
        for index, scene in enumerate(simulators)
    ]
