"""The simulators by name, made once per scene and process."""

import weakref
from collections.abc import Callable
from pathlib import Path

from avp_habitat.errors import unknown_name
from avp_habitat.simulators.base import Frames, Simulator

__all__ = ["SIMULATOR_NAMES", "Frames", "Simulator", "make_simulator", "open_scenes"]


def _raycast(scene: str) -> Simulator:
    from avp_habitat.scenes.loader import load_scene
    from avp_habitat.simulators.raycast import RaycastSimulator

    return RaycastSimulator(load_scene(scene))


def _habitat(scene: str) -> Simulator:
    from avp_habitat.simulators.habitat import HabitatSimulator

    return HabitatSimulator(scene)


_FACTORIES: dict[str, Callable[[str], Simulator]] = {"raycast": _raycast, "habitat": _habitat}
SIMULATOR_NAMES = tuple(_FACTORIES)
# Simulators hold no state of an episode, so all environments of a process on one scene share one; it is freed with
# the last of them.
_shared: weakref.WeakValueDictionary[tuple[str, str, float], Simulator] = weakref.WeakValueDictionary()


def make_simulator(name: str, scene: str) -> Simulator:
    """The simulator `name` on a scene.

    Args:
        name: `raycast` or `habitat`.
        scene: a mesh file, or `builtin:SEED`.

    Raises:
        UsageError: no such simulator, or a scene name that cannot be right.
        SceneError: the scene cannot be read, or nobody can stand in it.
        SimulatorError: the simulator is not installed or cannot run here.
    """
    if name not in _FACTORIES:
        raise unknown_name("simulator", name, SIMULATOR_NAMES)
    path = Path(scene)
    key = (name, scene, path.stat().st_mtime if path.is_file() else 0.0)
    simulator = _shared.get(key)
    if simulator is None:
        simulator = _FACTORIES[name](scene)
        _shared[key] = simulator
    return simulator


def open_scenes() -> dict[str, str]:
    """SHA-256 digests by name of the scenes that simulators of this process have open."""
    return {simulator.scene: simulator.scene_digest for simulator in list(_shared.values())}
