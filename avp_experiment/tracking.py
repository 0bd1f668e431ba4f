"""The experiment in MLflow: one parent run with tables and figures, below it one for each method, scene and seed."""

import os
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_habitat.metrics import mean_and_half_width
from avp_habitat.provenance import flat
from avp_habitat.tracking.experiments import NAME_VARIABLE, existing_run, find_run
from avp_habitat.tracking.names import KIND_TAG, METHOD_TAG, PARENT_TAG, POLICY_TAG, SCENE_TAG
from avp_habitat.tracking.run import NewRun, Status, TrackedRun, join_run, start_run
from avp_habitat.tracking.stores import DEFAULT_ADDRESS, absolute, connect

EXPERIMENT = "avp-experiment"
"""MLflow experiment outside of `mlflow run` where `MLFLOW_EXPERIMENT_NAME` names none."""
KIND = "experiment"
_ARTIFACTS = ("*.md", "*.csv", "*.png", "results.json", "experiment.json")
_SHOWN = ("views", "coverage", "annd_m", "ei", "path_length_m", "visibility", "collisions", "stopped")


@dataclass
class Parent:
    """The parent run."""

    run: TrackedRun
    """Where the tables go."""
    experiment: str
    """Name of its MLflow experiment, in which the trainings are made too."""

    def close(self, status: Status) -> None:
        """End it; one of `mlflow run` gets its end from there."""
        self.run.close(status)


def tracking_uri() -> str:
    """Where runs are kept: `MLFLOW_TRACKING_URI`, which `mlflow run` sets, else a database in the current folder."""
    return absolute(os.environ.get("MLFLOW_TRACKING_URI") or DEFAULT_ADDRESS)


def open_parent(name: str) -> Parent:
    """The run that `mlflow run` has begun, else a new one.

    Raises:
        TrackingError: the store cannot be used.
    """
    address, begun = tracking_uri(), os.environ.get("MLFLOW_RUN_ID")
    if begun:
        client = connect(address)
        identity = existing_run(client, begun).info.experiment_id
        client.set_tag(begun, KIND_TAG, KIND)
        return Parent(join_run(address, begun), client.get_experiment(identity).name)
    experiment = os.environ.get(NAME_VARIABLE) or EXPERIMENT
    run = start_run(address, NewRun(experiment=experiment, name=name, tags={KIND_TAG: KIND}))
    return Parent(run, experiment)


def log_results(parent: Parent, results: dict[str, Any], folder: Path) -> None:
    """Tables, figures and means into the parent, its trainings below it, and a run for each method, scene and seed.

    Raises:
        TrackingError: the store cannot be used.
    """
    run = parent.run
    settings = {name: value for name, value in results["configuration"].items() if name != "scenes"}
    scenes = {f"scene.{scene['role']}.{i}": scene["name"] for i, scene in enumerate(results["configuration"]["scenes"])}
    run.params(flat({"experiment": settings}) | scenes)
    for pattern in _ARTIFACTS:
        for path in sorted(folder.glob(pattern)):
            run.file(path)
    by_method: dict[tuple[str, str], list[dict[str, float]]] = defaultdict(list)
    for key, figures in _by_seed(results).items():
        by_method[key[:2]].append(figures)
        _child(parent, key, figures)
    for (method, role), seeds in by_method.items():
        run.metrics(_means(f"{role}/{method}", seeds), 0)
    run.metrics({"failed_cells": float(len(results["failed"]))}, 0)
    run.flush()
    _adopt(run, (training["run_id"] for training in results["training"]))


def _by_seed(results: dict[str, Any]) -> dict[tuple[str, str, str, int], dict[str, float]]:
    """Means over starts, by method, role, scene and seed."""
    found: dict[tuple[str, str, str, int], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for part in (*results["rollouts"], *(one for one in results["reconstructions"] if one["whole"])):
        figures = found[part["method"], part["role"], part["scene"], part["seed"]]
        values = part.get("scores") or {name: part["metrics"].get(name) for name in _SHOWN}
        for name, value in values.items():
            if value is not None:
                figures[f"eval/{name}"].append(value)
    return {key: {name: sum(values) / len(values) for name, values in one.items()} for key, one in found.items()}


def _means(prefix: str, seeds: list[dict[str, float]]) -> dict[str, float]:
    names = set.intersection(*(set(seed) for seed in seeds))
    return {
        f"{prefix}/{name.removeprefix('eval/')}": float(mean_and_half_width([seed[name] for seed in seeds])[0])
        for name in sorted(names)
    }


def _child(parent: Parent, key: tuple[str, str, str, int], figures: dict[str, float]) -> None:
    method, role, scene, seed = key
    tags = {
        POLICY_TAG: method,
        SCENE_TAG: scene,
        METHOD_TAG: "experiment",
        "avp.role": role,
        KIND_TAG: "experiment-cell",
    }
    new = NewRun(
        experiment=parent.experiment, name=f"{method} on {scene} (seed {seed})", tags=tags, parent=parent.run.run_id
    )
    child = start_run(parent.run.address, new)
    child.params({"method": method, "scene": scene, "role": role, "seed": seed})
    child.metrics(figures, 0)
    child.close("FINISHED")


def _adopt(run: TrackedRun, trainings: Iterable[str | None]) -> None:
    """Show the trainings below the parent, also those that an earlier start of the experiment made."""
    client = connect(run.address)
    for run_id in trainings:
        if run_id is not None and find_run(client, run_id) is not None:
            client.set_tag(run_id, PARENT_TAG, run.run_id)
