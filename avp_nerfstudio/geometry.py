"""`python -m avp_nerfstudio.geometry`: how true the shape of a finished training is."""

import contextlib
import io
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from avp_habitat import command
from avp_habitat.errors import RolloutError
from avp_habitat.metrics import FIGURES, GEOMETRY, explained
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator


@dataclass(frozen=True)
class ModelGeometry:
    """How true the shape of a finished nerfstudio training on avp-data is.

    Its depth is rendered all over the scene and fused; the figures are those of `python -m avp_habitat.geometry`. Takes
    about a minute on two CPU cores. A config.yml names Python objects, which are made when it is read: open those of
    your own trainings only.
    """

    config: Positional[Path]
    """config.yml of the training, or its folder."""
    scene: Annotated[str, arg(help=SCENES)]
    simulator: SimulatorChoice = field(default_factory=SimulatorChoice)
    """Which simulator opens the scene."""
    json: bool = False
    """Print JSON."""


def main(options: ModelGeometry) -> None:
    """Print the figures of one training.

    Raises:
        TrainedRunError: the training cannot be opened.
        RolloutError: its rollout cannot be used, or the model shows no surface.
        SceneError: the scene cannot be used.
    """
    from avp_nerfstudio import plugin  # noqa: F401 - leaves out what nerfstudio makes torch say
    from avp_nerfstudio.method.checkpoints import config_path, open_trained, read_config

    path = config_path(options.config)
    # nerfstudio's scripts come first: its modules import each other in circles, and this way round is its own.
    import nerfstudio.scripts.eval  # noqa: F401

    from avp_nerfstudio.method.shape import model_figures, rollout_of

    simulator = open_simulator(options.simulator, options.scene)
    # nerfstudio says on standard output that it has loaded a checkpoint.
    with contextlib.redirect_stdout(io.StringIO()):
        pipeline = open_trained(read_config(path)).pipeline
        figures = model_figures(pipeline, rollout_of(pipeline), simulator)
    if not figures:
        raise RolloutError(f"{path}: expected a model that shows some surface in {options.scene}, found none")
    if options.json:
        print(json.dumps({"config": str(path), "scene": simulator.scene, **figures}, indent=2, allow_nan=False))
        return
    for name in GEOMETRY:
        print(f"  {FIGURES[name].heading:<22} {FIGURES[name].text(figures[name])}")
    print(explained(*(FIGURES[name].title for name in GEOMETRY)))


if __name__ == "__main__":
    sys.exit(command.run(main))
