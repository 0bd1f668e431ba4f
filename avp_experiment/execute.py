"""One cell's command in a process of its own, forked from one that has imported everything already.

Importing torch, nerfstudio and Stable-Baselines3 takes 10 to 20 seconds of a core, which hundreds of cells would pay.
multiprocessing's forkserver pays it once; the commands still run apart from each other, each with a log file.
"""

import csv
import importlib
import json
import multiprocessing
import os
import runpy
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from avp_experiment.cells import COLLECT, TRAIN, Cell
from avp_experiment.store import Store
from avp_habitat import command
from avp_habitat.errors import AVPError
from avp_habitat.provenance import git_commit
from avp_habitat.rollout.format import Rollout, read_rollout
from avp_habitat.rollout.seen import visibility_of

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


NO_FACTS = 3
"""Exit code of a cell whose command succeeded, but whose result cannot be read."""
_MLFLOW_OURS = ("MLFLOW_RUN_ID", "MLFLOW_EXPERIMENT_ID", "MLFLOW_EXPERIMENT_NAME")


@dataclass(frozen=True)
class Order:
    """What a process is to do."""

    cell: Cell
    words: tuple[str, ...]
    """The command line: `python -m MODULE …` or `python FILE …`."""
    root: Path
    """The experiment's folder."""
    environment: dict[str, str]
    """Variables."""


def environment(tracking_uri: str) -> dict[str, str]:
    """Variables of the cells: this process's, one thread each, and not MLflow's run, which is the experiment's own."""
    kept = {name: value for name, value in os.environ.items() if name not in _MLFLOW_OURS}
    return kept | {"OMP_NUM_THREADS": "1", "MLFLOW_TRACKING_URI": tracking_uri, "PYTHONWARNINGS": "ignore"}


def execute(order: Order) -> None:
    """Run a cell's command in this process, note what came of it, and end the process with the command's exit code."""
    threading.Thread(target=_end_with_experiment, name="end with the experiment", daemon=True).start()
    os.environ.clear()
    os.environ.update(order.environment)
    store = Store(order.root)
    with store.log(order.cell).open("a", encoding="utf-8") as log:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
        started = time.monotonic()
        print(f"$ {order.cell.command}", flush=True)
        code = _run(order.words)
        if code == 0:
            code = _finish(store, order.cell, time.monotonic() - started)
        sys.stdout.flush()
        sys.stderr.flush()
    sys.exit(code)


def _finish(store: Store, cell: Cell, seconds: float) -> int:
    try:
        facts = facts_of(cell, store.root)
    except (AVPError, OSError, ValueError, KeyError) as error:
        print(f"error: {error}", file=sys.stderr)
        return NO_FACTS
    finished = datetime.now(UTC).isoformat(timespec="seconds")
    store.finish(cell, {"seconds": round(seconds, 1), "commit": git_commit(), "finished": finished, "facts": facts})
    return 0


def _run(words: Sequence[str]) -> int:
    """The exit code of a command line; its program runs in this process."""
    try:
        sys.argv, main = list(words[1:]), _main_of(words)
        return command.run(main, _arguments(words))
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1


def _main_of(words: Sequence[str]) -> Callable[[Sequence[str]], None]:
    if words[1] == "-m":
        name = words[2]
        return importlib.import_module(name).main
    sys.path.insert(0, str(Path(words[1]).parent))
    return runpy.run_path(words[1])["main"]


def _arguments(words: Sequence[str]) -> list[str]:
    return list(words[3:] if words[1] == "-m" else words[2:])


def _end_with_experiment() -> None:
    """End this process when the experiment ends, also by SIGKILL, or two programs would write one cell.

    The process that forked this one lives on as long as its children do, so that waiting for that one is no help.
    """
    experiment = multiprocessing.parent_process()
    assert experiment is not None
    experiment.join()
    os.kill(os.getpid(), signal.SIGKILL)


def last_words(log: Path, lines: int = 3) -> str:
    """The last lines of a log that say something, as one."""
    try:
        text = log.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return "no log"
    said = [line.strip() for line in text.replace("\r", "\n").splitlines() if line.strip()]
    errors = [line for line in said if line.startswith("error: ")]
    return errors[-1].removeprefix("error: ") if errors else " | ".join(said[-lines:])[-400:]
