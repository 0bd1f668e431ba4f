"""`python -m avp_experiment.compare`: train, collect, reconstruct and compare; `mlflow run . -e compare`."""

import os
import shlex
import sys
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from avp_experiment.cells import plan
from avp_experiment.configuration import DEFAULT, PRESETS, ROOMS, Configuration, Method, chosen_methods, read_scenes
from avp_experiment.folder import open_folder
from avp_experiment.runner import PRELOAD, Runner, environment
from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError, unknown_name
from avp_habitat.metrics import METRICS_HELP, find_metrics
from avp_habitat.provenance import flat
from avp_habitat.scenes.location import UP_HELP
from avp_habitat.simulators.registry import SIMULATORS, SimulatorChoice
from avp_habitat.tracking.experiments import NAME_VARIABLE, existing_run, find_run
from avp_habitat.tracking.names import KIND_TAG, METHOD_TAG, PARENT_TAG, POLICY_TAG, SCENE_TAG
from avp_habitat.tracking.run import NewRun, TrackedRun, join_run, start_run
from avp_habitat.tracking.stores import DEFAULT_ADDRESS, connect

AUTO, NONE = "auto", "none"
EXPERIMENT, KIND = "avp-experiment", "experiment"
"""MLflow experiment outside of `mlflow run` where `MLFLOW_EXPERIMENT_NAME` names none; value of `avp.kind`."""
_ARTIFACTS = ("*.md", "*.csv", "*.png", "results.json", "experiment.json")
_SEEN = ("visibility", "visibility_parallax")
_SHOWN = ("views", "coverage", "annd_m", "ei", "path_length_m", *_SEEN, "collisions", "stopped")
_METHODS = f"with commas between: policies, rewards, rewards with {ROOMS}, module:object; auto: {', '.join(DEFAULT)}"


@dataclass(frozen=True)
class Compare:
    """Train every reward, let all methods take views from the same starts, reconstruct, score and compare.

    Writes tables, figures and the answers to the paper's questions. What is done is not done again.
    """

    scene: str = AUTO
    """Scenes to train in, with commas between; auto: builtin:0, of benchmarks none."""
    unseen: str = AUTO
    """Scenes never trained in, with commas between, or none; auto: builtin:1, of benchmarks their own, to which those
    named here come."""
    preset: Annotated[str, arg(help=", ".join(PRESETS))] = "cpu"
    seeds: str = AUTO
    """Trainings of each reward; auto: the preset's number."""
    starts: str = AUTO
    """Episodes of each method, scene and seed; auto: the preset's number."""
    methods: Annotated[str, arg(help=_METHODS)] = AUTO
    metrics: Annotated[str, arg(help=f"with commas between, or none: {METRICS_HELP}")] = NONE
    simulator: Annotated[str, arg(help=f"{', '.join(SIMULATORS)} or MODULE:FACTORY")] = "raycast"
    up: Annotated[str | None, arg(help=UP_HELP)] = None
    out: str = AUTO
    """The experiment's folder, also of one to go on with; auto: runs/experiment-PRESET."""
    jobs: str = AUTO
    """Cells at a time; auto: one per core."""

    def configuration(self) -> Configuration:
        """Everything that can be known to be wrong is refused here, before anything is written."""
        if self.preset not in PRESETS:
            raise unknown_name("preset", self.preset, PRESETS)
        preset = PRESETS[self.preset]
        methods = chosen_methods(preset.methods if self.methods == AUTO else _split(self.methods))
        seeds, starts = _number("seeds", self.seeds, preset.seeds), _number("starts", self.starts, preset.starts)
        if preset.benchmark:
            _hold_benchmark(self.preset, methods, seeds)
        preset = replace(preset, seeds=seeds, starts=starts)
        choice = SimulatorChoice(self.simulator, up=self.up)
        metrics = _split(self.metrics)
        find_metrics(metrics)
        train, unseen = ("", "") if preset.benchmark else ("builtin:0", "builtin:1")
        train, unseen = (auto if said == AUTO else said for said, auto in ((self.scene, train), (self.unseen, unseen)))
        found = read_scenes(_split(train), _split(unseen), choice, preset)
        return Configuration(self.preset, preset, found, methods, tuple(metrics), self.simulator, self.up)

    @property
    def line(self) -> str:
        """The command line as a user types it."""
        chosen = {name: str(value) for name, value in vars(self).items() if value != getattr(Compare, name)}
        if os.environ.get("MLFLOW_RUN_ID"):
            options = [f"-P {name}={shlex.quote(value)}" for name, value in chosen.items()]
            return " ".join(["mlflow run . -e compare --env-manager local", *options])
        options = [word for name, value in chosen.items() for word in (f"--{name}", value)]
        return shlex.join(["python", "-m", "avp_experiment.compare", *options])


def _hold_benchmark(name: str, methods: Sequence[Method], seeds: int) -> None:
    if seeds != PRESETS[name].seeds:
        raise UsageError(f"seeds: {name} has {PRESETS[name].seeds}, got {seeds}; more starts are welcome")
    for method in methods:
        if method.learned and not method.in_rooms:
            raise UsageError(
                f"methods: nothing is trained in the scenes of {name}, as {method.name} would be; expected a policy or "
                f"REWARD{ROOMS}, which is trained in generated rooms"
            )


def _split(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip() not in ("", NONE)]


def _number(option: str, text: str, auto: int) -> int:
    if text == AUTO:
        return auto
    if not text.isdecimal() or int(text) < 1:
        raise UsageError(f"{option}: expected a whole number from 1, or {AUTO}, got {text!r}")
    return int(text)


def compare(configuration: Configuration, out: Path, *, jobs: int, line: str) -> None:
    """Do what is left, `jobs` cells at a time, then write tables and figures and log them with the command's line.

    Raises:
        AVPError: the folder cannot be used, or some cells failed; the others are done then.
    """
    from avp_experiment.gathering import gather
    from avp_experiment.report import write_report

    folder = open_folder(configuration, out)
    with folder.alone():
        parent, experiment = open_parent(f"compare {configuration.preset_name}")
        status = "FAILED"
        try:
            cells = plan(configuration, out, tracking=experiment)
            print(f"{sum(not folder.is_done(cell) for cell in cells)} of {len(cells)} cells to do: {out}")
            preload = () if SimulatorChoice(configuration.simulator).one_per_process else PRELOAD
            runner = Runner(folder, jobs, environment(parent.address), preload)
            runner.run(cells)
            results = gather(configuration, folder, cells, command=line)
            write_report(out)
            log_results(parent, experiment, results, out)
            status = "FINISHED"
        except KeyboardInterrupt:
            status = "KILLED"
            print(f"\nwhat is done is kept in {out}; to go on:  {line}", file=sys.stderr)
            raise
        finally:
            parent.close(status)
    print(f"results:      {out}/results.md (tables, figures, claims; from {out}/results.json)")
    print(f"MLflow run:   {parent.run_id}")
    if runner.failed:
        failed = f"{len(runner.failed)} of {len(cells)} cells failed (reasons: {out}/results.md)"
        raise AVPError(f"{failed}; the same command tries them again")


def open_parent(name: str) -> tuple[TrackedRun, str]:
    """The run that `mlflow run` has begun, else a new one; and the MLflow experiment, also that of the trainings."""
    address, begun = os.environ.get("MLFLOW_TRACKING_URI") or DEFAULT_ADDRESS, os.environ.get("MLFLOW_RUN_ID")
    if begun:
        client = connect(address)
        identity = existing_run(client, begun).info.experiment_id
        client.set_tag(begun, KIND_TAG, KIND)
        return join_run(address, begun), client.get_experiment(identity).name
    experiment = os.environ.get(NAME_VARIABLE) or EXPERIMENT
    return start_run(address, NewRun(experiment=experiment, name=name, tags={KIND_TAG: KIND})), experiment


def log_results(run: TrackedRun, experiment: str, results: Mapping[str, Any], folder: Path) -> None:
    """Tables, figures and means into the parent, its trainings below it, and a run for each method, scene and seed."""
    settings = {name: value for name, value in results["configuration"].items() if name != "scenes"}
    scenes = {f"scene.{scene['role']}.{i}": scene["name"] for i, scene in enumerate(results["configuration"]["scenes"])}
    run.params(flat({"experiment": settings}) | scenes)
    for pattern in _ARTIFACTS:
        for path in sorted(folder.glob(pattern)):
            run.file(path)
    by_method: dict[str, list[dict[str, float]]] = defaultdict(list)
    for (method, role, scene, seed), figures in _by_seed(results).items():
        by_method[f"{role}/{method}"].append(figures)
        tags = {POLICY_TAG: method, SCENE_TAG: scene, METHOD_TAG: "experiment", "avp.role": role}
        tags |= {KIND_TAG: "experiment-cell"}
        name = f"{method} on {scene} (seed {seed})"
        child = start_run(run.address, NewRun(experiment=experiment, name=name, tags=tags, parent=run.run_id))
        child.params({"method": method, "scene": scene, "role": role, "seed": seed})
        child.metrics({f"eval/{name}": value for name, value in figures.items()}, 0)
        child.close("FINISHED")
    for prefix, seeds in by_method.items():
        for name in sorted(set().union(*seeds)):
            known = [one[name] for one in seeds if name in one]
            run.metrics({f"{prefix}/{name}": sum(known) / len(known)}, 0)
    run.metrics({"failed_cells": float(len(results["failed"]))}, 0)
    run.flush()
    client = connect(run.address)
    for training in results["training"]:
        # Also those that an earlier start of the experiment made.
        if find_run(client, training["run_id"]) is not None:
            client.set_tag(training["run_id"], PARENT_TAG, run.run_id)


def _by_seed(results: Mapping[str, Any]) -> dict[tuple[str, str, str, int], dict[str, float]]:
    """Means over starts, by method, role, scene and seed."""
    found: dict[tuple[str, str, str, int], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    shown = (*_SHOWN, *results["figures"])
    for part in (*results["rollouts"], *(one for one in results["reconstructions"] if one["whole"])):
        figures = part["scores"] if "scores" in part else part["metrics"]
        for name, value in figures.items():
            if value is not None and (name in shown or "scores" in part):
                found[part["method"], part["role"], part["scene"], part["seed"]][name].append(value)
    return {key: {name: sum(values) / len(values) for name, values in one.items()} for key, one in found.items()}


def main(options: Compare) -> None:
    """Compare."""
    began = time.monotonic()
    configuration = options.configuration()
    out = Path("runs") / f"experiment-{options.preset}" if options.out == AUTO else Path(options.out)
    jobs = _number("jobs", options.jobs, len(os.sched_getaffinity(0)))
    compare(configuration, out, jobs=jobs, line=options.line)
    print(f"done in {(time.monotonic() - began) / 60:.1f} min")


if __name__ == "__main__":
    sys.exit(command.run(main))
