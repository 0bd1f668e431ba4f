"""An evaluation in MLflow: one run for the whole, and below it one run per policy."""

import os
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mlflow
import numpy as np
from mlflow import MlflowClient
from mlflow.entities import Metric, Param
from mlflow.exceptions import MlflowException
from mlflow.tracking.context.registry import resolve_tags
from numpy.typing import NDArray

from avp_habitat.metrics import explained
from avp_habitat.provenance import flat
from avp_habitat.tracking.experiments import chosen_experiment, experiment_id
from avp_habitat.tracking.names import COLOUR_TAG, NOTE_TAG, safe_name
from avp_habitat.tracking.stores import DEFAULT_ADDRESS, TrackingError, connect, first_line, shown
from avp_habitat.tracking.view import prepare_experiment, run_colour
from avp_sb3.evaluation.policy import PolicyResult, mean_and_half_width
from avp_sb3.evaluation.report import PLOT_FILE, ReportError, cells, cpv, summary

TABLE = "policies.json"
"""Artifact of the upper run that MLflow's page shows as a table."""
KIND_TAG, KIND = "avp.kind", "evaluation"
_TOLD = ("policy", "coverage [%]", "views", "CpV [%/view]", "ended by a stop [%]", "episodes")
_TERMS = f"{explained('coverage', 'views', 'CpV', 'stop')}."
_PREFIX = "eval"
_MAX_PARAM, _MAX_TAG = 6000, 5000


def track_evaluation(
    results: Sequence[PolicyResult],
    about: Mapping[str, Any],
    folder: Path,
    *,
    experiment: str | None,
    complete: bool = True,
    pictures: Mapping[str, NDArray[np.uint8]] | None = None,
) -> tuple[str, str, str]:
    """Log an evaluation.

    The upper run holds the table of the policies and the plot of their curves. Each policy's run holds `eval/FIGURE`
    (the mean), `eval/FIGURE_ci95` (half of the interval), `eval/cpv`, its picture and, by view, `eval/curve` with
    `eval/curve_ci95`. The run that trained a policy is its tag `avp.policy_run`, because a run of MLflow has one
    parent only.

    Args:
        results: of the policies.
        about: what was evaluated; becomes parameters.
        folder: of the report; its files become artifacts of the upper run.
        experiment: MLflow experiment, made when it does not exist; as `experiments.chosen_experiment` says when None.
        complete: False marks the runs as interrupted.
        pictures: `(h, w, 3)` by policy, for those that have one.

    Raises:
        ReportError: MLflow failed; the report is on disk.

    Returns:
        The upper run's id, the experiment's name, and the address of the store without a password: what is
        configured, else `sqlite:///mlflow.db`.
    """
    address = mlflow.get_tracking_uri() if mlflow.is_tracking_uri_set() else DEFAULT_ADDRESS
    try:
        client = connect(address)
        identity = experiment_id(client, *chosen_experiment(experiment))
        prepare_experiment(client, identity)
        parent = _log(client, identity, results, about, folder, "FINISHED" if complete else "KILLED", pictures or {})
        name = client.get_experiment(identity).name
    except (MlflowException, TrackingError, OSError) as error:
        raise ReportError(f"the report is in {folder}, but MLflow did not take it: {first_line(error)}") from error
    return parent, name, shown(address)


def _log(
    client: MlflowClient,
    experiment: str,
    results: Sequence[PolicyResult],
    about: Mapping[str, Any],
    folder: Path,
    status: str,
    pictures: Mapping[str, NDArray[np.uint8]],
) -> str:
    tags = _tags(about)
    params = [Param(safe_name(name), str(value)[:_MAX_PARAM]) for name, value in flat(about).items()]
    parent = client.create_run(experiment, run_name="evaluation", tags=tags).info.run_id
    client.log_batch(parent, params=params)
    names = _names(results)
    for result, name in zip(results, names, strict=True):
        own = {"mlflow.parentRunId": parent, "avp.policy": name, COLOUR_TAG: run_colour(name)}
        own |= {"avp.policy_run": result.training_run} if result.training_run else {}
        run = client.create_run(experiment, run_name=name, tags=tags | own).info.run_id
        client.log_batch(run, metrics=_metrics(result), params=_own_params(result, about))
        if result.policy in pictures:
            client.log_image(run, pictures[result.policy], key=f"{_PREFIX}/trajectory", step=0)
        client.set_terminated(run, status)
    _log_table(client, parent, results, names)
    client.log_artifacts(parent, os.fspath(folder))
    _log_plot(client, parent, folder / PLOT_FILE)
    client.set_terminated(parent, status)
    return parent


def _own_params(result: PolicyResult, about: Mapping[str, Any]) -> list[Param]:
    """Few: the page writes all of a run's above its picture; the upper run has the others, which all policies share."""
    settings = about.get("settings")
    shared = {name: about.get(name) for name in ("episodes", "seed")}
    shared["budget"] = settings.get("budget") if isinstance(settings, Mapping) else None
    own = {"policy": result.policy, "observation": result.observation, **shared}
    return [Param(name, str(value)[:_MAX_PARAM]) for name, value in own.items() if value is not None]


def _tags(about: Mapping[str, Any]) -> dict[str, str]:
    tags = dict(resolve_tags()) | {KIND_TAG: KIND}
    scene = about.get("scene")
    if isinstance(scene, Mapping):
        named = {"avp.scene": scene.get("name"), "avp.scene_digest": scene.get("sha256")}
        tags |= {key: str(value) for key, value in named.items() if value is not None}
    return tags


def _names(results: Sequence[PolicyResult]) -> list[str]:
    """The policies' names as rollouts have them, or as they were given where two would be the same."""
    short = [Path(result.policy).name for result in results]
    count = Counter(short)
    return [name if count[name] == 1 else result.policy for name, result in zip(short, results, strict=True)]


def _log_table(client: MlflowClient, run: str, results: Sequence[PolicyResult], names: Sequence[str]) -> None:
    """The policies as rows of a table; the most telling columns also as text that the page shows above all else."""
    columns = {"policy": list(names), **cells(results)}
    client.log_table(run, columns, TABLE)
    told = {title: columns[title] for title in _TOLD if title in columns}
    rows = [told, ["---"] * len(told), *zip(*told.values(), strict=True)]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    note = "\n".join([*lines, "", "Means over the episodes; ± is half of the 95 % interval.", "", _TERMS])
    client.set_tag(run, NOTE_TAG, note[:_MAX_TAG])


def _log_plot(client: MlflowClient, run: str, path: Path) -> None:
    """Once more as a picture by step, because only such appear among the charts."""
    from avp_habitat.rollout.images import read_rgb

    if path.is_file():
        client.log_image(run, read_rgb(path), key=f"{_PREFIX}/coverage_by_view", step=0)


def _metrics(result: PolicyResult) -> list[Metric]:
    now = int(time.time() * 1000)
    metrics = [
        Metric(f"{_PREFIX}/episodes", float(len(result.seeds)), now, 0),
        Metric(f"{_PREFIX}/cpv", cpv(result), now, 0),
    ]
    for name, values in summary(result).items():
        metrics += _pair(f"{_PREFIX}/{name}", values["mean"], values["half_width"], now, 0)
    mean, half = mean_and_half_width(result.curve)
    for view, (value, width) in enumerate(zip(mean, half, strict=True), start=1):
        metrics += _pair(f"{_PREFIX}/curve", float(value), None if np.isnan(width) else float(width), now, view)
    return metrics


def _pair(name: str, mean: float | None, half: float | None, now: int, step: int) -> list[Metric]:
    values = {name: mean, f"{name}_ci95": half}
    return [Metric(key, value, now, step) for key, value in values.items() if value is not None]
