"""The simulators by name, made once per scene and process."""

import inspect
import os
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_habitat import plugins
from avp_habitat.errors import UsageError
from avp_habitat.scenes.location import UPS
from avp_habitat.simulators.base import ASKED, Simulator

Factory = Callable[..., Simulator]
"""Opens a scene: `factory(scene, **options)`. It has those of the parameters `gpu`, `navmesh` and `up` that it can use.
Two attributes say what is asked before a scene is open: `single_rays` (its simulators are `SingleRays`) and
`one_per_process` (a process can hold one only); False where they are missing."""


@plugins.declares(single_rays=True)
def _raycast(scene: str, *, navmesh: Path | None = None, up: str | None = None) -> Simulator:
    from avp_habitat.scenes.loader import load_scene
    from avp_habitat.simulators.raycast import RaycastSimulator

    return RaycastSimulator(load_scene(scene, up=up), navmesh)


@plugins.declares(one_per_process=True)
def _habitat(scene: str, *, gpu: int | None = None, navmesh: Path | None = None, up: str | None = None) -> Simulator:
    from avp_habitat.simulators.habitat import HabitatSimulator

    return HabitatSimulator(scene, gpu=gpu, navmesh=navmesh, up=up)


SIMULATORS: dict[str, Factory] = {"raycast": _raycast, "habitat": _habitat}
"""What is built in, by name."""
_OPTIONS = ("gpu", "navmesh", "up")
_EXPECTED = "expected a factory of (scene, gpu, navmesh, up)"


@dataclass(frozen=True)
class SimulatorChoice:
    """Which simulator opens a scene, and how; also the options of a command that opens scenes.

    Raises:
        UsageError: no such simulator, a number that is no device, or options of another simulator.
    """

    simulator: str = "raycast"
    """raycast, habitat (Habitat-Sim), MODULE:FACTORY, or another distribution's; in Python also the factory itself."""
    gpu: int | None = None
    """CUDA device that habitat renders on, -1 for none (omitted: the first one that EGL offers)."""
    navmesh: Path | None = None
    """The scene's .navmesh file (omitted: computed for the task's agent)."""
    up: str | None = None
    """Axis of a mesh file that points up, y or z (omitted: y, of Replica's files z)."""

    def __post_init__(self) -> None:
        """Refuse what cannot work."""
        factory = self.factory
        if not callable(factory):
            raise UsageError(f"simulator {self.name!r}: {_EXPECTED}, got {factory!r}")
        if self.navmesh is not None:
            object.__setattr__(self, "navmesh", Path(self.navmesh))
        if self.up not in (None, *UPS):
            raise UsageError(f"up: expected {' or '.join(UPS)}, got {self.up!r}")
        if self.gpu is not None and (isinstance(self.gpu, bool) or not isinstance(self.gpu, int) or self.gpu < -1):
            raise UsageError(f"gpu: expected a CUDA device from 0, or -1 for none, got {self.gpu!r}")
        for option in self.options:
            if not _takes(factory, option):
                able = " or ".join(repr(name) for name, known in SIMULATORS.items() if _takes(known, option))
                chosen = f"but {self.name!r} was chosen; leave it out, or choose {able}"
                raise UsageError(f"{option}: is of the simulator {able}, {chosen}")

    @property
    def name(self) -> str:
        """Of the factory, as a text."""
        return plugins.name_of(self.simulator)

    @property
    def factory(self) -> Factory:
        """Opens scenes."""
        return plugins.find("avp.simulators", self.simulator, SIMULATORS)

    @property
    def options(self) -> dict[str, Any]:
        """The options that were given."""
        return {name: value for name in _OPTIONS if (value := getattr(self, name)) is not None}

    @property
    def single_rays(self) -> bool:
        """Whether its simulators cast single rays, so that views can be looked up."""
        return bool(getattr(self.factory, "single_rays", False))

    @property
    def one_per_process(self) -> bool:
        """Whether a process can hold one of its simulators only."""
        return bool(getattr(self.factory, "one_per_process", False))

    @classmethod
    def by_name(cls, simulator: object, **options: Any) -> "SimulatorChoice | None":
        """The choice by name (or factory) and options; None for open simulators, which take no options.

        Raises:
            UsageError: as the class, or options beside an open simulator.
        """
        if isinstance(simulator, str) or callable(simulator):
            return cls(simulator, **options)  # type: ignore[arg-type]
        for option, value in options.items():
            if value is not None:
                raise UsageError(f"{option}: expected none beside a simulator that is open already, got {value}")
        return None


def _takes(factory: Factory, option: str) -> bool:
    parameters = inspect.signature(factory).parameters.values()
    return any(each.name == option or each.kind is each.VAR_KEYWORD for each in parameters)


_Key = tuple[SimulatorChoice, str, float]
# Simulators hold no state of an episode, so all environments of a process on one scene share one; it is freed with
# the last of them.
_shared: weakref.WeakValueDictionary[_Key, Simulator] = weakref.WeakValueDictionary()


def make_simulator(name: str, scene: str | Path, **options: Any) -> Simulator:
    """The simulator `name` on a scene.

    Args:
        name: `raycast`, `habitat`, `module:factory`, another distribution's, or the factory itself.
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
    if simulator is None or getattr(simulator, "closed", False):
        simulator = _shared[key] = _opened(choice, scene)
    return simulator


def open_scenes() -> dict[str, str]:
    """SHA-256 digests by name of the scenes that simulators of this process have open."""
    return {simulator.scene: simulator.scene_digest for simulator in list(_shared.values())}


def _opened(choice: SimulatorChoice, scene: str) -> Simulator:
    try:
        inspect.signature(choice.factory).bind(scene, **choice.options)
    except TypeError as error:
        raise UsageError(f"simulator {choice.name!r}: {_EXPECTED}: {error}") from None
    simulator = choice.factory(scene, **choice.options)
    if missing := [each for each in ASKED if each not in dir(simulator)]:
        raise UsageError(f"simulator {choice.name!r}: {type(simulator).__name__} has no {', '.join(missing)}")
    return simulator
