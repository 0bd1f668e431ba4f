"""An evaluation in MLflow: one run for the whole, and below it one run per policy."""

import os
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mlflow
import numpy as np
from mlflow import MlflowClient
from mlflow.entities import Metric, Param
from mlflow.exceptions import MlflowException
from mlflow.tracking.context.registry import resolve_tags
from numpy.typing import NDArray

from avp_habitat import tables
from avp_habitat.metrics import FIGURES, explained, mean_and_half_width
from avp_habitat.provenance import flat
from avp_habitat.rollout.images import read_rgb
from avp_habitat.tracking.experiments import chosen_experiment, experiment_id
from avp_habitat.tracking.names import COLOUR_TAG, NOTE_TAG, safe_name
from avp_habitat.tracking.stores import DEFAULT_ADDRESS, TrackingError, connect, first_line, shown
from avp_habitat.tracking.view import prepare_experiment, run_colour
from avp_sb3.evaluation.policy import PolicyResult
from avp_sb3.evaluation.report import PLOT_FILE, ReportError, cells, cpv, summary

TABLE = "policies.json"
"""Artifact of the upper run that MLflow's page shows as a table."""
_NOTED = ("policy", *(FIGURES[name].heading for name in ("coverage", "views", "cpv", "stopped")), "episodes")
"""Columns of the table that the page shows above all else."""
_TERMS = f"Means over the episodes; ± is half of the 95 % interval.\n\n{explained('coverage', 'views', 'CpV', 'stop')}."
_MAX_PARAM, _MAX_TAG = 6000, 5000


def track_evaluation(
    results: Sequence[PolicyResult],
    about: Mapping[str, Any],
    folder: Path,
    *,
    experiment: str | None,
    pictures: Mapping[str, NDArray[np.uint8]],
    metrics: Iterable[Any] = (),
) -> tuple[str, str, str]:
    """Log an evaluation.

    The upper run holds the table of the policies and the plot of their curves. Each policy's run holds `eval/FIGURE`
    (the mean), `eval/FIGURE_ci95` (half of the interval), `eval/cpv`, its picture and, by view, `eval/curve` with
    `eval/curve_ci95`. What was evaluated (`about`, as `avp_sb3.evaluate` writes it) becomes parameters; unless it is
    `complete`, the runs are marked as interrupted. The files in the report's folder become artifacts.

    Raises:
        ReportError: MLflow failed; the report is on disk.

    Returns:
        The upper run's id, the experiment's name, and the address of the store without a password.
    """
    address = mlflow.get_tracking_uri() if mlflow.is_tracking_uri_set() else DEFAULT_ADDRESS
    try:
        client = connect(address)
        identity = experiment_id(client, *chosen_experiment(experiment))
        prepare_experiment(client, identity)
        parent = _log(client, identity, results, about, folder, pictures, cells(results, metrics))
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
    pictures: Mapping[str, NDArray[np.uint8]],
    shown: Mapping[str, list[str]],
) -> str:
    status = "FINISHED" if about["complete"] else "KILLED"
    scene = {"avp.scene": str(about["scene"]["name"]), "avp.scene_digest": str(about["scene"]["sha256"])}
    tags = dict(resolve_tags()) | {"avp.kind": "evaluation"} | scene
    parent = client.create_run(experiment, run_name="evaluation", tags=tags).info.run_id
    client.log_batch(parent, params=_params(flat(about)))
    # As rollouts have them, or as they were given where two would be the same.
    short = Counter(Path(result.policy).name for result in results)
    names = [name if short[name := Path(each.policy).name] == 1 else each.policy for each in results]
    for result, name in zip(results, names, strict=True):
        own = {"mlflow.parentRunId": parent, "avp.policy": name, COLOUR_TAG: run_colour(name)}
        # A run of MLflow has one parent only.
        own |= {"avp.policy_run": result.training_run} if result.training_run else {}
        run = client.create_run(experiment, run_name=name, tags=tags | own).info.run_id
        # Few: the page writes all of a run's above its picture; the upper run has the others, which all policies share.
        shared = {"episodes": about["episodes"], "seed": about["seed"], "budget": about["settings"]["budget"]}
        params = _params({"policy": result.policy, "observation": result.observation, **shared})
        client.log_batch(run, metrics=_metrics(result), params=params)
        if result.policy in pictures:
            client.log_image(run, pictures[result.policy], key="eval/trajectory", step=0)
        client.set_terminated(run, status)
    columns = {"policy": names, **shown}
    client.log_table(parent, columns, TABLE)
    rows = zip(*(columns[heading] for heading in _NOTED), strict=True)
    note = f"{tables.table(_NOTED, list(rows))}\n\n{_TERMS}"
    client.set_tag(parent, NOTE_TAG, note[:_MAX_TAG])
    client.log_artifacts(parent, os.fspath(folder))
    # Once more as a picture by step, because only such appear among the charts.
    client.log_image(parent, read_rgb(folder / PLOT_FILE), key="eval/coverage_by_view", step=0)
    client.set_terminated(parent, status)
    return parent


def _params(values: Mapping[str, Any]) -> list[Param]:
    return [Param(safe_name(name), str(value)[:_MAX_PARAM]) for name, value in values.items()]


def _metrics(result: PolicyResult) -> list[Metric]:
    now = int(time.time() * 1000)
    figures = {"eval/episodes": float(len(result.seeds)), "eval/cpv": cpv(result)}
    for name, values in summary(result).items():
        figures |= {f"eval/{name}": values["mean"], f"eval/{name}_ci95": values["half_width"]}
    metrics = [Metric(safe_name(name), value, now, 0) for name, value in figures.items() if value is not None]
    for name, values in zip(("eval/curve", "eval/curve_ci95"), mean_and_half_width(result.curve), strict=True):
        known = [(view, float(value)) for view, value in enumerate(values, start=1) if np.isfinite(value)]
        metrics += [Metric(name, value, now, view) for view, value in known]
    return metrics
