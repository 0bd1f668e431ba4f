"""The experiment's cells: every training, rollout and reconstruction as a command line, and what is kept of it."""

import base64
import csv
import json
import os
import shlex
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_experiment.configuration import TRAIN as TRAIN_SCENE
from avp_experiment.configuration import Configuration, ExperimentScene, Method, scene_slug
from avp_habitat.errors import AVPError
from avp_habitat.task.rewards import find_reward, needs_parallax, needs_surface

TRAIN, COLLECT, RECONSTRUCT = "train", "collect", "reconstruct"
_MADE = {TRAIN: "model.zip", COLLECT: "rollout", RECONSTRUCT: "reconstruction"}
_START_SEEDS = 1000
"""Seed of the first start of seed 0, and from one start of a seed to its next: more starts leave those before them."""
PARALLAX_OBSERVATION = "onboard"
"""What a policy whose reward needs parallax observes; its likeliest actions do as well as sampled ones."""
_SURFACE_OBSERVATION = {"map": "surface_map"}
"""What a policy whose reward needs the surface observes instead."""
_CURVES = ("avp/cpv", "avp/coverage", "avp/views", "rollout/ep_rew_mean")
"""Metrics of a training whose course is kept."""


@dataclass(frozen=True)
class Cell:
    """One piece of the experiment, done by one command."""

    kind: str
    name: str
    """Unique within its kind."""
    words: tuple[str, ...]
    """The command line, `python -m MODULE …`, which works alone too."""
    method: Method
    seed: int
    scene: ExperimentScene | None = None
    """None for a training."""
    start: int = 0
    """Number of the episode within its seed."""
    frames: int | None = None
    """The first so many, of a reconstruction; None: all."""
    needs: "Cell | None" = None

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
        return self.folder(root) / _MADE[self.kind]


def plan(configuration: Configuration, root: Path, *, tracking: str) -> list[Cell]:
    """All cells, each after the one that it needs; trainings are logged to the MLflow experiment `tracking`."""
    planner = _Planner(configuration, root, tracking)
    cells: list[Cell] = []
    trainings = configuration.preset.trainings or configuration.preset.seeds
    for seed in range(configuration.preset.seeds):
        for method in configuration.methods:
            training = planner.training(method, seed % trainings) if method.learned else None
            cells += [training] if training and seed < trainings else []
            for scene in configuration.scenes:
                for start in range(configuration.preset.starts):
                    rollout = planner.rollout(method, seed, scene, start, training)
                    cells += [rollout, *planner.reconstructions(rollout)]
    # Trainings first, then what is whole: an experiment that is interrupted late lacks only curves.
    return sorted(cells, key=lambda cell: (list(_MADE).index(cell.kind), cell.frames is not None))


@dataclass(frozen=True)
class _Planner:
    """Makes the cells of one experiment."""

    configuration: Configuration
    root: Path
    tracking: str

    def training(self, method: Method, seed: int) -> Cell:
        configuration, preset = self.configuration, self.configuration.preset
        observation, reward = preset.observation, find_reward(method.reward)
        if needs_parallax(reward):
            observation = PARALLAX_OBSERVATION
        elif needs_surface(reward):
            observation = _SURFACE_OBSERVATION.get(observation, observation)
        scenes = [scene.spec for scene in configuration.scenes if scene.role == TRAIN_SCENE]
        name = f"{method.name}-{seed}"
        words = ["python", "-m", "avp_sb3.train", "--scene", *(configuration.rooms if method.in_rooms else scenes)]
        of = ["--start", method.spec] if method.tuned else ["--observation", observation]
        words += ["--reward", method.reward, *of, "--seed", str(seed)]
        words += ["--steps", str(preset.steps_rooms if method.in_rooms else preset.steps)]
        words += [*configuration.simulator_options, "--out", self._out(TRAIN, name)]
        words += ["--experiment", self.tracking, "--run-name", f"{method.name} (seed {seed})"]
        return Cell(TRAIN, name, tuple(words), method, seed)

    def rollout(self, method: Method, seed: int, scene: ExperimentScene, start: int, training: Cell | None) -> Cell:
        preset, (width, height) = self.configuration.preset, self.configuration.preset.size
        after = [str(preset.scaled(views, scene.budget)) for views in preset.geometry_after]
        policy = (str(training.output(self.root)),) if training else (method.spec,)
        policy += ("--stochastic",) if training and not needs_parallax(find_reward(method.reward)) else ()
        name = f"{method.name}-{scene_slug(scene.name)}-{seed}-{start}"
        words = ["python", "-m", "avp_habitat.collect", "--scene", scene.spec, "--policy", *policy]
        words += ["--reward", method.reward]
        # Every method starts at the same places.
        words += ["--seed", str(_START_SEEDS * (1 + start) + seed), "--budget", str(scene.budget)]
        words += ["--width", str(width), "--height", str(height), *self.configuration.simulator_options]
        words += ["--metrics", *self.configuration.metrics] if self.configuration.metrics else []
        words += ["--geometry", *(["--geometry-after", *after] if after else [])]
        words += ["--out", self._out(COLLECT, name), "--mlflow", "off"]
        return Cell(COLLECT, name, tuple(words), method, seed, scene, start, needs=training)

    def reconstructions(self, rollout: Cell) -> list[Cell]:
        preset, scene = self.configuration.preset, rollout.scene
        if preset.reconstructed is not None and (rollout.seed >= preset.reconstructed or rollout.start):
            return []
        assert scene is not None
        prefixes = [preset.scaled(frames, scene.budget) for frames in preset.prefixes]
        return [self._reconstruction(rollout, scene, frames) for frames in (None, *prefixes)]

    def _reconstruction(self, rollout: Cell, scene: ExperimentScene, frames: int | None) -> Cell:
        preset, of = self.configuration.preset, rollout
        name = of.name if frames is None else f"{of.name}-first_{frames}"
        words = ["python", "-m", "avp_nerfstudio.reconstruct", str(of.output(self.root))]
        words += ["--out", self._out(RECONSTRUCT, name), "--method", preset.reconstruction]
        words += ["--iterations", str(preset.iterations)]
        words += ["--frames", str(frames)] if frames is not None else []
        if preset.model_geometry and frames is None:
            words += ["--scene", scene.spec, *self.configuration.simulator_options]
        if frames is None and of.seed == 0 and of.start == 0:
            words += ["--pictures", *map(str, preset.heldout_pictures)]
        return Cell(RECONSTRUCT, name, tuple(words), of.method, of.seed, of.scene, of.start, frames, of)

    def _out(self, kind: str, name: str) -> str:
        return str(self.root / "cells" / kind / name / _MADE[kind])


def facts_of(cell: Cell, root: Path) -> dict[str, Any]:
    """What is kept of a cell whose command has succeeded; an `AVPError` where that cannot be used."""
    facts = {TRAIN: _of_training, COLLECT: _of_rollout, RECONSTRUCT: _of_reconstruction}
    return facts[cell.kind](cell.output(root))


def _of_training(path: Path) -> dict[str, Any]:
    """The metrics' curves are `[step, value]` points; empty where MLflow has not got the run yet."""
    from mlflow import MlflowClient

    from avp_habitat.policies.registry import load_model
    from avp_habitat.tracking.experiments import find_run

    model = load_model(path)
    client, run_id = MlflowClient(os.environ["MLFLOW_TRACKING_URI"]), getattr(model, "avp_mlflow_run_id", None)
    curves = {}
    if (run := find_run(client, run_id)) is not None:
        for metric in _CURVES:
            found = {point.step: point.value for point in client.get_metric_history(run.info.run_id, metric)}
            curves[metric] = [[step, round(found[step], 6)] for step in sorted(found)]
    return {"steps": model.num_timesteps, "run_id": run_id, "curves": curves}


def _of_rollout(folder: Path) -> dict[str, Any]:
    """The episode's figures, and what was seen after each view; geometry after some."""
    from avp_habitat.rollout.format import read_rollout
    from avp_habitat.rollout.seen import visibility_of

    rollout = read_rollout(folder)
    seen = visibility_of(rollout.frames, rollout.heldout, rollout.intrinsics)
    return {
        "metrics": rollout.meta["metrics"] | seen.figures(),
        "coverage_curve": [round(float(row["coverage"]), 6) for row in _steps(folder)],
        "visibility_curve": [round(float(share), 6) for share in seen.curve()],
        "parallax_curve": [round(float(share), 6) for share in seen.curve(parallax=True)],
        "geometry_after": rollout.meta.get("geometry_after", {}),
    }


def _steps(folder: Path) -> list[dict[str, str]]:
    with (folder / "steps.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def floor_map(folder: Path) -> dict[str, Any] | None:
    """A rollout's map as `results.json` keeps it, with `[x, z, yaw]` after each step in metres and radians, if any."""
    from avp_habitat.rollout.format import read_rollout
    from avp_habitat.rollout.images import read_numbers

    floor = read_rollout(folder).floor
    if floor is None:
        return None
    numbers = read_numbers(floor.picture).astype("<u2")
    return {
        "cell_m": floor.cell_m,
        "origin_m": list(floor.origin_m),
        "shape": list(floor.shape),
        "floor": base64.b64encode(zlib.compress(numbers.tobytes(), 9)).decode("ascii"),
        "path": [[round(float(row[name]), 4) for name in ("x_m", "z_m", "yaw_rad")] for row in _steps(folder)],
    }


def _of_reconstruction(folder: Path) -> dict[str, Any]:
    path = folder / "scores.json"
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise AVPError(f"{path}: expected the scores of a reconstruction: {error}") from None
