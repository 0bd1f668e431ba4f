"""`python -m avp_nerfstudio.reconstruct`: train on one rollout and score its held-out views, in one process.

Importing nerfstudio takes seconds; a program with many reconstructions pays for it once by calling `reconstruct`, or
`main`, in forks of a process that has imported `avp_nerfstudio.method.reconstruction`.
"""

import sys
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from avp_habitat import command
from avp_habitat.errors import AVPError, RolloutError, UsageError
from avp_habitat.files import atomic_folder
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.rollout.format import Rollout, read_rollout
from avp_habitat.rollout.origin import expect_scene
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.tracking.stores import address_of, open_store


@dataclass(frozen=True)
class Reconstruct:
    """Train on the captured frames of a rollout and score its held-out views.

    The scores are written to a folder that exists only when all is done.
    """

    rollout: Positional[Path]
    """The rollout's folder."""
    out: Path
    """The folder to write; must not exist."""
    method: Literal["avp-nerfacto", "nerfacto"] = "avp-nerfacto"
    """Of nerfstudio."""
    depth: bool = True
    """avp-nerfacto learns from the rollout's depth where it has some; --no-depth: from the colours, as nerfacto does;
    only the scene box still comes from depth."""
    frames: int | None = None
    """Train on the first so many captured frames (omitted: all)."""
    iterations: int | None = None
    """Of the training (omitted: the method's own number)."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 42
    """Of the training."""
    keep_checkpoint: bool = False
    """Keep config.yml and checkpoint, for ns-eval, ns-render, ns-viewer and ns-export."""
    pictures: tuple[int, ...] = ()
    """Held-out views to keep as PNG, from 0."""
    scene: Annotated[
        str | None, arg(help=f"also measure the geometry of the reconstruction in this scene: {SCENES}")
    ] = None
    simulator: SimulatorChoice = field(default_factory=SimulatorChoice)
    """Which simulator opens that scene."""
    mlflow: str = "off"
    """Log settings and scores as an MLflow run at an address such as sqlite:///mlflow.db; auto: MLFLOW_TRACKING_URI if
    that is set, else nowhere; off: nowhere."""

    def __post_init__(self) -> None:
        """Hold the ranges."""
        hold_ranges(self)
        if self.iterations is not None and self.iterations < 1:
            raise UsageError(f"iterations: expected a number from 1, got {self.iterations}")


def reconstruct(options: Reconstruct) -> dict[str, Any]:
    """Train on a rollout, score all held-out views, write the folder.

    Returns:
        What `scores.json` holds.

    Raises:
        UsageError: an option does not fit the rollout, or the folder exists.
        RolloutError: the rollout cannot be used.
        AVPError: the folder cannot be written, or MLflow cannot be reached; nothing is left behind.
    """
    started = time.monotonic()
    with atomic_folder(options.out, failure=AVPError, option="--out") as folder:
        rollout = read_rollout(options.rollout)
        _check_rollout(options, rollout)
        scene = None if options.scene is None else open_simulator(options.simulator, options.scene)
        if scene is not None:
            expect_scene(rollout, scene)
        address = address_of(options.mlflow, default=None)
        if address is not None:
            open_store(address)  # before anything is trained, which takes long
        with warnings.catch_warnings():
            # nerfstudio and what it imports warn their developers, at length.
            warnings.simplefilter("ignore")
            from avp_nerfstudio.method.reconstruction import process

            return process(options, rollout, folder, scene, started=started, address=address)


def _check_rollout(options: Reconstruct, rollout: Rollout) -> None:
    for kind, views in (("captured frame", rollout.frames), ("held-out view", rollout.heldout)):
        if not views:
            raise RolloutError(f"{rollout.folder}: expected at least one {kind}, found none")
    count, last = len(rollout.frames), len(rollout.heldout) - 1
    if options.frames is not None and not 1 <= options.frames <= count:
        raise UsageError(
            f"--frames: expected 1 to {count}, the captured frames of {rollout.folder}, got {options.frames}"
        )
    if not all(0 <= index <= last for index in options.pictures):
        raise UsageError(
            f"--pictures: expected 0 to {last}, the held-out views of {rollout.folder}, got {options.pictures}"
        )


def main(options: Reconstruct) -> None:
    """Reconstruct one rollout; print its scores."""
    found = reconstruct(options)
    values = {**found["scores"], **found["geometry"]}
    words = ", ".join(f"{name} {value:.4g}" for name, value in values.items() if value is not None)
    missing = "" if found["lpips_reason"] is None else ", no lpips (scores.json says why)"
    print(f"{options.out}: {words}{missing}")


if __name__ == "__main__":
    sys.exit(command.run(main))
