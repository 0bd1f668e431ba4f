"""Habitat-Sim itself, versions 0.2.4 to 0.3.4: the only file that imports it, and the only one that knows its versions.

What differs between them: sensors belong to the simulator from 0.3.4 on (`Simulator.sensors`) and to its agents before;
`recompute_navmesh` takes the static objects as an argument before 0.2.5 and as a setting since; vectors are
`magnum.Vector3` from 0.3.3 on.
"""

import errno
import importlib
import math
import os
import platform
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SceneError, SimulatorError
from avp_habitat.navigation.settings import NavigationSettings
from avp_habitat.poses import Intrinsics
from avp_habitat.simulators.base import Frames
from avp_habitat.simulators.habitat.installed import require_installed
from avp_habitat.simulators.habitat.stage import NO_IMAGE, flat_mediator

_NO_NAVMESH = ("Could not build Detour navmesh", "Failed to build navmesh")


@contextmanager
def quiet_stderr(*words: str) -> Iterator[None]:
    """Lines that hold one of these words are left out of stderr, also those that C++ writes; the others come late."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as said, os.fdopen(os.dup(2), "wb") as kept:
        os.dup2(said.fileno(), 2)
        try:
            yield
        finally:
            sys.stderr.flush()
            os.dup2(kept.fileno(), 2)
            said.seek(0)
            kept.writelines(line for line in said if not any(word.encode() in line for word in words))


@dataclass(frozen=True)
class OverheadCamera:
    """A camera so high up that its rays are parallel for our purposes, blind to what is nearer than a cut plane.

    Habitat-Sim's orthographic cameras would be that, but their depth is wrong: it is computed as for a pinhole.
    """

    pixels: int
    """Width and height of the image."""
    side_m: float
    """Side of the square that it sees in the cut plane, metres."""
    distance_m: float = 100.0
    """From the camera to the cut plane."""
    range_m: float = 100.0
    """How far behind the cut plane it sees."""


class HabitatEngine:
    """One open Habitat-Sim simulator without physics, lights or semantics; a process may hold one at a time."""

    def __init__(self, dataset: Path, scene_id: str, *, gpu: int) -> None:
        """Open a scene.

        Args:
            dataset: a `.scene_dataset_config.json`.
            scene_id: name of a scene or stage in it.
            gpu: CUDA device that renders, -1 for EGL's default; one that is not there ends the process.

        Raises:
            SimulatorError: habitat-sim cannot be loaded.
            SceneError: Habitat-Sim cannot read the scene; the text is its own.
        """
        self._habitat = _import_habitat()
        self.version = f"habitat-sim {require_installed().version}"
        self._sensors: dict[tuple[Intrinsics | OverheadCamera, bool], Any] = {}
        configuration = self._configuration(dataset, scene_id, gpu)
        try:
            with quiet_stderr(NO_IMAGE) if gpu < 0 else nullcontext():
                configuration.metadata_mediator = flat_mediator(self._habitat, configuration.sim_cfg, lit=gpu >= 0)
                self._sim = self._habitat.Simulator(configuration)
        except Exception as error:
            # Its failed checks arrive as AssertionError, damaged files as RuntimeError, and so on.
            raise SceneError(f"{scene_id}: Habitat-Sim cannot read it: {_last_line(error)}") from error
        self.objects = self._fixed_objects()
        self._node: Any = self._sim.get_agent(0).scene_node

    def _fixed_objects(self) -> int:
        """Make the scene's objects obstacles, because the NavMesh leaves out those alone that can never move."""
        manager = self._sim.get_rigid_object_manager()
        handles = manager.get_object_handles()
        for handle in handles:
            manager.get_object_by_handle(handle).motion_type = self._habitat.physics.MotionType.STATIC
        return len(handles)

    def _configuration(self, dataset: Path, scene_id: str, gpu: int) -> Any:
        habitat = self._habitat
        backend = habitat.SimulatorConfiguration()
        backend.scene_dataset_config_file = str(dataset)
        backend.scene_id = scene_id
        backend.gpu_device_id = gpu
        backend.enable_physics = False
        backend.load_semantic_mesh = False
        # Scanned rooms carry their light in their colours: no lights gives flat shading, whatever the dataset says.
        backend.override_scene_light_defaults = True
        backend.scene_light_setup = habitat.gfx.NO_LIGHT_KEY
        agent = habitat.agent.AgentConfiguration()
        # Renderer and textures are made only where the first agent has sensors of both kinds.
        smallest = Intrinsics.from_hfov(8, 8, hfov_deg=90.0)
        agent.sensor_specifications = [self._camera(smallest, rgb=rgb) for rgb in (False, True)]
        return habitat.Configuration(backend, [agent])

    def render(self, camera_to_world: NDArray[np.floating], intrinsics: Intrinsics, *, rgb: bool) -> Frames:
        """Depth, and colour when asked for, of `(n, 4, 4)` habitat poses; see `simulators.base.Simulator.render`."""
        shape = (len(camera_to_world), intrinsics.height, intrinsics.width)
        depth = np.empty(shape, np.float32)
        colour = np.empty((*shape, 3), np.uint8) if rgb else None
        camera, rows, columns = _centred(intrinsics)
        for index, pose in enumerate(np.asarray(camera_to_world, dtype=np.float64)):
            self._place(pose)
            depth[index] = self._shot(camera, rgb=False)[rows, columns]
            if colour is not None:
                colour[index] = self._shot(camera, rgb=True)[rows, columns, :3]
        return Frames(colour, depth)

    def render_overhead(self, pose: NDArray[np.floating], camera: OverheadCamera) -> NDArray[np.float64]:
        """`(pixels, pixels)` planar depth in metres behind the cut plane of a camera at a `(4, 4)` habitat pose.

        NaN where nothing was hit.
        """
        self._place(np.asarray(pose, dtype=np.float64))
        depth = np.array(self._shot(camera, rgb=False), dtype=np.float64)
        return np.where(depth > 0, depth - camera.distance_m, np.nan)

    def bounds(self) -> NDArray[np.float64]:
        """`(2, 3)` least and greatest corner of what is in the scene, metres, world frame."""
        box = self._sim.get_active_scene_graph().get_root_node().cumulative_bb
        return np.array([list(box.min), list(box.max)], dtype=np.float64)

    def recompute_navmesh(self, settings: NavigationSettings) -> None:
        """Make the NavMesh of the open scene, static objects included.

        Raises:
            SceneError: there is no floor.
        """
        made = self._habitat.NavMeshSettings()
        made.set_defaults()
        made.cell_size, made.cell_height = settings.voxel_m, settings.voxel_height_m
        made.agent_radius, made.agent_height = settings.agent_radius_m, settings.agent_height_m
        made.agent_max_climb, made.agent_max_slope = settings.max_climb_m, settings.max_slope_deg
        made.region_min_size, made.edge_max_error = settings.region_min_size, settings.edge_max_error
        arguments: tuple[bool, ...] = ()
        if hasattr(made, "include_static_objects"):
            made.include_static_objects = True
        else:
            arguments = (True,)
        finder = self._sim.pathfinder
        try:
            with quiet_stderr(*_NO_NAVMESH):
                done = self._sim.recompute_navmesh(finder, made, *arguments)
        except Exception as error:
            raise SceneError(f"Habitat-Sim cannot make its NavMesh: {_last_line(error)}") from error
        # Asking a PathFinder without a NavMesh anything ends the process (SIGSEGV).
        if not done or not finder.is_loaded:
            raise SceneError("Habitat-Sim found no floor for its NavMesh; is the scene Y-up, in metres?")

    def save_navmesh(self, path: Path) -> None:
        """Write the NavMesh that was made last to a new file.

        Raises:
            OSError: it cannot be written.
        """
        if not self._sim.pathfinder.is_loaded or not self._sim.pathfinder.save_nav_mesh(str(path)):
            raise OSError(errno.EIO, "Habitat-Sim did not write it", str(path))

    def islands(self) -> list[NDArray[np.float64]]:
        """The loaded NavMesh's connected parts, each as `(k, 3, 3)` corners of triangles in metres."""
        finder = self._sim.pathfinder
        return [self._triangles(island) for island in range(finder.num_islands)]

    def try_step(self, begin: NDArray[np.floating], end: NDArray[np.floating]) -> NDArray[np.float64]:
        """Where Habitat-Sim's own filter lets an agent arrive that walks from `begin` to `end`, `(3,)` metres each."""
        if not self._sim.pathfinder.is_loaded:
            raise SceneError("no NavMesh is loaded")
        step = self._sim.pathfinder.try_step(np.asarray(begin, np.float32), np.asarray(end, np.float32))
        return np.array(list(step), dtype=np.float64)

    def close(self) -> None:
        """Free the simulator and its graphics context."""
        self._sensors.clear()
        self._node = None
        self._sim.close()

    def _triangles(self, island: int) -> NDArray[np.float64]:
        finder = self._sim.pathfinder
        corners = np.array([list(vertex) for vertex in finder.build_navmesh_vertices(island)], dtype=np.float64)
        indices = np.array(finder.build_navmesh_vertex_indices(island), dtype=np.int64)
        return corners.reshape(-1, 3)[indices.reshape(-1, 3)]

    def _shot(self, camera: Intrinsics | OverheadCamera, *, rgb: bool) -> NDArray:
        """What one sensor sees from where the agent stands; the other sensors are not drawn."""
        sensor = self._sensors.get((camera, rgb))
        if sensor is None:
            specification = self._camera(camera, rgb=rgb)
            if specification.uuid not in self._registered():
                self._sim.add_sensor(specification)
            sensor = self._sensors[camera, rgb] = self._registered()[specification.uuid]
        sensor.draw_observation()
        return np.asarray(sensor.get_observation())

    def _registered(self) -> Any:
        """Sensors by name."""
        sim = self._sim
        return sim.sensors if hasattr(type(sim), "sensors") else sim._sensors

    def _camera(self, camera: Intrinsics | OverheadCamera, *, rgb: bool) -> Any:
        habitat = self._habitat
        specification = habitat.CameraSensorSpec()
        specification.sensor_type = habitat.SensorType.COLOR if rgb else habitat.SensorType.DEPTH
        specification.uuid = f"{'colour' if rgb else 'depth'} {camera}"
        specification.position = [0.0, 0.0, 0.0]
        if isinstance(camera, Intrinsics):
            specification.resolution = [camera.height, camera.width]
            specification.hfov = float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx)))
        else:
            specification.resolution = [camera.pixels, camera.pixels]
            specification.hfov = float(np.degrees(2 * np.arctan(camera.side_m / 2 / camera.distance_m)))
            specification.near, specification.far = camera.distance_m, camera.distance_m + camera.range_m
        return specification

    def _place(self, pose: NDArray[np.float64]) -> None:
        """Move the agent's body, at whose origin the sensors sit, to a `(4, 4)` camera_to_world."""
        from magnum import Matrix4, Vector4  # pyright: ignore[reportMissingImports]

        self._node.transformation = Matrix4(*(Vector4(*column) for column in pose.T.tolist()))


def _centred(camera: Intrinsics) -> tuple[Intrinsics, slice, slice]:
    """A camera as Habitat-Sim can have it (principal point in the middle), and the rows and columns to take of it."""
    width, height = (
        math.ceil(2 * max(centre, size - centre))
        for centre, size in ((camera.cx, camera.width), (camera.cy, camera.height))
    )
    column, row = width / 2 - camera.cx, height / 2 - camera.cy
    if camera.fx != camera.fy or column != int(column) or row != int(row):
        raise SimulatorError(f"habitat: expected square pixels and a principal point at whole pixels, got {camera}")
    whole = Intrinsics(width, height, camera.fx, camera.fy, width / 2, height / 2)
    return whole, slice(int(row), int(row) + camera.height), slice(int(column), int(column) + camera.width)


def _last_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__


def _import_habitat() -> Any:
    """The module, after triton where that is installed.

    Triton (which torch brings along and `torch._dynamo` imports) and Mesa each carry an LLVM: loaded after a simulator,
    or after corrade has switched Python to RTLD_GLOBAL, triton ends the process (habitat-sim 0.3.4, triton 3.9.0, Mesa
    22.3.6). Loaded first, both run. Its extension is enough: 0.2 s; torch itself (2 to 5 s) is left alone.
    """
    os.environ.setdefault("MAGNUM_LOG", "quiet")
    os.environ.setdefault("HABITAT_SIM_LOG", "quiet")
    flags = sys.getdlopenflags()
    sys.setdlopenflags(flags & ~os.RTLD_GLOBAL)
    try:
        with suppress(ImportError):
            importlib.import_module("triton._C.libtriton")
        import magnum  # noqa: F401 # pyright: ignore[reportMissingImports] - has to come before habitat_sim
        import habitat_sim  # isort: skip # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise SimulatorError(
            f"habitat-sim is installed but cannot be loaded: {' '.join(str(error).split())}; it has to be built for "
            f"Python {platform.python_version()} and NumPy {np.__version__}, and needs the packages and libraries that "
            "it names (Debian, Ubuntu: apt-get install libegl1 libopengl0 libgl1)"
        ) from error
    finally:
        # corrade leaves RTLD_GLOBAL on, with which the symbols of all that is imported later meet Mesa's.
        sys.setdlopenflags(flags)
    return habitat_sim
