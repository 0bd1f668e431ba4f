"""Habitat-Sim as a simulator of the suite: its renderer and its NavMesh, on the CPU or a GPU."""

import gc
import os
import tempfile
import threading
import weakref
from dataclasses import astuple
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SceneError, SimulatorError
from avp_habitat.navigation.area import Float, NavigableArea
from avp_habitat.navigation.navmesh import area_of_file, area_of_islands
from avp_habitat.navigation.settings import NavigationSettings
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.scenes.loader import identify, load_located
from avp_habitat.scenes.location import Frame, SceneLocation, locate
from avp_habitat.scenes.mesh import TexturedMesh
from avp_habitat.sight.rules import visible_in_depth
from avp_habitat.simulators.base import Frames
from avp_habitat.simulators.habitat.engine import HabitatEngine, OverheadCamera
from avp_habitat.simulators.habitat.graphics import choose_gpu
from avp_habitat.simulators.habitat.installed import require_installed
from avp_habitat.simulators.habitat.stage import write_stage

_TILE = OverheadCamera(pixels=1024, side_m=10.24)
"""One pixel a centimetre."""


def navmesh_area(engine: HabitatEngine, navmesh: Path | None) -> NavigableArea:
    """The largest island of the scene's NavMesh that is not a roof.

    Args:
        engine: with the scene open.
        navmesh: a `.navmesh` file instead of the one that is computed for the design's agent.

    Raises:
        SceneError: there is no floor, or the file is no NavMesh of this scene.
    """
    below = partial(surface_below, engine)
    engine.recompute_navmesh(NavigationSettings())
    own = area_of_islands(engine.islands(), below, engine.bounds())
    return own if navmesh is None else area_of_file(navmesh, own, below, engine.bounds())


def surface_below(engine: HabitatEngine, points: Float) -> NDArray[np.float64]:
    """Height of the first surface straight below each point, as the renderer shows it: to a centimetre across.

    NavMesh heights are rounded up to whole voxels of 0.2 m, so the floor itself has to be asked for. A camera that
    looks down and is blind above the points sees all of the floor, also where furniture is cut open, because surfaces
    are not drawn from behind.

    Args:
        engine: with the scene open.
        points: `(n, 3)` metres, world frame; those of equal height are answered by the same pictures.

    Returns:
        `(n,)` y in metres, NaN where there is nothing below.
    """
    points = np.asarray(points, dtype=np.float64)
    found = np.full(len(points), np.nan)
    keys = np.floor(points[:, [0, 2]] / _TILE.side_m).astype(np.int64)
    groups = np.column_stack([keys, np.round(points[:, 1] * 1000).astype(np.int64)])
    tiles, member = np.unique(groups, axis=0, return_inverse=True)
    for number, tile in enumerate(tiles):
        rows = np.flatnonzero(member.reshape(-1) == number)
        found[rows] = _below_in_tile(engine, points[rows], tile[:2] * _TILE.side_m)
    return found


def _below_in_tile(engine: HabitatEngine, points: Float, corner: Float) -> NDArray[np.float64]:
    """Heights below `(k, 3)` points of one height within the tile whose least corner is x, z."""
    top = points[0, 1]
    middle = corner + _TILE.side_m / 2
    above = np.array([[middle[0], top + _TILE.distance_m, middle[1]]])
    # Looking straight down with yaw 0, columns run along +X and rows along +Z.
    below = engine.render_overhead(camera_to_world(above, yaw=np.zeros(1), pitch=np.full(1, -np.pi / 2))[0], _TILE)
    offset, depth = points[:, [2, 0]] - middle[::-1], np.zeros(len(points))
    for _ in range(2):
        # Rays spread a little below the cut plane: on a slope, the right one is known once the depth is.
        share = _TILE.distance_m / (_TILE.distance_m + np.nan_to_num(depth))
        at = np.floor((offset * share[:, None] / _TILE.side_m + 0.5) * _TILE.pixels).astype(np.int64)
        row, column = np.clip(at, 0, _TILE.pixels - 1).T
        depth = below[row, column]
    return top - depth


_FOCAL_PX, _MOST_PX = 320.0, 1280
"""Points are looked for in images of about this focal length, that of 640x480 pixels at 90°, unless that is larger."""
_CAMERAS_PER_CALL = 32


class HabitatSimulator:
    """One Habitat-Sim simulator; a process can hold only one, and it is no use to processes forked from it."""

    name = "habitat"

    def __init__(
        self,
        scene: str | Path,
        *,
        gpu: int | None = None,
        navmesh: str | Path | None = None,
        up: str | None = None,
    ) -> None:
        """Open a scene.

        What ends the process inside Habitat-Sim (a second simulator, a missing CUDA device, no EGL, no NavMesh) is
        caught here before it happens.

        Args:
            scene: as `avp_habitat.scenes.location.locate` takes it.
            gpu: CUDA device that renders; -1 for none; None for the first one that EGL offers, if any.
            navmesh: a `.navmesh` file; without it the NavMesh is computed for the design's agent.
            up: axis of a mesh file that points up, `y` or `z`.

        Raises:
            UsageError: an option that cannot be right.
            SimulatorError: habitat-sim or a graphics device is missing, or this process holds a simulator already.
            SceneError: the scene or the NavMesh cannot be read, or nobody can stand in it.
        """
        require_installed()
        device = choose_gpu(gpu)
        self._location = location = locate(scene, up=up)
        self.scene = location.name
        self.scene_digest, self.scene_frame = identify(location)
        self._engine = _open(location, self.scene_frame, device)
        self._closing = weakref.finalize(self, _close, self._engine)
        self.version = self._engine.version
        try:
            _check_objects(location, self._engine.objects)
            self._area = navmesh_area(self._engine, None if navmesh is None else Path(navmesh))
        except BaseException as error:
            self.close()
            if isinstance(error, SceneError) and not str(error).startswith(str(navmesh)):
                raise SceneError(f"{self.scene}: {error}") from error
            raise

    @property
    def closed(self) -> bool:
        """Whether it was closed, after which it shows nothing any more."""
        return not self._closing.alive

    @property
    def area(self) -> NavigableArea:
        """The largest island of Habitat's NavMesh, recomputed for the design's agent unless a file was given."""
        return self._area

    def render(self, camera_to_world: NDArray[np.floating], intrinsics: Intrinsics, *, rgb: bool) -> Frames:
        """Depth, and colour when asked for, of `(n, 4, 4)` habitat poses; see `simulators.base.Simulator.render`."""
        _check_process(self.scene)
        if self.closed:
            raise SimulatorError(f"habitat: the simulator of {self.scene} was closed; open the scene again")
        return self._engine.render(camera_to_world, intrinsics, rgb=rgb)

    def surface_mesh(self) -> TexturedMesh:
        """All surfaces, as the suite reads them; see `simulators.base.Meshed.surface_mesh`."""
        return load_located(self._location, origin=self.scene_frame.origin).mesh

    def visible(
        self,
        camera_to_world: NDArray[np.floating],
        intrinsics: Intrinsics,
        points: NDArray[np.floating],
        pairs: NDArray[np.integer],
        *,
        tolerance_m: float,
    ) -> NDArray[np.bool_]:
        """Whether cameras see points, from depth images; see `simulators.base.Simulator.visible`."""
        fine, seen = _finer(intrinsics), np.zeros(len(pairs), dtype=np.bool_)
        asked, camera = np.unique(pairs[:, 0], return_inverse=True)
        camera = camera.reshape(-1)
        for start in range(0, len(asked), _CAMERAS_PER_CALL):
            poses = np.asarray(camera_to_world)[asked[start : start + _CAMERAS_PER_CALL]]
            depth = self.render(poses, fine, rgb=False).depth
            here = np.flatnonzero((camera >= start) & (camera < start + _CAMERAS_PER_CALL))
            among = np.stack([camera[here] - start, pairs[here, 1]], axis=1)
            seen[here] = visible_in_depth(poses, fine, depth, points, among, tolerance_m=tolerance_m)
        return seen

    def native_steps(self, positions: NDArray[np.floating], displacements: NDArray[np.floating]) -> NDArray[np.float64]:
        """Where Habitat-Sim's own filter (`PathFinder.try_step`) lets agents arrive, on the NavMesh that it computed.

        For comparison only: the task's agents move by `area.slide`, in both simulators.

        Args:
            positions: `(n, 3)` metres, over the area.
            displacements: `(n, 3)` metres.

        Returns:
            `(n, 3)` metres, at the NavMesh's heights.
        """
        _check_process(self.scene)
        ends = np.asarray(positions) + displacements
        return np.stack([self._engine.try_step(*step) for step in zip(positions, ends, strict=True)])

    def save_navmesh(self, path: Path) -> None:
        """Write the NavMesh that was computed for the design's agent to a new `.navmesh` file.

        Raises:
            OSError: it cannot be written.
        """
        self._engine.save_navmesh(path)

    def close(self) -> None:
        """Free the simulator and its graphics context; another one can then be opened in this process."""
        self._closing()


def _finer(camera: Intrinsics) -> Intrinsics:
    """The same field of view in more pixels, where a camera has few: coverage must not depend on their number."""
    times = max(1, min(round(_FOCAL_PX / camera.fx), _MOST_PX // max(camera.width, camera.height)))
    return Intrinsics(*(times * value for value in astuple(camera)))


_ONE_EACH = 'SubprocVecEnv(start_method="forkserver"), or avp_sb3.AVPSubprocVecEnv for several scenes'


class _Process:
    """What this process, or the one it was forked from, has done.

    Habitat-Sim's graphics context is one per process and belongs to the thread that made it; a forked child inherits
    it without the driver's threads and locks. Seen with habitat-sim 0.3.4 on Mesa 22.3.6: rendering in a forked child
    never returns, opening a simulator there is a SIGABRT, and so is rendering in another thread.
    """

    opener: int | None = None
    """Process id of the first that opened a simulator; a forked child inherits it."""
    thread: int | None = None
    """Thread that opened the simulator that is open."""
    scene: str | None = None
    """Scene of the simulator that is open."""


def _check_process(scene: str) -> None:
    """Refuse to use a simulator in a fork of the process that opened one, or in another thread."""
    if _Process.opener in (None, os.getpid()) and _Process.thread in (None, threading.get_ident()):
        return
    raise SimulatorError(
        f"habitat: {scene} cannot be used here: a simulator was opened in another thread, or before this process was "
        f"forked from process {_Process.opener}, and its graphics work there alone; start workers before the first "
        f"simulator, or use {_ONE_EACH}"
    )


def _claim(scene: str) -> None:
    """Take this process's one place for a simulator."""
    _check_process(scene)
    if _Process.scene is not None:
        gc.collect()  # An environment that nobody uses any more may be left in a circle of references.
    if _Process.scene is not None:
        raise SimulatorError(
            f"habitat: a process can hold one simulator, and this one has {_Process.scene} open already, so that "
            f'{scene} needs a process of its own: {_ONE_EACH}; simulator="raycast" has no such limit'
        )
    _Process.opener, _Process.thread, _Process.scene = os.getpid(), threading.get_ident(), scene


def _release() -> bool:
    """Give the place back; False in a forked child, which must leave alone what its parent still uses."""
    if _Process.opener != os.getpid():
        return False
    _Process.thread = _Process.scene = None
    return True


def _open(location: SceneLocation, frame: Frame, gpu: int) -> HabitatEngine:
    _claim(location.name)
    try:
        with tempfile.TemporaryDirectory(prefix="avp-habitat-") as folder:
            return HabitatEngine(*write_stage(location, frame, Path(folder)), gpu=gpu)
    except BaseException:
        _release()
        raise


def _close(engine: HabitatEngine) -> None:
    if _release():
        engine.close()


def _check_objects(location: SceneLocation, shown: int) -> None:
    if shown < location.objects:
        raise SceneError(
            f"has {location.objects} objects, but Habitat-Sim shows {shown} of them without its physics (Bullet), "
            "which articulated objects need; use a scene without those, or its stage alone"
        )
