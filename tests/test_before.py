"""What was written before the layout of the packages changed still opens (tests/data/before)."""

import lzma
import shutil
import sqlite3
import tarfile
from pathlib import Path

import pytest
from mlflow import MlflowClient

from avp_habitat import collect, command, seen
from avp_habitat.rollout.format import read_rollout
from avp_habitat.tracking import compare

DATA = Path(__file__).resolve().parent / "data" / "before"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with the rollouts, the models and the MLflow database."""
    folder = tmp_path_factory.mktemp("before")
    with tarfile.open(DATA / "rollouts.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    for model in DATA.glob("*.*"):
        shutil.copy(model, folder)
    with sqlite3.connect(folder / "mlflow.db") as database:
        database.executescript(lzma.decompress((DATA / "mlflow.sql.xz").read_bytes()).decode())
    return folder


def test_rollouts_open_and_their_visibility_is_what_it_was(place, capsys):
    metrics = read_rollout(place / "rollout").meta["metrics"]
    assert metrics["coverage"] == pytest.approx(0.17583807716635041)
    assert command.run(seen.main, [str(place / "rollout"), str(place / "rollout_model")]) == 0
    shown = [line for line in capsys.readouterr().out.splitlines() if "builtin:0" in line]
    assert ["31.7" in shown[0], "31.6" in shown[1]] == [True, True]


def test_a_model_acts_as_it_did(place):
    words = ("--scene", "builtin:0", "--budget", "3", "--width", "32", "--height", "24", "--mlflow", "off")
    assert command.run(collect.main, [*words, "--policy", str(place / "model.zip"), "--out", str(place / "again")]) == 0
    before, again = (read_rollout(place / name) for name in ("rollout_model", "again"))
    was, now = (rollout.meta["metrics"] for rollout in (before, again))
    both = was.keys() & now.keys()
    assert {name: now[name] for name in both} == pytest.approx({name: was[name] for name in both})
    assert {"coverage", "visibility", "views"} <= both
    for old, new in zip(before.frames, again.frames, strict=True):
        assert old.camera_to_world == pytest.approx(new.camera_to_world)


def test_a_model_with_statistics_acts_with_them(place, capsys):
    words = ("--scene", "builtin:0", "--budget", "3", "--width", "32", "--height", "24", "--mlflow", "off")
    model = place / "normalised_numbers.zip"
    assert command.run(collect.main, [*words, "--policy", str(model), "--out", str(place / "normalised")]) == 0
    assert "coverage 20.6 %" in capsys.readouterr().out


def test_runs_in_an_mlflow_store_are_compared(place, capsys):
    address = f"sqlite:///{place / 'mlflow.db'}"
    client = MlflowClient(address)
    runs = client.search_runs([client.get_experiment_by_name("avp").experiment_id])
    assert {run.data.tags["avp.kind"] for run in runs} >= {"training", "rollout"}
    assert command.run(compare.main, ["--mlflow", address]) == 0
    assert "heuristic" in capsys.readouterr().out
