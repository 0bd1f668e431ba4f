"""Make the pictures of MLflow's page in the docs: real runs by the suite's commands, looked at with a browser."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from mlflow_page import chromium, mlflow_server, opened
from PIL import Image
from tyro.conf import UseAppendAction

from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.tracking.stores import connect, shown
from avp_habitat.tracking.view import EVALUATIONS, MODEL_TRAINING, TRAININGS, path_of

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from playwright.sync_api import Page

POLICIES = ("heuristic", "spin", "survey")
LARGEST_BYTES = 200_000
_SETTLE_S = 3.0
_FIGURES = "metrics.`eval/psnr` > -1000"


@dataclass(frozen=True)
class Pictures:
    """Make the pictures of MLflow's page in the docs: real runs by the suite's commands, looked at with a browser."""

    scene: str = "builtin:0"
    """Of the rollouts and of the evaluation."""
    policy: UseAppendAction[tuple[str, ...]] = ()
    """Give it again; heuristic, spin and survey where none is given."""
    views: int = 40
    """Of each rollout."""
    rollouts: int = 1
    """Of each policy, from seed 1 on."""
    iterations: int = 400
    """Of each reconstruction."""
    steps: int = 60_000
    """Of each of the two trainings."""
    work: Path = Path("runs/mlflow-pictures")
    """What is there is not made again."""
    mlflow: str | None = None
    """Make no runs, but look at those of the store at this address."""
    experiment: str = "avp"
    """That is looked at with --mlflow."""
    out: Path = Path("docs/pictures")
    """Folder of the pictures."""


def main(options: Pictures) -> None:
    """Make the runs unless they are there, then the pictures."""
    options.work.mkdir(parents=True, exist_ok=True)
    store, experiment = options.mlflow, options.experiment
    if store is None:
        store, experiment = f"sqlite:///{options.work.absolute()}/mlflow.db", "avp"
        _make_runs(options, store)
    options.out.mkdir(parents=True, exist_ok=True)
    _photograph(store, experiment, options.out, options.work / "server")


def _make_runs(options: Pictures, store: str) -> None:
    policies = options.policy or POLICIES
    for policy in policies:
        for seed in range(1, options.rollouts + 1):
            _reconstruct(options, policy, seed, store)
    words = [word for policy in policies for word in ("--policy", policy)]
    where = ["--scene", options.scene, "--episodes", "6", "--out", options.work / "report"]
    _once(options.work / "report", store, "-m", "avp_sb3.evaluate", *words, *where)
    for observation in ("numbers", "map"):
        model = options.work / f"{observation}.zip"
        words = ["--observation", observation, "--run-name", observation, "--steps", options.steps]
        _once(model, store, "-m", "avp_sb3.train", *words, "--out", model)
    _run(store, "-m", "avp_habitat.tracking.compare")


def _reconstruct(options: Pictures, policy: str, seed: int, store: str) -> None:
    name = f"{Path(policy).stem}-{seed}"
    rollout, trained = options.work / name, options.work / "nerf" / name / "avp-nerfacto" / "t"
    words = ["--policy", policy, "--seed", seed, "--scene", options.scene, "--budget", options.views]
    _once(rollout, store, "-m", "avp_habitat.collect", *words, "--width", 320, "--height", 240, "--out", rollout)
    words = ["--data", rollout, "--output-dir", options.work / "nerf", "--experiment-name", name, "--timestamp", "t"]
    more = ["--max-num-iterations", options.iterations, "--mlflow", "off", "--vis", "tensorboard"]
    _once(trained, store, "-m", "nerfstudio.scripts.train", "avp-nerfacto", *words, *more)
    _once(trained / "heldout", store, "-m", "avp_nerfstudio.log", trained, "--pictures", 4)


def _once(result: Path, store: str, *words: object) -> None:
    if not result.exists():
        _run(store, *words)


def _run(store: str, *words: object) -> None:
    """Run Python with these words; what it prints is shown."""
    line = [sys.executable, *map(str, words)]
    environment = {**os.environ, "MLFLOW_TRACKING_URI": store, "MLFLOW_DISABLE_TELEMETRY": "true"}
    if code := subprocess.run(line, env=environment, check=False).returncode:
        raise AVPError(f"exit code {code} of: {' '.join(line)}")


def _photograph(store: str, experiment: str, out: Path, folder: Path) -> None:
    client = connect(store)
    found = client.get_experiment_by_name(experiment)
    if found is None:
        raise UsageError(f"--experiment {experiment}: not in {shown(store)}")
    identity = found.experiment_id
    runs = client.search_runs([identity], _FIGURES, order_by=["metrics.`eval/psnr` DESC"])
    best: dict[str, str] = {}
    for run in runs:
        best.setdefault(run.data.tags.get("avp.policy", ""), run.info.run_id)
    pages = {
        "runs": (path_of(identity), ".ag-row", 620),
        "charts": (path_of(identity, charts=True), ".js-plotly-plot .point", 900),
        "compare": (_compare_path(identity, list(best.values())[:4]), ".ReactVirtualized__Grid", 700),
        "evaluation": (path_of(identity, EVALUATIONS, charts=True), ".js-plotly-plot .lines", 900),
        "training": (path_of(identity, TRAININGS, charts=True), ".js-plotly-plot .lines", 900),
    }
    pages |= _comparison(client, identity)
    with mlflow_server(store, folder) as address, chromium() as browser:
        for name, (path, sign, height) in pages.items():
            with opened(browser, address, path, size=(1400, height)) as page:
                page.wait_for_selector(sign)
                _reveal(page, name)
                # Charts are drawn and pictures fetched one after the other, and nothing tells the last.
                time.sleep(_SETTLE_S)
                shot = folder / f"{name}.png"
                page.screenshot(path=shot)
            print(_jpeg(shot, out / f"mlflow-{name}.jpg"))


def _reveal(page: "Page", name: str) -> None:
    """Bring to sight what a page shows only when it is asked."""
    if name == "compare":
        # Far below are a grid of values and one of their names, which is always one turn of the wheel late.
        values = page.locator(".ReactVirtualized__Grid").last
        values.scroll_into_view_if_needed()
        values.hover()
        for turn in (10_000, -1, -1):
            page.mouse.wheel(0, turn)
            page.wait_for_timeout(1000)
    if name == "comparison":
        page.get_by_text("Show more", exact=True).first.click()


def _compare_path(experiment: str, runs: Sequence[str]) -> str:
    chosen, where = (quote(json.dumps(list(ids))) for ids in (runs, [experiment]))
    return f"#/compare-runs?runs={chosen}&experiments={where}&{MODEL_TRAINING}"


def _comparison(client: "MlflowClient", experiment: str) -> dict[str, tuple[str, str, int]]:
    found = client.search_runs([experiment], "tags.`avp.kind` = 'comparison'", max_results=1)
    return (
        {"comparison": (f"#/experiments/{experiment}/runs/{found[0].info.run_id}?{MODEL_TRAINING}", "table", 600)}
        if found
        else {}
    )


def _jpeg(source: Path, target: Path) -> Path:
    """The picture at the best quality that is small enough."""
    with Image.open(source) as picture:
        for quality in (90, 80, 70, 60, 50):
            picture.convert("RGB").save(target, quality=quality, optimize=True)
            if target.stat().st_size <= LARGEST_BYTES:
                break
    return target


if __name__ == "__main__":
    sys.exit(command.run(main))
