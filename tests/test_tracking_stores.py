"""The store that runs go to: which experiment, and a database that is missing, broken or cannot be written."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import mlflow
import pytest
from mlflow import MlflowClient
from no_rights import without_root_rights
from sqlalchemy.engine import URL
from tracking import mlflow_home

from avp_habitat import command
from avp_habitat.tracking import compare
from avp_habitat.tracking.experiments import chosen_experiment, experiment_id
from avp_habitat.tracking.run import NewRun, start_run
from avp_habitat.tracking.stores import TrackingError, absolute, connect, file_of

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def store(tmp_path, monkeypatch):
    return MlflowClient(mlflow_home(tmp_path, monkeypatch))


def experiment_of(store, new):
    run = start_run(store.tracking_uri, new)
    run.close("FINISHED")
    return store.get_experiment(store.get_run(run.run_id).info.experiment_id).name


def test_runs_go_where_mlflows_variables_say(store, monkeypatch):
    assert experiment_of(store, NewRun()) == "avp"
    monkeypatch.setenv("MLFLOW_EXPERIMENT_NAME", "mine")
    assert experiment_of(store, NewRun()) == "mine"
    monkeypatch.setenv("MLFLOW_EXPERIMENT_ID", store.create_experiment("by id"))
    assert experiment_of(store, NewRun()) == "by id"
    assert experiment_of(store, NewRun(experiment="given")) == "given"


def test_what_mlflow_run_sets_when_nobody_chose_an_experiment_is_no_choice(store, monkeypatch):
    monkeypatch.setenv("MLFLOW_EXPERIMENT_ID", "0")
    assert experiment_of(store, NewRun()) == "avp"


def test_an_experiment_that_the_program_set_is_meant(store, monkeypatch):
    monkeypatch.setattr(mlflow.tracking.fluent, "_active_experiment_id", None)
    monkeypatch.setenv("MLFLOW_EXPERIMENT_ID", "")
    mlflow.set_experiment("set")
    assert experiment_of(store, NewRun()) == "set"


def test_a_run_begun_offline_goes_to_the_experiment_of_its_own_program(store, tmp_path, monkeypatch):
    monkeypatch.setenv("MLFLOW_EXPERIMENT_ID", store.create_experiment("then"))
    run = start_run("http://127.0.0.1:9", NewRun(), offline=True)
    assert not run.close("FINISHED", timeout_s=1)
    monkeypatch.setenv("MLFLOW_EXPERIMENT_ID", store.create_experiment("now"))
    sent = [sys.executable, "-m", "avp_habitat.tracking.deliver", "--mlflow", store.tracking_uri]
    subprocess.run(sent, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True, timeout=120)
    assert len(store.search_runs([store.get_experiment_by_name("then").experiment_id])) == 1


def test_an_id_that_the_store_does_not_have_is_named(store, monkeypatch):
    monkeypatch.setenv("MLFLOW_EXPERIMENT_ID", "77")
    with pytest.raises(TrackingError, match=r"MLFLOW_EXPERIMENT_ID=77: MLflow at sqlite:.* has no such experiment$"):
        experiment_of(store, NewRun())


@pytest.mark.parametrize("name", ["avp", "my own", "by id"])
def test_a_deleted_experiment_is_named_with_the_way_back(store, monkeypatch, capsys, name):
    identity = store.create_experiment(name)
    store.delete_experiment(identity)
    monkeypatch.setenv(*(("MLFLOW_EXPERIMENT_ID", identity) if name == "by id" else ("MLFLOW_EXPERIMENT_NAME", name)))
    told = rf"MLflow experiment '{name}' at sqlite:.* is deleted; .*restore --experiment-id {identity}"
    with pytest.raises(TrackingError, match=told):
        start_run(store.tracking_uri, NewRun())
    assert not list(Path("runs").rglob("*.jsonl"))
    assert command.run(compare.main, []) == 1
    assert f"restore --experiment-id {identity}" in capsys.readouterr().err
    store.restore_experiment(identity)
    assert experiment_id(store, *chosen_experiment(None)) == identity


CONNECT = """
from avp_habitat import command
from avp_habitat.tracking.stores import connect
command.run(lambda words: connect(words[0]))
"""


def looked_at(address, *before, **options):
    """What a command that logs to a store says of it in one line, and the seconds that it took to say so."""
    began = time.monotonic()
    words = [*before, sys.executable, "-c", CONNECT, address]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, env=env, capture_output=True, text=True, timeout=300, **options)
    (line,) = done.stderr.splitlines()
    return line, time.monotonic() - began


@pytest.mark.parametrize("kind", ["new database", "existing database", "folder below"])
def test_a_place_that_cannot_be_written_is_refused_at_once(store, tmp_path, kind):
    place = tmp_path / "closed"
    place.mkdir()
    if kind == "existing database":
        (tmp_path / "mlflow.db").rename(place / "mlflow.db")
        (place / "mlflow.db").chmod(0o444)
    place.chmod(0o555)
    address = f"sqlite:///{'deep/down/' if kind == 'folder below' else ''}mlflow.db"
    line, seconds = looked_at(address, *without_root_rights(), cwd=place)
    assert line.startswith(f"error: MLflow at {address} cannot be used: ")
    assert str(place) in line
    assert "Permission denied" in line
    assert seconds < 60  # MLflow itself tries for two minutes.


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda path: path.write_text("no database"), "it.db is no SQLite database"),
        (lambda path: path.mkdir(), "Is a directory: .*it.db"),
        (lambda path: path.parent.joinpath("file").write_text(""), "file/it.db: cannot write there: "),
    ],
)
def test_what_is_no_database_is_refused_at_once(tmp_path, make, problem):
    path = tmp_path / "it.db"
    make(path)
    address = f"sqlite:///{tmp_path / 'file' / 'it.db' if 'cannot write' in problem else path}"
    began = time.monotonic()
    with pytest.raises(TrackingError, match=rf"MLflow at {address} cannot be used: .*{problem}"):
        connect(address)
    assert time.monotonic() - began < 10


@pytest.mark.parametrize(
    ("address", "there"),
    [
        ("sqlite:///a.db", "sqlite:///{}/a.db"),
        ("sqlite:///a.db?timeout=9", "sqlite:///{}/a.db?timeout=9"),
        ("sqlite:////a.db", "sqlite:////a.db"),
        ("sqlite:///:memory:", "sqlite:///:memory:"),
        ("http://host:5000", "http://host:5000"),
    ],
)
def test_an_address_means_the_same_in_every_folder(tmp_path, monkeypatch, address, there):
    monkeypatch.chdir(tmp_path)
    assert absolute(address) == there.format(tmp_path)


def making(folder):
    code = f"from avp_habitat.tracking.stores import connect; connect('sqlite:///{folder}/new/mlflow.db')"
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen([sys.executable, "-c", code], env=env, stderr=subprocess.DEVNULL)


def test_a_program_killed_while_it_makes_a_database_leaves_none(tmp_path):
    folder = tmp_path / "new"
    child = making(tmp_path)
    while not (folder.is_dir() and any(path.stat().st_size > 20_000 for path in folder.glob(".*.partial-*.db"))):
        assert child.poll() is None
        time.sleep(0.005)
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert not (folder / "mlflow.db").exists()
    connect(f"sqlite:///{folder}/mlflow.db").create_experiment("works")


def test_programs_that_start_at_once_make_one_database(tmp_path):
    children = [making(tmp_path) for _ in range(3)]
    assert [child.wait(timeout=300) for child in children] == [0, 0, 0]
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["mlflow.db"]


@pytest.mark.parametrize("folder", ["my runs", "100% ü", "a%20b", "q?x#y"])
def test_a_database_is_made_where_mlflow_looks_for_it_whatever_its_path_holds(tmp_path, folder):
    """SQLAlchemy reads `%20` in an address as a space."""
    path = tmp_path / folder / "mlflow.db"
    address = URL.create("sqlite", database=str(path)).render_as_string()
    assert file_of(address) == path
    assert absolute(address) == address
    made = connect(address).create_experiment("é")
    assert [each.name for each in (tmp_path / folder).iterdir()] == ["mlflow.db"]
    assert MlflowClient(address).get_experiment(made).name == "é"
