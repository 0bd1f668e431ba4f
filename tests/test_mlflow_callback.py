import json
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
from stable_baselines3.common.vec_env import DummyVecEnv
from tracking import BreakingEnv, SmallEnv, mlflow_home, ppo
from tracking_server import free_port

from avp_habitat import command
from avp_habitat.errors import UsageError
from avp_habitat.provenance import flat
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.tracking import deliver
from avp_habitat.tracking.experiments import find_run
from avp_habitat.tracking.stores import TrackingError
from avp_sb3 import MetricsCallback, MLflowCallback
from avp_sb3.callbacks.mlflow import hyperparameters, run_name

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


def test_runs_without_a_name_say_algorithm_reward_scene_and_seed(client):
    names = []
    for seed in (3, None, 4):
        callback = MLflowCallback()
        ppo(seed=seed).learn(64, callback=callback)
        names.append(client.get_run(callback.run_id).info.run_name)
    assert names == ["ppo proposed corridor seed 3", "ppo proposed corridor", "ppo proposed corridor seed 4"]


def test_the_name_of_a_run_in_many_scenes_or_elsewhere_says_what_there_is():
    def scene(name):
        return type("Scene", (SmallEnv,), {"scene_name": name})

    model = ppo(DummyVecEnv([scene(name) for name in ("a", "b", "a", "c")]))
    assert run_name(model, model.get_env()) == "ppo proposed a and 2 more seed 3"
    pole = DQN("MlpPolicy", "CartPole-v1", device="cpu", buffer_size=100)
    assert run_name(pole, pole.get_env()) == "dqn CartPole-v1"


def test_the_stored_model_loads_acts_and_names_its_run(client, tmp_path):
    model, callback = ppo(), MLflowCallback()
    model.learn(64, callback=callback)
    path = client.download_artifacts(callback.run_id, "model.zip", str(tmp_path))
    loaded = PPO.load(path, device="cpu")
    observation = np.zeros(12, dtype=np.float32)
    assert loaded.predict(observation, deterministic=True)[0] == model.predict(observation, deterministic=True)[0]
    assert loaded.avp_mlflow_run_id == callback.run_id


def test_the_last_trajectory_is_a_picture_of_the_run(client, tmp_path):
    from avp_habitat.rollout.images import read_rgb

    callback = MLflowCallback(log_model=False)
    ppo().learn(64, callback=callback)
    assert {file.path for file in client.list_artifacts(callback.run_id)} == {"trajectory.png", "params.json"}
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
    kept = {file.path for file in client.list_artifacts(callback.run_id)}
    assert ("model.zip" in kept) == (status == "KILLED")


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


def interrupted(callback):
    model = ppo(BreakingEnv(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        model.learn(256, callback=callback)
    return model, callback.run_id


def test_a_training_that_goes_on_after_an_interruption_goes_on_in_its_run(client):
    callback = MLflowCallback()
    model, first = interrupted(callback)
    assert client.get_run(first).info.status == "RUNNING"
    model.learn(64, callback=[MetricsCallback(), callback], reset_num_timesteps=False)
    run = client.get_run(callback.run_id)
    assert callback.run_id == first
    assert run.info.status == "FINISHED"
    assert run.data.tags["avp.resumed_at_step"] == "99"
    assert json.loads(run.data.tags["avp.changed_params"]) == {"total_timesteps": ["256", "163"]}
    assert [point.step for point in client.get_metric_history(first, "avp/coverage")] == [163]


def test_a_training_that_begins_anew_closes_the_interrupted_run(client):
    callback = MLflowCallback()
    model, first = interrupted(callback)
    model.learn(64, callback=callback)
    assert client.get_run(first).info.status == "KILLED"
    assert callback.run_id != first
    assert client.get_run(callback.run_id).data.tags["avp.continued_from"] == first


def test_a_training_that_goes_on_after_a_finished_one_has_a_run_of_its_own(client):
    model, callback = ppo(), MLflowCallback(log_model=False)
    model.learn(64, callback=callback)
    first = callback.run_id
    model.learn(64, callback=callback, reset_num_timesteps=False)
    assert client.get_run(callback.run_id).data.tags["avp.continued_from"] == first
    assert client.get_run(first).info.status == client.get_run(callback.run_id).info.status == "FINISHED"


def test_a_run_can_be_named_to_go_on_with(client):
    first = MLflowCallback(log_model=False)
    ppo().learn(64, callback=first)
    second = MLflowCallback(run_id=first.run_id, log_model=False)
    ppo().learn(64, callback=second)
    assert second.run_id == first.run_id
    assert client.get_run(first.run_id).info.status == "FINISHED"
    with pytest.raises(TrackingError, match=r"MLflow run nothing: expected a run at sqlite:.*, found none"):
        ppo().learn(64, callback=MLflowCallback(run_id="nothing"))


def test_the_model_is_kept_on_the_way(client, tmp_path):
    class Look(BaseCallback):
        steps = 0

        def _on_rollout_end(self):
            if self.num_timesteps == 192:
                callback._run.flush()
                path = client.download_artifacts(callback.run_id, "model.zip", str(tmp_path))
                self.steps = PPO.load(path, device="cpu").num_timesteps

        def _on_step(self):
            return True

    callback, look = MLflowCallback(checkpoint_s=1e-9), Look()
    ppo().learn(192, callback=[callback, look])
    assert look.steps == 128
    with pytest.raises(UsageError, match="checkpoint_s: expected seconds above 0, got 0"):
        MLflowCallback(checkpoint_s=0)


def test_parameters_are_kept_with_their_types(client, tmp_path):
    callback = MLflowCallback(log_model=False)
    ppo(learning_rate=3e-4, policy_kwargs={"net_arch": [16]}).learn(64, callback=callback)
    kept = json.loads(Path(client.download_artifacts(callback.run_id, "params.json", str(tmp_path))).read_text())
    assert kept["learning_rate"] == 3e-4
    assert kept["policy_kwargs.net_arch"] == [16]
    assert kept["normalize_advantage"] is True


def test_a_training_goes_on_without_its_server_when_told_to(client, tmp_path):
    address = f"http://127.0.0.1:{free_port()}"
    with pytest.raises(TrackingError, match=r"no server answers there .*AVP_MLFLOW_OFFLINE=1"):
        ppo().learn(64, callback=MLflowCallback(tracking_uri=address))
    model, callback = ppo(), MLflowCallback(tracking_uri=address, offline=True)
    model.learn(64, callback=[MetricsCallback(), callback])
    assert callback.run_id.startswith("offline-")
    # The server that was meant never comes; the points can go elsewhere.
    assert command.run(deliver.main, ["--mlflow", client.tracking_uri]) == 0
    run = find_run(client, callback.run_id)
    assert run.info.status == "FINISHED"
    assert [point.step for point in client.get_metric_history(run.info.run_id, "avp/coverage")] == [64]
    path = client.download_artifacts(run.info.run_id, "model.zip", str(tmp_path))
    assert PPO.load(path, device="cpu").avp_mlflow_run_id == callback.run_id
    assert not any((tmp_path / "runs").iterdir())


@pytest.mark.parametrize(
    ("address", "problem"),
    [
        ("gopher://here", ".*unsupported URI 'gopher://here'.*'sqlite'"),
        ("sqlite:////proc/nowhere/mlflow.db", "/proc/nowhere/mlflow.db: cannot write there: No such file or directory"),
    ],
)
def test_addresses_that_cannot_be_used_are_named_at_the_start(client, address, problem):
    with pytest.raises(TrackingError, match=f"MLflow at {address} cannot be used: {problem}"):
        ppo().learn(64, callback=MLflowCallback(tracking_uri=address))


def test_a_folder_of_runs_needs_mlflows_own_switch(client, tmp_path, monkeypatch):
    folder = (tmp_path / "kept").as_uri()
    with pytest.raises(TrackingError, match="MLFLOW_ALLOW_FILE_STORE=true"):
        ppo().learn(64, callback=MLflowCallback(tracking_uri=folder))
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    callback = MLflowCallback(tracking_uri=folder)
    ppo().learn(128, callback=[MetricsCallback(), callback])
    run = MlflowClient(folder).get_run(callback.run_id)
    assert run.info.status == "FINISHED"
    assert [p.step for p in MlflowClient(folder).get_metric_history(callback.run_id, "avp/coverage")] == [64, 128]


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
    run_id = done.stdout.split("MLflow:   run ")[1].split()[0]
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


def test_a_parameter_that_a_run_has_already_stays_and_the_change_is_noted(client):
    with mlflow.start_run() as outer:
        mlflow.log_param("algo", "other")
        ppo().learn(64, callback=MLflowCallback())
    data = client.get_run(outer.info.run_id).data
    assert (data.params["algo"], data.params["n_steps"]) == ("other", "64")
    assert json.loads(data.tags["avp.changed_params"]) == {"algo": ["other", "PPO"]}


def test_runs_of_others_in_this_program_know_versions_and_open_scenes(client):
    env = make_simulator("raycast", "builtin:0")
    with mlflow.start_run() as run:
        pass
    tags = client.get_run(run.info.run_id).data.tags
    # Other tests of this process may have left scenes open.
    digests = dict(zip(tags["avp.scene"].split(", "), tags["avp.scene_digest"].split(", "), strict=True))
    assert digests["builtin:0"] == env.scene_digest
    assert tags["version.stable-baselines3"]
    assert tags["system.platform"]


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
