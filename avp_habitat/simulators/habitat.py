"""Habitat-Sim as a simulator of the suite: its renderer and its NavMesh, on the CPU or a GPU.

What ends the process inside Habitat-Sim (a second simulator, a missing CUDA device, a missing NavMesh) is caught here
before it happens. It follows what is known of versions 0.2.4 to 0.3.4 and has not been run with any of them yet.
"""

import json
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.coverage import visible_in_depth
from avp_habitat.errors import SceneError, SimulatorError
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.navigation.settings import NavigationSettings
from avp_habitat.poses import Intrinsics
from avp_habitat.scenes.loader import load_scene
from avp_habitat.simulators.base import Frames

if TYPE_CHECKING:
    from avp_habitat.scenes.loader import Scene

HOW_TO_GET = (
    "habitat-sim is not installed, and the package index has none; with Python 3.11 or 3.12 in a conda environment: "
    "conda install habitat-sim headless -c conda-forge -c aihabitat; or use --simulator raycast, which needs nothing"
)
_COVERAGE_CAMERA = Intrinsics.from_hfov(640, 480, hfov_deg=90.0)
_open_in_process: list[int] = []


class HabitatSimulator:
    """One Habitat-Sim simulator; a process can hold only one."""

    name = "habitat"

    def __init__(self, scene: str) -> None:
        """Open a scene.

        Args:
            scene: a mesh file (metres, Y up) or `builtin:SEED`.

        Raises:
            SimulatorError: habitat-sim is missing, or this process holds a simulator already.
            SceneError: the scene cannot be read, or nobody can stand in it.
        """
        habitat = _import_habitat()
        if os.getpid() in _open_in_process:
            raise SimulatorError(
                "habitat: a process can hold one simulator, and this one has it already; use "
                'SubprocVecEnv(start_method="forkserver") for several environments'
            )
        loaded = load_scene(scene)
        self.scene, self.scene_digest = loaded.name, loaded.digest
        self.version = f"habitat-sim {habitat.__version__}"
        self._habitat = habitat
        self._folder = tempfile.TemporaryDirectory(prefix="avp-habitat-")
        self._sim = habitat.Simulator(self._configuration(self._stage(scene, loaded)))
        _open_in_process.append(os.getpid())
        self._sensors: dict[Intrinsics, tuple[str, str]] = {}
        self._area = self._navmesh_area(loaded)

    @property
    def area(self) -> NavigableArea:
        """The largest island of Habitat's NavMesh, recomputed for the design's agent."""
        return self._area

    def render(self, camera_to_world: NDArray[np.floating], intrinsics: Intrinsics, *, rgb: bool) -> Frames:
        """Depth, and colour when asked for, of `(n, 4, 4)` habitat poses."""
        colour_name, depth_name = self._sensors_for(intrinsics)
        colours, depths = [], []
        for pose in np.asarray(camera_to_world, dtype=np.float64):
            self._place(pose)
            seen = self._sim.get_sensor_observations()
            depths.append(np.asarray(seen[depth_name], dtype=np.float32))
            if rgb:
                colours.append(np.asarray(seen[colour_name])[..., :3].astype(np.uint8))
        return Frames(np.stack(colours) if rgb else None, np.stack(depths))

    def visible(
        self,
        camera_to_world: NDArray[np.floating],
        points: NDArray[np.floating],
        pairs: NDArray[np.integer],
        *,
        tolerance_m: float,
    ) -> NDArray[np.bool_]:
        """Whether camera rays reach points, from depth images; see `simulators.base.Simulator.visible`."""
        poses = np.asarray(camera_to_world)
        depth = self.render(poses, _COVERAGE_CAMERA, rgb=False).depth
        return visible_in_depth(poses, _COVERAGE_CAMERA, depth, points, pairs, tolerance_m=tolerance_m)

    def close(self) -> None:
        """Free the simulator and its graphics context; another one can then be opened."""
        if os.getpid() in _open_in_process:
            _open_in_process.remove(os.getpid())
            self._sim.close()
            self._folder.cleanup()

    def _stage(self, scene: str, loaded: "Scene") -> str:
        """A stage that Habitat reads as Y-up: a bare .glb is taken for Z-up. Nothing is written beside the scene."""
        folder = Path(self._folder.name)
        asset = Path(scene).resolve()
        if not asset.is_file():
            from avp_habitat.scenes.export import export_glb

            asset = folder / "room.glb"
            export_glb(loaded.mesh, asset)
        stage = {
            "render_asset": str(asset),
            "up": [0.0, 1.0, 0.0],
            "front": [0.0, 0.0, -1.0],
            "force_flat_shading": True,
        }
        (folder / "scene.stage_config.json").write_text(json.dumps(stage), encoding="utf-8")
        dataset = {"stages": {"paths": {".json": ["*.stage_config.json"]}}}
        (folder / "avp.scene_dataset_config.json").write_text(json.dumps(dataset), encoding="utf-8")
        return "scene"

    def _configuration(self, stage: str) -> Any:
        habitat = self._habitat
        backend = habitat.SimulatorConfiguration()
        backend.scene_dataset_config_file = str(Path(self._folder.name) / "avp.scene_dataset_config.json")
        backend.scene_id = stage
        backend.enable_physics = False
        # The default, device 0, ends the process where there is no CUDA device; -1 lets EGL choose.
        backend.gpu_device_id = 0 if Path("/proc/driver/nvidia/gpus").is_dir() else -1
        agent = habitat.agent.AgentConfiguration()
        agent.sensor_specifications = []
        return habitat.Configuration(backend, [agent])

    def _sensors_for(self, intrinsics: Intrinsics) -> tuple[str, str]:
        """Names of a colour and a depth sensor of these intrinsics, made when first asked for."""
        if intrinsics not in self._sensors:
            number = len(self._sensors)
            names = (f"colour_{number}", f"depth_{number}")
            kinds = (self._habitat.SensorType.COLOR, self._habitat.SensorType.DEPTH)
            for name, kind in zip(names, kinds, strict=True):
                spec = self._habitat.CameraSensorSpec()
                spec.uuid, spec.sensor_type = name, kind
                spec.resolution = [intrinsics.height, intrinsics.width]
                spec.hfov = float(np.degrees(2 * np.arctan(intrinsics.width / 2 / intrinsics.fx)))
                spec.position = [0.0, 0.0, 0.0]
                self._sim.add_sensor(spec)
            self._sensors[intrinsics] = names
        return self._sensors[intrinsics]

    def _place(self, pose: NDArray[np.float64]) -> None:
        """Move the agent's body so that its sensors, which sit at its origin, have this camera_to_world."""
        from habitat_sim.utils.common import quat_from_magnum  # pyright: ignore[reportMissingImports]
        from magnum import Matrix3, Quaternion  # pyright: ignore[reportMissingImports]

        state = self._habitat.AgentState()
        state.position = pose[:3, 3].astype(np.float32)
        state.rotation = quat_from_magnum(Quaternion.from_matrix(Matrix3(tuple(map(tuple, pose[:3, :3].T)))))
        self._sim.get_agent(0).set_state(state, reset_sensors=True)

    def _navmesh_area(self, loaded: "Scene") -> NavigableArea:
        from avp_habitat.navigation.build import area_in_outline
        from avp_habitat.simulators.raycast import RaycastSimulator

        finder = self._recompute_navmesh()
        island = max(range(finder.num_islands), key=finder.island_area)
        corners = np.array([np.asarray(v, dtype=np.float64) for v in finder.build_navmesh_vertices(island)])
        triangles = np.array(finder.build_navmesh_vertex_indices(island), dtype=np.int64).reshape(-1, 3)
        # NavMesh heights are quantised upwards; rays straight down on the same mesh give the true floor.
        return area_in_outline(corners[triangles], RaycastSimulator(loaded).surface_below, NavigationSettings())

    def _recompute_navmesh(self) -> Any:
        design = NavigationSettings()
        settings = self._habitat.NavMeshSettings()
        settings.set_defaults()
        settings.agent_radius, settings.agent_height = design.agent_radius_m, design.agent_height_m
        settings.agent_max_climb, settings.agent_max_slope = design.max_climb_m, design.max_slope_deg
        finder = self._sim.pathfinder
        # Asking a PathFinder without a NavMesh anything crashes the process.
        if not self._sim.recompute_navmesh(finder, settings) or not finder.is_loaded:
            raise SceneError(f"{self.scene}: Habitat-Sim found no floor for its NavMesh; is the scene Y-up, in metres?")
        return finder


def _import_habitat() -> Any:
    os.environ.setdefault("MAGNUM_LOG", "quiet")
    os.environ.setdefault("HABITAT_SIM_LOG", "quiet")
    try:
        import magnum  # noqa: F401 # pyright: ignore[reportMissingImports] - has to come before habitat_sim
        import habitat_sim  # isort: skip # pyright: ignore[reportMissingImports]
    except ImportError as error:
        if error.name in ("magnum", "habitat_sim"):
            raise SimulatorError(HOW_TO_GET) from None
        raise SimulatorError(f"habitat-sim is installed but cannot be loaded: {error}") from None
    return habitat_sim
