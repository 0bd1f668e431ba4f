import os
import signal
import subprocess
import sys
from pathlib import Path

import mlflow
import numpy as np
import pytest
from mlflow import MlflowClient
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from tracking import BreakingEnv, SmallEnv, mlflow_home, ppo

from avp_habitat.errors import UsageError
from avp_habitat.provenance import flat
from avp_sb3 import MetricsCallback, MLflowCallback
from avp_sb3.run_facts import hyperparameters

TESTS = Path(__file__).parent


@pytest.fixture
def client(tmp_path, monkeypatch):
    return MlflowClient(mlflow_home(tmp_path, monkeypatch))


def test_a_training_can_be_read_back(client, tmp_path):
    model = ppo(learning_rate=3e-4, policy_kwargs={"net_arch": [16]})
    callback = MLflowCallback("corridor", "first", params={"task": {"tau": 0.85}}, tags={"why": "test"})
    model.learn(128, callback=[MetricsCallback(), callback])

    run = client.get_run(callback.run_id)
    assert run.info.status == "FINISHED"
    assert run.info.run_name == "first"
    assert client.get_experiment(run.info.experiment_id).name == "corridor"
    params = run.data.params
    assert (params["algo"], params["n_steps"], params["learning_rate"]) == ("PPO", "64", "0.0003")
    assert (params["clip_range"], params["seed"], params["n_envs"]) == ("0.2", "3", "1")
    assert (params["policy_kwargs.net_arch"], params["task.tau"]) == ("[16]", "0.85")
    assert (params["env.reward"], params["env.budget"]) == ("proposed", "8")
    assert params["env.constants.stop_coverage"] == "0.1"
    assert run.data.tags["avp.scene"] == "corridor"
    assert run.data.tags["avp.scene_digest"] == "c0" * 32
    assert run.data.tags["version.stable-baselines3"]
    assert run.data.tags["why"] == "test"
    steps = [point.step for point in client.get_metric_history(callback.run_id, "avp/coverage")]
    assert steps == [64, 128]
    losses = client.get_metric_history(callback.run_id, "train/loss")
    assert [point.step for point in losses] == [128, 128]


def test_the_stored_model_loads_acts_and_names_its_run(client, tmp_path):
    model, callback = ppo(), MLflowCallback()
    model.learn(64, callback=callback)
    path = client.download_artifacts(callback.run_id, "model.zip", str(tmp_path))
    loaded = PPO.load(path, device="cpu")
    observation = np.zeros(12, dtype=np.float32)
    assert loaded.predict(observation, deterministic=True)[0] == model.predict(observation, deterministic=True)[0]
    assert loaded.avp_mlflow_run_id == callback.run_id


def test_the_last_trajectory_is_a_picture_of_the_run(client, tmp_path):
    from avp_habitat.images import read_rgb

    callback = MLflowCallback(log_model=False)
    ppo().learn(64, callback=callback)
    assert [file.path for file in client.list_artifacts(callback.run_id)] == ["trajectory.png"]
    picture = read_rgb(Path(client.download_artifacts(callback.run_id, "trajectory.png", str(tmp_path))))
    assert picture.std() > 5


def test_commit_of_the_current_folder_becomes_a_tag(client, tmp_path):
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "x"], check=True)
    head = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout.strip()
    callback = MLflowCallback(log_model=False)
    ppo().learn(64, callback=callback)
    assert client.get_run(callback.run_id).data.tags["mlflow.source.git.commit"] == head


@pytest.mark.parametrize(
    ("error", "status"),
    [(RuntimeError("broken"), "FAILED"), (KeyboardInterrupt(), "KILLED"), (SystemExit(1), "KILLED")],
)
def test_a_context_closes_a_broken_run_with_its_metrics(client, error, status):
    with pytest.raises(type(error)), MLflowCallback() as callback:
        ppo(BreakingEnv(error)).learn(256, callback=[MetricsCallback(), callback])
    run = client.get_run(callback.run_id)
    assert run.info.status == status
    assert [point.step for point in client.get_metric_history(callback.run_id, "avp/coverage")] == [64, 99]
    assert bool(client.list_artifacts(callback.run_id)) == (status == "KILLED")


def test_a_context_leaves_a_finished_run_alone(client):
    with MLflowCallback() as callback:
        ppo().learn(64, callback=callback)
    assert client.get_run(callback.run_id).info.status == "FINISHED"


def test_a_callback_that_ends_the_training_early_finishes_the_run(client):
    class Enough(BaseCallback):
        def _on_step(self):
            return self.n_calls < 10

    callback = MLflowCallback()
    ppo().learn(256, callback=[callback, Enough()])
    assert client.get_run(callback.run_id).info.status == "FINISHED"


def test_a_host_that_cleans_up_after_an_interruption_kills_the_run(client):
    callback = MLflowCallback()
    try:
        ppo(BreakingEnv(KeyboardInterrupt())).learn(256, callback=callback)
    except KeyboardInterrupt:
        pass
    finally:
        callback.on_training_end()  # As rl_zoo3's ExperimentManager.learn does.
    assert client.get_run(callback.run_id).info.status == "KILLED"


def test_a_host_that_cleans_up_after_an_error_fails_the_run(client):
    callback = MLflowCallback()
    model = ppo(BreakingEnv(RuntimeError("broken")))

    def learn():
        try:
            model.learn(256, callback=callback)
        finally:
            callback.on_training_end()

    with pytest.raises(RuntimeError, match="broken"):
        learn()
    assert client.get_run(callback.run_id).info.status == "FAILED"


def test_the_next_training_closes_an_interrupted_run_and_names_it(client):
    model, callback = ppo(BreakingEnv(KeyboardInterrupt())), MLflowCallback()
    with pytest.raises(KeyboardInterrupt):
        model.learn(256, callback=callback)
    first = callback.run_id
    assert client.get_run(first).info.status == "RUNNING"
    model.learn(64, callback=callback, reset_num_timesteps=False)
    assert client.get_run(first).info.status == "KILLED"
    second = client.get_run(callback.run_id)
    assert second.info.status == "FINISHED"
    assert second.data.tags["avp.continued_from"] == first


@pytest.mark.parametrize(
    ("ending", "status"),
    [("os.kill(os.getpid(), 2)", "KILLED"), pytest.param("1 / 0", "FAILED", marks=pytest.mark.slow)],
)
def test_without_a_context_the_run_is_closed_when_python_exits(client, ending, status, tmp_path):
    script = f"""
import os
from tracking import SmallEnv, ppo
from avp_sb3 import MLflowCallback, MetricsCallback
class Ending(SmallEnv):
    steps = 0
    def step(self, action):
        self.steps += 1
        if self.steps == 100:
            {ending}
        return super().step(action)
ppo(Ending()).learn(256, callback=[MetricsCallback(), MLflowCallback("exits", {status!r}, verbose=1)])
"""
    path = os.pathsep.join([str(TESTS), str(TESTS.parent)])
    done = subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True
    )
    assert done.returncode in (1, -signal.SIGINT), done.stderr
    run_id = done.stdout.split("MLflow run ")[1].split()[0]
    assert client.get_run(run_id).info.status == status, done.stderr
    assert [point.step for point in client.get_metric_history(run_id, "avp/coverage")] == [64, 99]


def test_an_active_run_is_used_and_left_open(client):
    with mlflow.start_run(run_name="outer") as outer:
        callback = MLflowCallback()
        ppo().learn(64, callback=callback)
        assert callback.run_id == outer.info.run_id
        assert client.get_run(callback.run_id).info.status == "RUNNING"
        assert client.get_run(callback.run_id).data.params["algo"] == "PPO"
    assert client.get_run(callback.run_id).info.status == "FINISHED"


def test_an_active_run_elsewhere_is_refused(client, tmp_path):
    with (
        mlflow.start_run() as outer,
        pytest.raises(UsageError, match=rf"active MLflow run {outer.info.run_id} is kept"),
    ):
        ppo().learn(64, callback=MLflowCallback(tracking_uri=f"sqlite:///{tmp_path}/other.db"))


def test_an_unusable_parameter_closes_the_run_and_says_so(client):
    with mlflow.start_run() as outer:
        mlflow.log_param("algo", "other")
        with pytest.raises(mlflow.MlflowException, match="algo"):
            ppo().learn(64, callback=MLflowCallback())
    assert client.get_run(outer.info.run_id).data.params["algo"] == "other"


def test_without_any_setting_the_database_lies_in_the_current_folder(client, monkeypatch, tmp_path):
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    callback = MLflowCallback(log_model=False)
    ppo().learn(64, callback=callback)
    assert MlflowClient(f"sqlite:///{tmp_path}/mlflow.db").get_run(callback.run_id).info.status == "FINISHED"


def test_changing_schedules_and_other_algorithms_read_as_text():
    def falling(left):
        return left * 1e-3

    facts = hyperparameters(DQN("MlpPolicy", SmallEnv(), learning_rate=falling, buffer_size=10, device="cpu"))
    assert facts["learning_rate"] == "0.001 -> 0"
    assert (facts["algo"], facts["buffer_size"], facts["gamma"]) == ("DQN", 10, 0.99)


def test_nested_mappings_become_dotted_names():
    assert flat({"a": {"b": 1, "c": {"d": None}}, "e": []}) == {"a.b": 1, "a.c.d": None, "e": []}
