"""The choice of a simulator: its name and its options, by arguments or on a command line."""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_habitat.errors import UsageError, unknown_name
from avp_habitat.scenes.location import UPS

SIMULATOR_NAMES = ("raycast", "habitat")
_WITH_GPU = "habitat"


@dataclass(frozen=True)
class SimulatorChoice:
    """Which simulator opens a scene, and how."""

    name: str = "raycast"
    """`raycast` or `habitat`."""
    gpu: int | None = None
    """Habitat's CUDA device; -1 for none, None for the first one that EGL offers."""
    navmesh: Path | None = None
    """File of the scene's NavMesh; computed when None."""
    up: str | None = None
    """Axis of a mesh file that points up, `y` or `z`; None for Y, of Replica's files Z."""

    @classmethod
    def of(
        cls, name: str, *, gpu: int | None = None, navmesh: str | Path | None = None, up: str | None = None
    ) -> "SimulatorChoice":
        """The same from plain arguments, checked.

        Raises:
            UsageError: no such simulator, a number that is no device, or options of another simulator.
        """
        choice = cls(name, gpu, None if navmesh is None else Path(navmesh), up)
        choice.check()
        return choice

    @classmethod
    def unless_open(cls, simulator: object, **options: Any) -> "SimulatorChoice | None":
        """The choice by name and options; None for simulators that are open already, which take no options.

        Raises:
            UsageError: as `of`, or options beside an open simulator.
        """
        if isinstance(simulator, str):
            return cls.of(simulator, **options)
        for option, value in options.items():
            if value is not None:
                raise UsageError(f"{option}: expected none beside a simulator that is open already, got {value}")
        return None

    def check(self, prefix: str = "") -> None:
        """Refuse what cannot work.

        Args:
            prefix: of the options' names in the errors' texts: `--` on a command line.

        Raises:
            UsageError: no such simulator, a number that is no device, or options of another simulator.
        """
        if self.name not in SIMULATOR_NAMES:
            raise unknown_name("simulator", self.name, SIMULATOR_NAMES)
        if self.up not in (None, *UPS):
            raise UsageError(f"{prefix}up: expected {' or '.join(UPS)}, got {self.up!r}")
        if self.gpu is not None and (isinstance(self.gpu, bool) or not isinstance(self.gpu, int) or self.gpu < -1):
            raise UsageError(f"{prefix}gpu: expected a CUDA device from 0, or -1 for none, got {self.gpu!r}")
        if self.gpu is not None and self.name != _WITH_GPU:
            raise UsageError(
                f"{prefix}gpu: is of the simulator {_WITH_GPU!r}, but {self.name!r} was chosen; leave it out, or "
                f"choose {_WITH_GPU!r}"
            )


def add_simulator_options(parser: argparse.ArgumentParser) -> None:
    """Add `--simulator`, `--gpu`, `--navmesh` and `--up` to a command; `simulator_choice` reads them."""
    names = ", ".join(SIMULATOR_NAMES)
    parser.add_argument(
        "--simulator", default="raycast", metavar="NAME", help=f"{names} (Habitat-Sim) (default: raycast)"
    )
    parser.add_argument(
        "--gpu",
        default=None,
        type=int,
        metavar="N",
        help="CUDA device that habitat renders on, -1 for none (default: the first one there is)",
    )
    parser.add_argument(
        "--navmesh",
        default=None,
        type=Path,
        metavar="FILE",
        help="the scene's .navmesh (default: computed for the task's agent)",
    )
    add_up_option(parser)


def add_up_option(parser: argparse.ArgumentParser) -> None:
    """Add `--up` to a command that opens a scene."""
    parser.add_argument(
        "--up", choices=UPS, help="axis of a mesh file that points up (default: y, of Replica's files z)"
    )


def simulator_choice(options: argparse.Namespace) -> SimulatorChoice:
    """What the options of `add_simulator_options` say.

    Raises:
        UsageError: no such simulator, a number that is no device, or options of another simulator.
    """
    choice = SimulatorChoice(options.simulator, options.gpu, options.navmesh, options.up)
    choice.check("--")
    return choice
