"""The experiment in MLflow: one parent run with tables and figures, below it one for each method, scene and seed."""

import os
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from avp_habitat.provenance import flat
from avp_habitat.tracking.experiments import NAME_VARIABLE, existing_run, find_run
from avp_habitat.tracking.names import KIND_TAG, METHOD_TAG, PARENT_TAG, POLICY_TAG, SCENE_TAG
from avp_habitat.tracking.run import NewRun, TrackedRun, join_run, start_run
from avp_habitat.tracking.stores import DEFAULT_ADDRESS, absolute, connect

EXPERIMENT = "avp-experiment"
"""MLflow experiment outside of `mlflow run` where `MLFLOW_EXPERIMENT_NAME` names none."""
KIND = "experiment"
_ARTIFACTS = ("*.md", "*.csv", "*.png", "results.json", "experiment.json")
_SHOWN = ("views", "coverage", "annd_m", "ei", "path_length_m", "visibility", "collisions", "stopped")
Figures = dict[str, float]


def tracking_uri() -> str:
    """Where runs are kept: `MLFLOW_TRACKING_URI`, which `mlflow run` sets, else a database in the current folder."""
    return absolute(os.environ.get("MLFLOW_TRACKING_URI") or DEFAULT_ADDRESS)


def open_parent(name: str) -> tuple[TrackedRun, str]:
    """The run that `mlflow run` has begun, else a new one; and the MLflow experiment, in which trainings are made too.

    Raises:
        TrackingError: the store cannot be used.
    """
    address, begun = tracking_uri(), os.environ.get("MLFLOW_RUN_ID")
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
    by_method: dict[str, list[Figures]] = defaultdict(list)
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
        common = set.intersection(*map(set, seeds))
        run.metrics({f"{prefix}/{name}": sum(one[name] for one in seeds) / len(seeds) for name in sorted(common)}, 0)
    run.metrics({"failed_cells": float(len(results["failed"]))}, 0)
    run.flush()
    _put_below(run, (training["run_id"] for training in results["training"]))


def _by_seed(results: Mapping[str, Any]) -> dict[tuple[str, str, str, int], Figures]:
    """Means over starts, by method, role, scene and seed."""
    found: dict[tuple[str, str, str, int], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for part in (*results["rollouts"], *(one for one in results["reconstructions"] if one["whole"])):
        figures = found[part["method"], part["role"], part["scene"], part["seed"]]
        names = part.get("scores") or (*_SHOWN, *results["figures"])
        for name in names:
            if (value := part.get("scores", part.get("metrics", {})).get(name)) is not None:
                figures[name].append(value)
    return {key: {name: sum(values) / len(values) for name, values in one.items()} for key, one in found.items()}


def _put_below(run: TrackedRun, trainings: Iterable[str | None]) -> None:
    """Show the trainings below the parent, also those that an earlier start of the experiment made."""
    client = connect(run.address)
    for run_id in trainings:
        if run_id is not None and find_run(client, run_id) is not None:
            client.set_tag(run_id, PARENT_TAG, run.run_id)
