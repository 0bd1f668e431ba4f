"""What the experiment keeps of a finished cell, read from what its command made."""

import csv
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from avp_habitat.errors import AVPError
from avp_habitat.rollout import Rollout, read_rollout
from avp_habitat.rollout_visibility import visibility_of
from experiment.cells import COLLECT, TRAIN, Cell

CURVES = ("avp/cpv", "avp/coverage", "avp/views", "rollout/ep_rew_mean")
"""Metrics of a training whose course is kept."""
POINTS = 400
"""At most so many points of each."""
SCORES = "scores.json"


def facts_of(cell: Cell, root: Path) -> dict[str, Any]:
    """What is kept of a cell whose command has succeeded.

    Raises:
        AVPError: what the command made cannot be used.
    """
    out = cell.output(root)
    if cell.kind == TRAIN:
        return _of_training(out)
    return _of_rollout(out) if cell.kind == COLLECT else _of_reconstruction(out)


def _of_training(model: Path) -> dict[str, Any]:
    """Steps, MLflow run, and the curves that the run holds."""
    from mlflow import MlflowClient
    from stable_baselines3 import PPO

    trained = PPO.load(model, device="cpu")
    run_id = getattr(trained, "avp_mlflow_run_id", None)
    curves = _curves(MlflowClient(os.environ["MLFLOW_TRACKING_URI"]), run_id) if run_id else {}
    return {"steps": trained.num_timesteps, "run_id": run_id, "curves": curves}


def _curves(client: Any, run_id: str) -> dict[str, list[list[float]]]:
    """`[step, value]` points by metric; empty where MLflow has not got the run yet."""
    from mlflow.exceptions import MlflowException

    curves = {}
    for metric in CURVES:
        try:
            found = {point.step: point.value for point in client.get_metric_history(run_id, metric)}
        except MlflowException:
            continue
        steps = sorted(found)
        keep = sorted({int(i) for i in np.linspace(0, len(steps) - 1, min(len(steps), POINTS))}) if steps else []
        curves[metric] = [[steps[i], round(found[steps[i]], 6)] for i in keep]
    return curves


def _of_rollout(folder: Path) -> dict[str, Any]:
    rollout = read_rollout(folder)
    seen = visibility_of(rollout.frames, rollout.heldout, rollout.intrinsics)
    return {
        "metrics": rollout.meta["metrics"] | seen.figures(),
        "coverage_curve": [round(float(row["coverage"]), 6) for row in _steps(rollout)],
        "visibility_curve": [round(float(share), 6) for share in seen.curve()],
    }


def _steps(rollout: Rollout) -> list[dict[str, str]]:
    with (rollout.folder / "steps.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _of_reconstruction(folder: Path) -> dict[str, Any]:
    try:
        found = json.loads((folder / SCORES).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise AVPError(f"{folder / SCORES}: expected the scores of a reconstruction: {error}") from None
    return found
