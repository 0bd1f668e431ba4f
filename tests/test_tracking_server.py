"""Trainings that log to a real server, which dies, and trainings that die themselves."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from mlflow import MlflowClient
from rrd import rows
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from tracking import mlflow_home, ppo
from tracking_server import Postgres, Server, postgres_programs

from avp_habitat.tracking.journal import spool_folder
from avp_sb3 import MetricsCallback, MLflowCallback

ROOT = Path(__file__).resolve().parent.parent


class Dumps(BaseCallback):
    """Everything that the logger dumped, counted without MLflow; slows the training down to last some seconds."""

    def __init__(self, pause_s, *meanwhile):
        super().__init__()
        self.pause_s, self.points, self.at, self.meanwhile = pause_s, [], [], meanwhile

    def _on_rollout_start(self):
        if len(self.at) == 8:
            for thread in self.meanwhile:
                thread.start()
        self.at.append(time.monotonic())
        time.sleep(self.pause_s)

    def _on_step(self):
        return True

    def _on_training_start(self):
        dumps, logger = self, self.logger
        plain = logger.dump

        def dump(step=0):
            dumps.points += [
                (name, step)
                for name, value in logger.name_to_value.items()
                if not isinstance(value, str) and "mlflow" not in (logger.name_to_excluded[name] or ())
            ]
            plain(step)

        logger.dump = dump


def stored(client, run_id):
    names = client.get_run(run_id).data.metrics
    return [(name, p.step) for name in names for p in client.get_metric_history(run_id, name)]


def train_through_a_crash(server):
    """A training of some 10 s, in the middle of which the server is killed and started again."""

    def crash():
        server.kill()
        server.start()

    crashing = threading.Thread(target=crash)
    dumps, callback = Dumps(0.25, crashing), MLflowCallback(tracking_uri=server.address, checkpoint_s=2.0)
    ppo().learn(64 * 60, callback=[MetricsCallback(), dumps, callback])
    crashing.join()
    return dumps, callback


def every_point_is_there_once(server, dumps, callback):
    client = MlflowClient(server.address)
    if spool_folder().exists():
        # The server took longer to start than the training to end.
        subprocess.run([sys.executable, "-m", "avp_habitat.tracking.deliver"], check=True, cwd=Path.cwd())
    found = stored(client, callback.run_id)
    last = [point for point in found if point[1] == 64 * 60]
    # The callback adds the last update's losses at the end, a second point at the same step.
    assert sorted(set(found)) == sorted(set(dumps.points))
    assert len(found) - len(dumps.points) == len(last) - sum(step == 64 * 60 for _, step in dumps.points)
    assert sorted(point for point in found if point[1] < 64 * 60) == sorted(
        point for point in dumps.points if point[1] < 64 * 60
    )
    run = client.get_run(callback.run_id)
    assert run.info.status == "FINISHED"
    assert not spool_folder().exists()
    # The training never stopped: no update waited for the server.
    assert max(np.diff(dumps.at)) < 5
    return client


@pytest.mark.slow
def test_a_server_that_is_killed_and_comes_back_has_every_point_once(tmp_path, monkeypatch):
    mlflow_home(tmp_path, monkeypatch)
    server = Server(tmp_path).start()
    try:
        client = every_point_is_there_once(server, *(pair := train_through_a_crash(server)))
        path = client.download_artifacts(pair[1].run_id, "model.zip", str(tmp_path))
        assert PPO.load(path, device="cpu").num_timesteps == 64 * 60
    finally:
        server.kill()


@pytest.mark.slow
@pytest.mark.postgres
@pytest.mark.skipif(postgres_programs() is None, reason="PostgreSQL's server programs are not installed")
def test_the_same_with_postgresql_behind_the_server(tmp_path, monkeypatch):
    mlflow_home(tmp_path, monkeypatch)
    (tmp_path / "pg").mkdir()
    postgres = Postgres(tmp_path / "pg").start()
    server = Server(tmp_path, postgres.address)
    try:
        server.start()
        every_point_is_there_once(server, *train_through_a_crash(server))
    finally:
        server.kill()
        postgres.stop()


@pytest.mark.slow
def test_a_server_that_hangs_does_not_hold_up_the_training(tmp_path, monkeypatch):
    mlflow_home(tmp_path, monkeypatch)
    server = Server(tmp_path).start()
    try:
        hang = threading.Timer(0.0, server.signal, [signal.SIGSTOP])
        wake = threading.Timer(8.0, server.signal, [signal.SIGCONT])
        dumps = Dumps(0.1, hang, wake)
        callback = MLflowCallback(tracking_uri=server.address, log_model=False)
        ppo().learn(64 * 60, callback=[MetricsCallback(), dumps, callback])
        wake.join()
        every_point_is_there_once(server, dumps, callback)
    finally:
        server.kill()


TRAINING = """
import sys
from pathlib import Path
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from tracking import SmallEnv, ppo
from avp_sb3 import MetricsCallback, MLflowCallback, RerunCallback

class Tell(BaseCallback):
    def _on_rollout_start(self):
        print(self.num_timesteps, tracking.run_id, flush=True)
    def _on_step(self):
        return True

tracking = MLflowCallback(checkpoint_s=0.2)
recording = RerunCallback("killed.rrd", every=1, max_share=1, pictures=2, width=32, height=20)
ppo().learn(10**9, callback=[MetricsCallback(), tracking, recording, Tell()])
"""


def test_a_killed_training_leaves_model_points_and_recording_and_goes_on(tmp_path, monkeypatch):
    client = MlflowClient(mlflow_home(tmp_path, monkeypatch))
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), str(ROOT)])}
    training = subprocess.Popen([sys.executable, "-c", TRAINING], env=env, stdout=subprocess.PIPE, text=True)
    steps, run_id = 0, ""
    began = None
    while began is None or time.monotonic() - began < 3:
        words = training.stdout.readline().split()
        steps, run_id = int(words[0]), words[1]
        began = began or time.monotonic()
    training.kill()
    training.wait()
    assert client.get_run(run_id).info.status == "RUNNING"

    # Rerun's own check asks for a file that was ended; what counts is that everything before can be read.
    episodes = {time for time, _ in rows(tmp_path / "killed.rrd", "/plots/coverage", "Scalars:scalars", "episode")}
    assert len(episodes) > 1

    subprocess.run([sys.executable, "-m", "avp_habitat.tracking.deliver"], check=True)
    run = client.get_run(run_id)
    assert run.info.status == "KILLED"
    points = [point.step for point in client.get_metric_history(run_id, "avp/coverage")]
    # All that was logged until the last line that the training printed, each once.
    assert points[: steps // 64] == list(range(64, steps + 1, 64))
    assert len(points) == len(set(points)) <= steps // 64 + 8

    model = PPO.load(client.download_artifacts(run_id, "model.zip", str(tmp_path)), env=ppo().env, device="cpu")
    kept = model.num_timesteps
    assert 0 < kept <= points[-1]
    callback = MLflowCallback()
    model.learn(128, callback=[MetricsCallback(), callback], reset_num_timesteps=False)
    assert callback.run_id == run_id
    again = client.get_run(run_id)
    assert again.info.status == "FINISHED"
    assert again.data.tags["avp.resumed_at_step"] == str(kept)
    later = [point.step for point in client.get_metric_history(run_id, "avp/coverage")][len(points) :]
    assert later == [kept + 64, kept + 128]
