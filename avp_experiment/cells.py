"""The experiment's matrix: every training, rollout and reconstruction as a command line with what it needs first."""

import shlex
from dataclasses import dataclass
from pathlib import Path

from avp_experiment.configuration import Configuration, Method, Scene

TRAIN, COLLECT, RECONSTRUCT = "train", "collect", "reconstruct"
KINDS = (TRAIN, COLLECT, RECONSTRUCT)
START_SEEDS = 1000
"""Seed of the first start of seed 0, and from one start of a seed to its next: more starts leave those before them."""
SURFACE_OBSERVATION = {"map": "surface_map"}
"""What a policy that learns from surfaces observes instead."""


@dataclass(frozen=True)
class Cell:
    """One piece of the experiment, done by one command."""

    kind: str
    """One of `KINDS`."""
    name: str
    """Of its folder, unique within its kind."""
    words: tuple[str, ...]
    """The command line, which works alone too."""
    out: str
    """What the command makes, within the cell's folder."""
    method: Method
    """That takes the views."""
    seed: int
    """Of the training, and of the starts."""
    scene: Scene | None = None
    """None for a training."""
    start: int = 0
    """Number of the episode within its seed."""
    frames: int | None = None
    """A reconstruction from the first so many frames; None from all."""
    needs: "Cell | None" = None
    """What must be done before."""
    resumes: bool = False
    """Whether the command can go on with what an interruption left."""

    @property
    def key(self) -> str:
        """In messages, and of its folder."""
        return f"{self.kind}/{self.name}"

    @property
    def command(self) -> str:
        """As it is typed."""
        return shlex.join(self.words)

    def folder(self, root: Path) -> Path:
        """Where it lies in an experiment's folder."""
        return root / "cells" / self.kind / self.name

    def output(self, root: Path) -> Path:
        """What its command makes."""
        return self.folder(root) / self.out


def plan(configuration: Configuration, root: Path, *, tracking: str) -> list[Cell]:
    """All cells; each stands after the one that it needs.

    Args:
        configuration: of the experiment.
        root: its folder.
        tracking: MLflow experiment of the trainings.
    """
    cells: list[Cell] = []
    for seed in range(configuration.seeds):
        for method in configuration.methods:
            training = _training(configuration, root, method, seed, tracking) if method.learned else None
            cells += [training] if training else []
            for scene in configuration.scenes:
                cells += _episodes(configuration, root, method, seed, scene, training)
    # Trainings first, then what is whole: an experiment that is interrupted late lacks only curves.
    return sorted(cells, key=lambda cell: (KINDS.index(cell.kind), cell.frames is not None))


def _training(configuration: Configuration, root: Path, method: Method, seed: int, tracking: str) -> Cell:
    preset = configuration.preset
    scenes = [scene.spec for scene in configuration.scenes if scene.role == "train"]
    observation = preset.observation
    if method.reward == "surface":
        observation = SURFACE_OBSERVATION.get(observation, observation)
    name = f"{method.name}-{seed}"
    model = root / "cells" / TRAIN / name / "model.zip"
    words = ["python", "-m", "avp_sb3.train", "--scene", *(configuration.rooms if method.rooms else scenes)]
    words += ["--reward", method.reward, "--observation", observation, "--seed", str(seed)]
    words += ["--steps", str(preset.steps_rooms if method.rooms else preset.steps)]
    words += [*configuration.simulator_options, "--out", str(model)]
    words += ["--experiment", tracking, "--run-name", f"{method.name} (seed {seed})"]
    return Cell(TRAIN, name, tuple(words), model.name, method, seed, resumes=True)


def _episodes(
    configuration: Configuration, root: Path, method: Method, seed: int, scene: Scene, training: Cell | None
) -> list[Cell]:
    cells = []
    for start in range(configuration.preset.starts):
        rollout = _rollout(configuration, root, method, seed, scene, start, training)
        cells += [rollout, _reconstruction(configuration, root, rollout, None)]
        cells += [_reconstruction(configuration, root, rollout, k) for k in configuration.preset.prefixes]
    return cells


def _rollout(
    configuration: Configuration,
    root: Path,
    method: Method,
    seed: int,
    scene: Scene,
    start: int,
    training: Cell | None,
) -> Cell:
    preset, (width, height) = configuration.preset, configuration.preset.size
    name = f"{method.name}-{scene.slug}-{seed}-{start}"
    out = root / "cells" / COLLECT / name / "rollout"
    policy = ["--policy", str(training.output(root)), "--stochastic"] if training else ["--policy", method.name]
    words = ["python", "-m", "avp_habitat.collect", "--scene", scene.spec, *policy, "--reward", method.reward]
    # Every method starts at the same places.
    words += ["--seed", str(START_SEEDS * (1 + start) + seed), "--budget", str(preset.budget)]
    words += ["--width", str(width), "--height", str(height), *configuration.simulator_options]
    words += ["--out", str(out), "--mlflow", "off"]
    return Cell(COLLECT, name, tuple(words), out.name, method, seed, scene, start, needs=training)


def _reconstruction(configuration: Configuration, root: Path, rollout: Cell, frames: int | None) -> Cell:
    preset = configuration.preset
    name = rollout.name if frames is None else f"{rollout.name}-first_{frames}"
    out = root / "cells" / RECONSTRUCT / name / "reconstruction"
    words = ["python", "-m", "avp_nerfstudio.reconstruct", str(rollout.output(root)), "--out", str(out)]
    words += ["--method", preset.reconstruction, "--iterations", str(preset.iterations)]
    words += ["--frames", str(frames)] if frames is not None else []
    if frames is None and rollout.seed == 0 and rollout.start == 0:
        words += ["--pictures", *map(str, preset.heldout_pictures)]
    return Cell(
        RECONSTRUCT,
        name,
        tuple(words),
        out.name,
        rollout.method,
        rollout.seed,
        rollout.scene,
        rollout.start,
        frames,
        rollout,
    )
