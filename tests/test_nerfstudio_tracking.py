"""Reconstructions whose MLflow server or whose program goes away."""

import json
import os
import signal
import sqlite3
import time
from collections import Counter

import pytest
from nerfstudio_room import write_room
from tracking import mlflow_home
from tracking_server import Server, free_port

pytest.importorskip("nerfstudio")

from mlflow import MlflowClient
from nerfstudio_shell import Shell
from nerfstudio_training import tiny_config, train

from avp_habitat import command
from avp_habitat.tracking import deliver
from avp_habitat.tracking.journal import spool_folder
from avp_nerfstudio.data.refusals import CommandError
from avp_nerfstudio.method.trainer import AVPTrainer
from avp_nerfstudio.tracking import Facts, open_again, open_run, remembered_id

TINY = ["--pipeline.datamanager.train-num-rays-per-batch", 64, "--pipeline.model.log2-hashmap-size", 8]
OFTEN = ["--logging.steps-per-log", 5, "--logging.local-writer.enable", "False", "--steps-per-save", 20]


@pytest.fixture
def room(tmp_path):
    return write_room(tmp_path / "room")


@pytest.fixture
def store(tmp_path, monkeypatch):
    return MlflowClient(mlflow_home(tmp_path, monkeypatch))


def only_run(client):
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    (run,) = client.search_runs(experiments, "tags.avp.kind = 'reconstruction'")
    return run


def steps(client, run_id, name="Train Loss"):
    return [metric.step for metric in client.get_metric_history(run_id, name)]


def killed(run):
    """What SIGKILL leaves of an open run: a journal that nobody holds."""
    run._sender.stop()
    run._journal.release()


def facts(**tags):
    return Facts("r", {"a": "1"}, {"avp.kind": "reconstruction", **tags}, {"eval/coverage": 0.5})


def test_a_training_goes_on_without_its_server_when_told_to_and_everything_is_sent_later(
    tmp_path, room, store, monkeypatch, capsys
):
    address = f"http://127.0.0.1:{free_port()}"
    config = tiny_config(room, tmp_path / "out", mlflow=address)
    with pytest.raises(CommandError, match=f"MLflow at {address} cannot be used.* AVP_MLFLOW_OFFLINE=1$"):
        train(config)
    assert not list((tmp_path / "out").rglob("*.ckpt"))
    monkeypatch.setenv("AVP_MLFLOW_OFFLINE", "1")
    folder = train(config).parent
    offline = remembered_id(folder)
    assert offline.startswith("offline-")
    assert f"MLflow:   run {offline}\nsend:     python -m avp_habitat.tracking.deliver" in capsys.readouterr().out
    assert command.run(deliver.main, ["--mlflow", store.tracking_uri]) == 0
    run = only_run(store)
    assert run.info.status == "FINISHED"
    assert run.data.tags["avp.key"] == offline.removeprefix("offline-")
    assert steps(store, run.info.run_id) == [0, 5, 10]
    assert {file.path for file in store.list_artifacts(run.info.run_id)} == {"config.yml", "dataparser_transforms.json"}
    # The scores of that training find the run by the id that was given offline.
    scored, had_one = open_again(store.tracking_uri, facts(), folder=folder)
    scored.metrics({"eval/psnr": 20.0}, 11)
    assert scored.close("FINISHED")
    assert had_one
    assert only_run(store).data.metrics["eval/psnr"] == 20.0


@pytest.mark.parametrize("status", ["KILLED", "FAILED", "FINISHED"])
def test_logging_again_leaves_status_and_settings_as_they_are(tmp_path, store, status):
    first = open_run(store.tracking_uri, facts(), folder=tmp_path)
    first.close(status)
    again, had_one = open_again(store.tracking_uri, Facts("other", {"a": "2"}), folder=tmp_path)
    again.metrics({"eval/psnr": 20.0}, 3)
    assert again.close("FINISHED")
    run = store.get_run(first.run_id)
    assert (had_one, again.run_id) == (True, first.run_id)
    assert (run.info.status, run.info.run_name, run.data.params) == (status, "r", {"a": "1"})
    assert run.data.metrics == {"eval/coverage": 0.5, "eval/psnr": 20.0}
    assert "avp.changed_params" not in run.data.tags


def test_logging_a_training_that_was_killed_sends_what_it_could_not_and_closes_it(tmp_path, store):
    first = open_run(store.tracking_uri, facts(), folder=tmp_path)
    first.metrics({"Train Loss": 0.25}, 5)
    killed(first)
    assert store.get_run(first.run_id).info.status == "RUNNING"
    again, _ = open_again(store.tracking_uri, facts(), folder=tmp_path)
    assert again.close("FINISHED")
    run = store.get_run(first.run_id)
    assert run.info.status == "KILLED"
    assert run.data.metrics["Train Loss"] == 0.25
    assert len(store.get_metric_history(run.info.run_id, "eval/coverage")) == 1
    assert not list(spool_folder().glob("*"))


def test_a_training_that_goes_on_after_sigkill_goes_on_in_its_run(tmp_path, store):
    first = open_run(store.tracking_uri, facts(), folder=tmp_path)
    first.metrics({"Train Loss": 0.25}, 5)
    killed(first)
    resumed = open_run(store.tracking_uri, facts(), folder=tmp_path, earlier=remembered_id(tmp_path))
    resumed.metrics({"Train Loss": 0.125}, 10)
    assert resumed.close("FINISHED")
    assert resumed.run_id == first.run_id
    assert only_run(store).info.status == "FINISHED"
    assert steps(store, first.run_id) == [5, 10]
    assert steps(store, first.run_id, "eval/coverage") == [0]


def test_scores_of_an_offline_training_join_its_journal_while_the_server_is_away(tmp_path, store, monkeypatch):
    address = f"http://127.0.0.1:{free_port()}"
    monkeypatch.setenv("AVP_MLFLOW_OFFLINE", "1")
    first = open_run(address, facts(), folder=tmp_path)
    assert not first.close("FINISHED", timeout_s=0.1)
    again, had_one = open_again(address, facts(), folder=tmp_path)
    again.metrics({"eval/psnr": 20.0}, 3)
    assert not again.close("FINISHED", timeout_s=0.1)
    assert (had_one, again.run_id) == (True, first.run_id)
    assert command.run(deliver.main, ["--mlflow", store.tracking_uri]) == 0
    assert only_run(store).data.metrics == {"eval/coverage": 0.5, "eval/psnr": 20.0}


@pytest.mark.slow  # a real server takes its time
def test_a_server_that_is_killed_while_a_training_runs_gets_every_point_once(tmp_path, room, store, monkeypatch):
    server = Server(tmp_path).start()
    iterate = AVPTrainer.train_iteration

    def without_server(self, at):
        if at == 20:
            server.kill()
        return iterate(self, at)

    monkeypatch.setattr(AVPTrainer, "train_iteration", without_server)
    try:
        config = train(tiny_config(room, tmp_path / "out", mlflow=server.address, iterations=50))
        assert list((config.parent / "nerfstudio_models").iterdir())
        assert list(spool_folder().glob("*/journal.jsonl"))
        server.start()
        assert command.run(deliver.main, []) == 0
        client = MlflowClient(server.address)
        run = only_run(client)
        assert run.info.run_id == remembered_id(config.parent)
        assert run.info.status == "FINISHED"
        assert steps(client, run.info.run_id) == list(range(0, 50, 5))
        assert {file.path for file in client.list_artifacts(run.info.run_id)} >= {"config.yml"}
        with sqlite3.connect(tmp_path / "server.db") as database:
            rows = database.execute("SELECT key, step FROM metrics WHERE run_uuid = ?", [run.info.run_id]).fetchall()
        assert set(Counter(rows).values()) == {1}
        assert not list(spool_folder().glob("*"))
    finally:
        server.kill()


@pytest.mark.slow  # imports nerfstudio in another process
def test_ns_train_killed_with_sigkill_goes_on_in_its_run_and_says_what_is_not_sent(tmp_path, room, store):
    address, out = store.tracking_uri, tmp_path / "out"
    words = ["avp-nerfacto", "--data", room, "--output-dir", out, "--experiment-name", "e", *TINY, *OFTEN]
    with Shell() as shell:
        long = [*words, "--timestamp", "t", "--max-num-iterations", 100_000, "--mlflow", address]
        process = shell.start("ns-train", *long)
        checkpoints = out / "e/avp-nerfacto/t/nerfstudio_models"
        until = time.monotonic() + 300
        while len(list(checkpoints.glob("*.ckpt"))) < 1 or not steps(store, only_run(store).info.run_id):
            assert time.monotonic() < until
            time.sleep(0.1)
        os.kill(process, signal.SIGKILL)
        assert shell.wait(process).returncode == -signal.SIGKILL
        left = only_run(store)
        assert left.info.status == "RUNNING"
        newest = max(int(path.stem.removeprefix("step-")) for path in checkpoints.glob("*.ckpt"))
        on = ["--timestamp", "again", "--max-num-iterations", 20, "--load-dir", checkpoints, "--mlflow", address]
        done = shell.run("ns-train", *words, *on)
        assert done.returncode == 0, done.stdout + done.stderr
        assert f"MLflow:   run {left.info.run_id}\ncompare:  mlflow ui --backend-store-uri {address}" in done.stdout
        run = only_run(store)
        assert (run.info.run_id, run.info.status) == (left.info.run_id, "FINISHED")
        assert "max_num_iterations" in json.loads(run.data.tags["avp.changed_params"])
        # Between the checkpoint and its end the first training came further than what the second one goes on from.
        assert set(range(0, newest + 21, 5)) <= set(steps(store, run.info.run_id))
        gone = [
            *words,
            "--timestamp",
            "gone",
            "--max-num-iterations",
            10,
            "--mlflow",
            f"http://127.0.0.1:{free_port()}",
        ]
        done = shell.run("ns-train", *gone, environment={"AVP_MLFLOW_OFFLINE": "1"})
        assert done.returncode == 0, done.stdout + done.stderr
        assert "send:     python -m avp_habitat.tracking.deliver" in done.stdout
        assert "did not take all of run offline-" in done.stderr
