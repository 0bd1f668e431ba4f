"""The whole experiment with few methods: real trainings, rollouts, reconstructions, figures and MLflow."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from mlflow import MlflowClient

ROOT = Path(__file__).resolve().parent.parent
PRESET = ("-P", "preset=smoke", "-P", "methods=heuristic,proposed", "-P", "unseen=none")
FIGURES = ("figure3", "figure4", "figure5", "figure6", "psnr_by_views", "visibility")

pytestmark = pytest.mark.slow


def program(name):
    return str(Path(sys.executable).with_name(name))


def run(folder, *words):
    env = {**os.environ, "OMP_NUM_THREADS": "1", "MLFLOW_TRACKING_URI": f"sqlite:///{folder}/mlflow.db"}
    env["PATH"] = f"{Path(sys.executable).parent}:{env['PATH']}"
    return subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True, timeout=900)


def compare(folder):
    words = (program("mlflow"), "run", ".", "-e", "compare", "--env-manager", "local", *PRESET)
    return run(folder, *words, "-P", f"out={folder}/e")


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    folder = tmp_path_factory.mktemp("experiment")
    answer = compare(folder)
    assert answer.returncode == 0, answer.stderr[-3000:]
    return folder


def cells(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.glob("e/cells/*/*/cell.json")}


def parent_runs(folder):
    client = MlflowClient(f"sqlite:///{folder}/mlflow.db")
    experiments = [one.experiment_id for one in client.search_experiments()]
    return client, client.search_runs(experiments, "tags.`avp.kind` = 'experiment'", order_by=["attributes.start_time"])


def test_it_writes_results_tables_figures_and_claims(done):
    results = json.loads((done / "e" / "results.json").read_text())
    assert results["methods"] == ["heuristic", "proposed"]
    assert results["failed"] == []
    assert results["origin"]["command"].startswith("mlflow run . -e compare --env-manager local -P unseen=none")
    whole = [one for one in results["reconstructions"] if one["whole"]]
    assert sorted(one["method"] for one in whole) == ["heuristic", "proposed"]
    assert all(5 < one["scores"]["psnr"] < 50 and len(one["per_view"]) == 20 for one in results["reconstructions"])
    assert all(0 < one["metrics"]["visibility"] < 1 for one in results["rollouts"])
    assert results["training"][0]["curves"]["rollout/ep_rew_mean"]
    for name in FIGURES:
        assert (done / "e" / f"{name}.png").stat().st_size > 5000, name
    page = (done / "e" / "results.md").read_text()
    assert "heuristic" in page
    assert "| proposed" in (done / "e" / "table2.md").read_text()


def test_one_parent_run_holds_it_all_with_the_trainings_below(done):
    client, parents = parent_runs(done)
    parent = parents[0]
    assert parent.data.metrics["failed_cells"] == 0
    results = json.loads((done / "e" / "results.json").read_text())
    psnr = {one["method"]: one["scores"]["psnr"] for one in results["reconstructions"] if one["whole"]}
    for method, value in psnr.items():
        assert parent.data.metrics[f"train/{method}/psnr"] == pytest.approx(value)
    artifacts = {item.path for item in client.list_artifacts(parent.info.run_id)}
    assert {"results.json", "results.md", "table2.csv", "figure6.png"} <= artifacts
    children = client.search_runs([parent.info.experiment_id], f"tags.`mlflow.parentRunId` = '{parent.info.run_id}'")
    kinds = sorted(child.data.tags["avp.kind"] for child in children)
    assert kinds == ["experiment-cell", "experiment-cell", "training"]
    found = {run.data.tags["avp.policy"]: run.data.metrics for run in children if "avp.policy" in run.data.tags}
    assert found["proposed"]["eval/psnr"] == pytest.approx(psnr["proposed"])


def test_every_table_and_figure_is_made_again_from_the_stored_results(done):
    folder = done / "e"
    before = {path.name: path.read_bytes() for path in folder.glob("*.[mc][ds]*") if path.suffix in (".md", ".csv")}
    for path in (*folder.glob("*.md"), *folder.glob("*.csv"), *folder.glob("*.png")):
        path.unlink()
    answer = run(done, sys.executable, "-m", "avp_experiment.report", str(folder))
    assert answer.returncode == 0, answer.stderr
    assert {name: (folder / name).read_bytes() for name in before} == before
    assert all((folder / f"{name}.png").is_file() for name in FIGURES)


def test_a_second_start_repeats_nothing_and_shows_the_trainings_below_its_own_run(done):
    before = cells(done)
    answer = compare(done)
    assert answer.returncode == 0, answer.stderr[-3000:]
    assert "0 of" in answer.stdout
    assert cells(done) == before
    client, parents = parent_runs(done)
    assert len(parents) == 2
    query = f"tags.`mlflow.parentRunId` = '{parents[1].info.run_id}' and tags.`avp.kind` = 'training'"
    assert len(client.search_runs([parents[1].info.experiment_id], query)) == 1
