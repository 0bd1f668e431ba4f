import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mlflow import MlflowClient
from tracking import mlflow_home

from avp_habitat import command
from avp_habitat.errors import UsageError
from avp_habitat.tracking.deliver import Deliver, main, recover
from avp_habitat.tracking.experiments import find_run
from avp_habitat.tracking.journal import Journal, spool_folder
from avp_habitat.tracking.names import PARENT_TAG
from avp_habitat.tracking.run import NewRun, continue_run, start_run
from avp_habitat.tracking.stores import TrackingError, address_of, shown

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def address(tmp_path, monkeypatch):
    return mlflow_home(tmp_path, monkeypatch)


def deliver(*words):
    main(command.parse(Deliver, words))


def python(code, **options):
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), str(ROOT)])}
    return subprocess.Popen([sys.executable, "-c", code], env=env, stdout=subprocess.PIPE, text=True, **options)


def points(address, run_id, name):
    return [(p.step, p.value) for p in MlflowClient(address).get_metric_history(run_id, name)]


KILLED = """
import os, signal
from avp_habitat.tracking.run import NewRun, start_run
run = start_run("sqlite:///mlflow.db", NewRun(), interval_s=1000)
for step in range(50):
    run.metrics({"a": step / 2}, step)
    if step == 20:
        assert run.flush()
run.save("note.txt", lambda file: file.write_text("kept"))
print(run.run_id, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(scope="module")
def killed_home(tmp_path_factory):
    """The folder that a killed program leaves, and its run."""
    folder = tmp_path_factory.mktemp("killed")
    with pytest.MonkeyPatch.context() as patch:
        mlflow_home(folder, patch)
        process = python(KILLED)
        run_id = process.communicate()[0].split()[0]
    assert process.returncode == -signal.SIGKILL
    return folder, run_id


@pytest.fixture
def killed(address, killed_home, tmp_path):
    """A run whose process was killed when MLflow had 21 of its 50 points."""
    folder, run_id = killed_home
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    for header in tmp_path.glob("runs/mlflow-spool/*/run.json"):
        header.write_text(header.read_text().replace(str(folder), str(tmp_path)))
    assert len(points(address, run_id, "a")) == 21
    return run_id


def test_a_killed_run_is_completed_and_closed_at_the_next_start(address, killed, tmp_path):
    assert list(recover()) == [f"run {killed} at {address}: sent (KILLED, its program was killed)"]
    client = MlflowClient(address)
    run = client.get_run(killed)
    assert run.info.status == "KILLED"
    # It ended when its process was last heard of, not when somebody noticed.
    assert run.info.end_time <= time.time() * 1000
    assert points(address, killed, "a") == [(step, step / 2) for step in range(50)]
    assert Path(client.download_artifacts(killed, "note.txt", str(tmp_path))).read_text() == "kept"
    assert not spool_folder().exists()


def test_a_killed_run_goes_on_with_all_it_had_to_say(address, killed):
    run = continue_run(address, killed)
    assert run.run_id == killed
    assert MlflowClient(address).get_run(killed).info.status == "RUNNING"
    run.metrics({"a": 100.0}, 50)
    assert run.close("FINISHED")
    assert points(address, killed, "a") == [*((step, step / 2) for step in range(50)), (50, 100.0)]
    assert MlflowClient(address).get_run(killed).info.status == "FINISHED"


def test_points_that_arrived_before_the_kill_are_not_doubled(address, tmp_path, monkeypatch):
    """The process is killed between MLflow's answer and its own note of it, in a store that takes a point twice."""
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    folder = (tmp_path / "kept").as_uri()
    first = start_run(folder, NewRun())
    for step in range(20):
        first.metrics({"a": step}, step)
    assert first.flush()
    (sent,) = spool_folder().glob("*/sent")
    sent.write_text(f"{0:020d}\n")
    first._sender.stop()
    first._journal.release()
    list(recover())
    assert points(folder, first.run_id, "a") == [(step, step) for step in range(20)]


def test_the_command_sends_what_waits_and_says_so(address, killed, capsys):
    deliver("--list")
    assert killed in capsys.readouterr().out
    deliver()
    assert f"run {killed} at {address}: sent (KILLED, its program was killed)" in capsys.readouterr().out
    assert len(points(address, killed, "a")) == 50
    deliver()
    assert "nothing waits" in capsys.readouterr().out
    with pytest.raises(UsageError, match="--spool nowhere: no such folder"):
        deliver("--spool", "nowhere")


def test_the_command_keeps_what_it_cannot_send(address, killed, tmp_path, capsys):
    (tmp_path / "mlflow.db").rename(tmp_path / "away.db")
    with pytest.raises(TrackingError, match=r"1 of 1 runs could not be sent; they stay in .*mlflow-spool"):
        deliver()
    assert not (tmp_path / "mlflow.db").exists()
    (tmp_path / "away.db").rename(tmp_path / "mlflow.db")
    deliver()
    assert len(points(address, killed, "a")) == 50


def test_a_run_that_was_deleted_can_be_restored_and_gets_its_points(address, killed, capsys, caplog):
    client = MlflowClient(address)
    client.delete_run(killed)
    with pytest.raises(TrackingError, match="1 of 1 runs could not be sent"):
        deliver()
    client.restore_run(killed)
    deliver()
    assert len(points(address, killed, "a")) == 50
    assert client.get_run(killed).info.status == "KILLED"


def test_a_live_run_is_left_to_its_own_program(address, capsys):
    run = start_run(address, NewRun())
    deliver()
    assert "1 of 1 belong to programs that still run" in capsys.readouterr().out
    list(recover())
    assert MlflowClient(address).get_run(run.run_id).info.status == "RUNNING"
    with pytest.raises(TrackingError, match="another program is writing it"):
        continue_run(address, run.run_id)
    assert run.close("FINISHED")


WRITER = """
import sys
from avp_habitat.tracking.run import NewRun, start_run
run = start_run("sqlite:///new.db", NewRun("shared"), interval_s=0.01)
for step in range(300):
    run.metrics({"a": step, "b": -step}, step)
assert run.close("FINISHED")
print(run.run_id)
"""


@pytest.mark.slow
def test_programs_that_make_one_database_at_once_do_not_break_each_other(address, tmp_path):
    writers = [python(WRITER) for _ in range(3)]
    runs = [process.communicate()[0].split()[-1] for process in writers]
    assert [process.returncode for process in writers] == [0, 0, 0]
    client = MlflowClient(f"sqlite:///{tmp_path}/new.db")
    assert {client.get_experiment(client.get_run(run).info.experiment_id).name for run in runs} == {"shared"}
    for run in runs:
        for name in "ab":
            assert sorted(p.step for p in client.get_metric_history(run, name)) == list(range(300))


def test_what_mlflow_refuses_is_told_and_holds_up_nothing_else(address, monkeypatch, caplog):
    """As a server does whose limits are lower than ours."""
    run = start_run(address, NewRun(), interval_s=0.01)
    assert run.flush()
    monkeypatch.setenv("MLFLOW_TRUNCATE_LONG_VALUES", "false")
    monkeypatch.setattr("mlflow.utils.validation.MAX_PARAM_VAL_LENGTH", 10)
    run.params({"a": "short", "b": "x" * 20, "c": "short"})
    run.metrics({"d": 1.0}, 1)
    assert run.close("FINISHED")
    found = MlflowClient(address).get_run(run.run_id)
    assert (found.data.params, found.data.metrics) == ({"a": "short", "c": "short"}, {"d": 1.0})
    assert found.info.status == "FINISHED"
    assert [record.message for record in caplog.records if f"run {run.run_id} refuses params 'b': " in record.message]


def test_a_locked_database_delays_points_and_loses_none(address, tmp_path):
    import sqlite3

    run = start_run(address, NewRun(), interval_s=0.01)
    other = sqlite3.connect(tmp_path / "mlflow.db", isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    for step in range(10):
        run.metrics({"a": step}, step)
    time.sleep(0.3)
    other.execute("ROLLBACK")
    assert run.close("FINISHED")
    assert points(address, run.run_id, "a") == [(step, step) for step in range(10)]


def test_an_offline_run_below_another_finds_its_place(address):
    parent = start_run(address, NewRun("e", "parent"), offline=True)
    child = start_run(address, NewRun("e", "child", parent=parent.run_id))
    assert parent.close("FINISHED")
    assert child.close("FINISHED")
    client = MlflowClient(address)
    assert client.get_run(child.run_id).data.tags[PARENT_TAG] == parent.run_id


def test_a_run_made_offline_is_made_once_whoever_asks(address):
    gone = f"http://127.0.0.1:{1}"
    run = start_run(gone, NewRun("later", "mine"), offline=True)
    run.metrics({"a": 1.0}, 1)
    offline_id = run.run_id
    assert not run.close("FINISHED")
    assert find_run(MlflowClient(address), offline_id) is None
    deliver("--mlflow", address)
    found = find_run(MlflowClient(address), offline_id)
    assert (found.info.run_name, found.info.status) == ("mine", "FINISHED")
    assert found.data.metrics == {"a": 1.0}
    assert continue_run(address, offline_id).run_id == found.info.run_id


def test_addresses_are_shown_without_passwords():
    assert shown("https://me:secret@host:1/x") == "https://host:1/x"
    assert address_of("off", default="sqlite:///a.db") is None
    assert Journal.peek(Path("nowhere")) is None


FULL = """
import resource, signal
from pathlib import Path
from avp_habitat.tracking.run import NewRun, start_run
run = start_run("sqlite:///mlflow.db", NewRun(), interval_s=0.01)
assert run.flush()
soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
# No file may grow beyond the database as it is: a full disk for the database, and soon for the journal.
resource.setrlimit(resource.RLIMIT_FSIZE, (Path("mlflow.db").stat().st_size, hard))
for step in range(4000):
    run.metrics({f"metric/{i}": step + i for i in range(10)}, step)
print(run.run_id, flush=True)
assert not run.flush(60.0)
resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
assert run.close("FINISHED")
"""


def test_a_full_disk_is_said_in_a_line_and_everything_arrives_when_it_takes_something_again(address):
    process = python(FULL, stderr=subprocess.PIPE)
    said, complaints = process.communicate(timeout=300)
    assert process.returncode == 0, complaints
    assert complaints.count("does not take the run's points now (") == 1
    assert "Traceback" not in complaints
    run_id = said.split()[0]
    for i in (0, 9):
        assert points(address, run_id, f"metric/{i}") == [(step, step + i) for step in range(4000)]
