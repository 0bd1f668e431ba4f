"""The simulators by name, made once per scene and process."""

import gc
import os
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_habitat.errors import SimulatorError, UsageError, unknown_name
from avp_habitat.scenes.location import UPS
from avp_habitat.simulators.base import Simulator

SIMULATOR_NAMES = ("raycast", "habitat")
_WITH_GPU = "habitat"


@dataclass(frozen=True)
class SimulatorChoice:
    """Which simulator opens a scene, and how; also the options of a command that opens scenes.

    Raises:
        UsageError: no such simulator, a number that is no device, or options of another simulator.
    """

    simulator: str = "raycast"
    """raycast or habitat (Habitat-Sim)."""
    gpu: int | None = None
    """CUDA device that habitat renders on, -1 for none (omitted: the first one that EGL offers)."""
    navmesh: Path | None = None
    """The scene's .navmesh file (omitted: computed for the task's agent)."""
    up: str | None = None
    """Axis of a mesh file that points up, y or z (omitted: y, of Replica's files z)."""

    def __post_init__(self) -> None:
        """Refuse what cannot work."""
        if self.navmesh is not None:
            object.__setattr__(self, "navmesh", Path(self.navmesh))
        if self.simulator not in SIMULATOR_NAMES:
            raise unknown_name("simulator", self.simulator, SIMULATOR_NAMES)
        if self.up not in (None, *UPS):
            raise UsageError(f"up: expected {' or '.join(UPS)}, got {self.up!r}")
        if self.gpu is not None and (isinstance(self.gpu, bool) or not isinstance(self.gpu, int) or self.gpu < -1):
            raise UsageError(f"gpu: expected a CUDA device from 0, or -1 for none, got {self.gpu!r}")
        if self.gpu is not None and self.simulator != _WITH_GPU:
            raise UsageError(
                f"gpu: is of the simulator {_WITH_GPU!r}, but {self.simulator!r} was chosen; leave it out, or choose "
                f"{_WITH_GPU!r}"
            )

    @classmethod
    def by_name(cls, simulator: object, **options: Any) -> "SimulatorChoice | None":
        """The choice by name and options; None for simulators that are open already, which take no options.

        Raises:
            UsageError: as the class, or options beside an open simulator.
        """
        if isinstance(simulator, str):
            return cls(simulator, **options)
        for option, value in options.items():
            if value is not None:
                raise UsageError(f"{option}: expected none beside a simulator that is open already, got {value}")
        return None


def add_simulator_options(parser: Any) -> None:
    """Until all commands are read by tyro."""
    parser.add_argument("--simulator", default="raycast")
    parser.add_argument("--gpu", default=None, type=int)
    parser.add_argument("--navmesh", default=None, type=Path)
    add_up_option(parser)


def add_up_option(parser: Any) -> None:
    """Until all commands are read by tyro."""
    parser.add_argument("--up", choices=UPS)


def simulator_choice(options: Any) -> SimulatorChoice:
    """Until all commands are read by tyro."""
    return SimulatorChoice(options.simulator, options.gpu, options.navmesh, options.up)


def _raycast(scene: str, choice: SimulatorChoice) -> Simulator:
    from avp_habitat.scenes.loader import load_scene
    from avp_habitat.simulators.raycast import RaycastSimulator

    return RaycastSimulator(load_scene(scene, up=choice.up), choice.navmesh)


def _habitat(scene: str, choice: SimulatorChoice) -> Simulator:
    from avp_habitat.simulators.habitat import HabitatSimulator

    return HabitatSimulator(scene, gpu=choice.gpu, navmesh=choice.navmesh, up=choice.up)


_Key = tuple[SimulatorChoice, str, float]
_FACTORIES: dict[str, Callable[[str, SimulatorChoice], Simulator]] = {"raycast": _raycast, "habitat": _habitat}
ONE_PER_PROCESS = ("habitat",)
"""Simulators of which a process can hold one only."""
# Simulators hold no state of an episode, so all environments of a process on one scene share one; it is freed with
# the last of them.
_shared: weakref.WeakValueDictionary[_Key, Simulator] = weakref.WeakValueDictionary()


def make_simulator(name: str, scene: str | Path, **options: Any) -> Simulator:
    """The simulator `name` on a scene.

    Args:
        name: `raycast` or `habitat`.
        scene: as `avp_habitat.scenes.location.locate` takes it.
        **options: of `SimulatorChoice`: `gpu` (the CUDA device of `habitat`; -1 for none, None for the first one there
            is), `navmesh` (file of the scene's NavMesh; computed when omitted) and `up` (axis of a mesh file that
            points up: `y` or `z`).

    Raises:
        UsageError: no such simulator, an option that it does not have, or a scene name that cannot be right.
        SceneError: the scene cannot be read, or nobody can stand in it.
        SimulatorError: the simulator is not installed or cannot run here, or this process has another one open.
    """
    return open_simulator(SimulatorChoice(name, **options), scene)


def open_simulator(choice: SimulatorChoice, scene: str | Path) -> Simulator:
    """The chosen simulator on a scene; arguments and errors as of `make_simulator`."""
    scene = os.fspath(scene)
    path = Path(scene)
    # Not where a link leads: what a file refers to lies beside the link.
    key = (choice, os.path.abspath(path), path.stat().st_mtime) if path.is_file() else (choice, scene, 0.0)
    simulator = _shared.get(key)
    if simulator is None or _is_closed(simulator):
        if choice.simulator in ONE_PER_PROCESS:
            _check_alone(choice.simulator, scene)
        simulator = _FACTORIES[choice.simulator](scene, choice)
        _shared[key] = simulator
    return simulator


def open_scenes() -> dict[str, str]:
    """SHA-256 digests by name of the scenes that simulators of this process have open."""
    return {simulator.scene: simulator.scene_digest for simulator in list(_shared.values())}


def _check_alone(name: str, scene: str) -> None:
    """Refuse a second simulator before it is made, where a process can hold one only."""
    if not _open_already(name):
        return
    gc.collect()  # An environment that nobody uses any more may be left in a circle of references.
    if found := _open_already(name):
        raise SimulatorError(
            f"{name}: a process can hold one simulator, and this one has {found[0]} open already, so that {scene} "
            'needs a process of its own: SubprocVecEnv(start_method="forkserver"), or avp_sb3.AVPSubprocVecEnv for '
            'several scenes; simulator="raycast" has no such limit'
        )


def _open_already(name: str) -> list[str]:
    opened = [simulator for (choice, _, _), simulator in list(_shared.items()) if choice.simulator == name]
    return [simulator.scene for simulator in opened if not _is_closed(simulator)]


def _is_closed(simulator: Simulator) -> bool:
    """Whether somebody closed it before its last user was done."""
    return getattr(simulator, "closed", False)
