"""An evaluation in MLflow: one run for the whole, and below it one run per policy."""

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mlflow
import numpy as np
from mlflow import MlflowClient
from mlflow.entities import Metric, Param, RunTag
from mlflow.exceptions import MlflowException
from mlflow.tracking.context.registry import resolve_tags

from avp_habitat.provenance import flat, git_commit
from avp_sb3.evaluation import PolicyResult
from avp_sb3.evaluation_report import ReportError, summary
from avp_sb3.evaluation_statistics import mean_and_half_width
from avp_sb3.mlflow_callback import DEFAULT_TRACKING_URI
from avp_sb3.mlflow_writer import safe_name
from avp_sb3.run_facts import version_tags

_PREFIX = "eval"
_MAX_PARAM = 6000


def track_evaluation(
    results: Sequence[PolicyResult],
    about: Mapping[str, Any],
    folder: Path,
    *,
    experiment: str,
    complete: bool = True,
) -> tuple[str, str]:
    """Log an evaluation.

    Each policy's run holds `eval/FIGURE` (the mean), `eval/FIGURE_ci95` (half of the interval) and, by view,
    `eval/curve` with `eval/curve_ci95`.

    Args:
        results: of the policies.
        about: what was evaluated; becomes parameters.
        folder: of the report; its files become artifacts of the upper run.
        experiment: MLflow experiment, made when it does not exist.
        complete: False marks the runs as interrupted.

    Raises:
        ReportError: MLflow failed; the report is on disk.

    Returns:
        The upper run's id and the address of the store: what is configured, else `sqlite:///mlflow.db`.
    """
    try:
        return _log(results, about, folder, experiment, "FINISHED" if complete else "KILLED")
    except (MlflowException, OSError) as error:
        raise ReportError(f"the report is in {folder}, but MLflow did not take it: {error}") from error


def _log(
    results: Sequence[PolicyResult], about: Mapping[str, Any], folder: Path, experiment: str, status: str
) -> tuple[str, str]:
    client = MlflowClient(mlflow.get_tracking_uri() if mlflow.is_tracking_uri_set() else DEFAULT_TRACKING_URI)
    found = client.get_experiment_by_name(experiment)
    identity = found.experiment_id if found else client.create_experiment(experiment)
    tags = dict(resolve_tags()) | version_tags()
    if (commit := git_commit()) is not None:
        tags["mlflow.source.git.commit"] = commit
    params = _params(about)
    parent = client.create_run(identity, run_name="evaluation", tags=tags).info.run_id
    client.log_batch(parent, params=params)
    for result in results:
        own = {"mlflow.parentRunId": parent} | ({"avp.policy_run": result.training_run} if result.training_run else {})
        run = client.create_run(identity, run_name=_run_name(result.policy), tags=tags | own).info.run_id
        client.log_batch(
            run,
            metrics=_metrics(result),
            params=[*params, Param("policy", result.policy), Param("observation", str(result.observation))],
            tags=[RunTag("avp.policy", result.policy)],
        )
        client.set_terminated(run, status)
    client.log_artifacts(parent, os.fspath(folder))
    client.set_terminated(parent, status)
    return parent, client.tracking_uri


def _params(about: Mapping[str, Any]) -> list[Param]:
    return [Param(safe_name(name), str(value)[:_MAX_PARAM]) for name, value in flat(about).items()]


def _run_name(policy: str) -> str:
    return Path(policy).name


def _metrics(result: PolicyResult) -> list[Metric]:
    now = int(time.time() * 1000)
    metrics = [Metric(f"{_PREFIX}/episodes", float(len(result.seeds)), now, 0)]
    for name, values in summary(result).items():
        metrics += _pair(f"{_PREFIX}/{name}", values["mean"], values["half_width"], now, 0)
    mean, half = mean_and_half_width(result.curve)
    for view, (value, width) in enumerate(zip(mean, half, strict=True), start=1):
        metrics += _pair(f"{_PREFIX}/curve", float(value), None if np.isnan(width) else float(width), now, view)
    return metrics


def _pair(name: str, mean: float | None, half: float | None, now: int, step: int) -> list[Metric]:
    values = {name: mean, f"{name}_ci95": half}
    return [Metric(key, value, now, step) for key, value in values.items() if value is not None]
