"""`python -m avp_habitat.save_navmesh`: keep Habitat-Sim's NavMesh of a scene as a file, for both simulators."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from avp_habitat import command
from avp_habitat.errors import SceneError, UsageError
from avp_habitat.files import atomic_file, check_new
from avp_habitat.scenes.location import HELP, UP_HELP


def save_navmesh(scene: str | Path, out: Path, *, gpu: int | None = None, up: str | None = None) -> float:
    """Compute a scene's NavMesh for the task's agent, write it whole, and give the navigable area in square metres.

    Raises:
        UsageError: the name does not end in `.navmesh`, or the file exists.
        SceneError: the scene cannot be used, or the file cannot be written.
        SimulatorError: Habitat-Sim cannot run here.
    """
    if out.suffix != ".navmesh":
        raise UsageError(f"{out}: expected a name that ends in .navmesh")
    check_new(out)
    from avp_habitat.simulators.habitat import HabitatSimulator

    simulator = HabitatSimulator(scene, gpu=gpu, up=up)
    try:
        with atomic_file(out, replace=False, failure=SceneError) as partial:
            simulator.save_navmesh(partial)
    finally:
        simulator.close()
    return simulator.area.area_m2


@dataclass(frozen=True)
class SaveNavmesh:
    """Keep Habitat-Sim's NavMesh of a scene, computed for the task's agent, as a file.

    Both simulators take it by --navmesh, so that agents walk in exactly the same area in both.
    """

    scene: Annotated[str, arg(help=HELP)]
    out: Path
    """The .navmesh file to write; must not exist."""
    gpu: int | None = None
    """CUDA device, -1 for none (omitted: the first one there is)."""
    up: Annotated[Literal["y", "z"] | None, arg(help=UP_HELP)] = None


def main(options: SaveNavmesh) -> None:
    """Write the file, say what it is for."""
    area = save_navmesh(options.scene, options.out, gpu=options.gpu, up=options.up)
    print(f"{options.out}: {area:.2f} m² navigable; give it to both simulators by --navmesh {options.out}")


if __name__ == "__main__":
    sys.exit(command.run(main))
