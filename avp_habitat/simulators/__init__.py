"""The simulators by name, made once per scene and process."""

import weakref
from importlib import import_module
from pathlib import Path

from avp_habitat.errors import unknown_name
from avp_habitat.simulators.base import Frames, Simulator

__all__ = ["SIMULATOR_NAMES", "Frames", "Simulator", "make_simulator"]

_FACTORIES = {
    "raycast": ("avp_habitat.simulators.raycast", "make"),
    "habitat": ("avp_habitat.simulators.habitat", "make"),
}
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
        module, factory = _FACTORIES[name]
        simulator = getattr(import_module(module), factory)(scene)
        _shared[key] = simulator
    return simulator
