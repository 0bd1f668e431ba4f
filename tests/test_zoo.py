import os
import re
import signal
import subprocess
import sys
import time
from argparse import Namespace
from copy import deepcopy

import gymnasium
import numpy as np
import pytest
from mlflow import MlflowClient
from rl_zoo3.exp_manager import ExperimentManager
from rrd import rows, verify
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor
from tracking import mlflow_home

from avp_habitat import command
from avp_habitat.collect import main as collect
from avp_habitat.errors import SceneError, SimulatorError, UsageError
from avp_habitat.rollout.format import read_rollout
from avp_habitat.task.env import AVPEnv
from avp_sb3 import hyperparams, zoo
from avp_sb3.vec_env.batched import AVPVecEnv
from avp_sb3.vec_env.subproc import AVPSubprocVecEnv

SMALL = {"scene": "builtin:0", "width": 16, "height": 12, "budget": 6}


def zoo_envs(n=3, *, seed=5, vec_env_cls=DummyVecEnv, monitor_dir=None, vec_env_kwargs=None, **changes):
    """Environments made as rl_zoo3 makes them."""
    spec = gymnasium.spec("AVP-v0")
    return make_vec_env(
        lambda **kwargs: spec.make(**kwargs),
        n_envs=n,
        seed=seed,
        env_kwargs={**SMALL, **changes},
        vec_env_cls=vec_env_cls,
        vec_env_kwargs=vec_env_kwargs,
        monitor_dir=monitor_dir,
    )


def walk(venv, steps=14):
    """Observations, rewards, dones and episode figures of the same actions in any vector environment."""
    rng = np.random.default_rng(0)
    found = [venv.reset()]
    episodes = []
    for _ in range(steps):
        observation, reward, done, infos = venv.step(rng.integers(6, size=venv.num_envs))
        found += [observation, reward, done]
        episodes += [(info["episode"]["l"], info["avp_episode"]) for info in infos if "episode" in info]
    return found, episodes


def assert_same_walk(ours, theirs):
    (found, episodes), (expected, expected_episodes) = walk(ours), walk(theirs)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-7)
    assert len(episodes) == len(expected_episodes) > 0
    for (length, one), (other_length, other) in zip(episodes, expected_episodes, strict=True):
        assert length == other_length
        assert one == pytest.approx(other)


def test_the_batch_has_the_starts_numbers_and_episodes_of_the_zoos_environments():
    batch = zoo.Batched(zoo_envs(reward="coverage"), lookup=False)
    assert isinstance(batch, VecMonitor)
    assert isinstance(batch.venv, AVPVecEnv)
    assert batch.venv.settings.reward == "coverage"
    assert_same_walk(batch, zoo_envs(reward="coverage"))


def test_the_batch_looks_up_unless_told_otherwise():
    assert zoo.Batched(zoo_envs(1)).get_attr("settings")[0].lookup is True
    assert zoo.Batched(zoo_envs(1), lookup=False).get_attr("settings")[0].lookup is False


def test_the_batch_writes_one_monitor_file_in_place_of_the_zoos(tmp_path):
    batch = zoo.Batched(zoo_envs(monitor_dir=str(tmp_path)), lookup=False)
    walk(batch)
    batch.close()
    assert [path.name for path in tmp_path.iterdir()] == ["monitor.csv"]
    assert len((tmp_path / "monitor.csv").read_text().splitlines()) == 2 + 3 * 2


def test_agents_take_turns_in_the_given_scenes_but_a_single_one_keeps_its_own():
    scenes = ["builtin:1", "builtin:2"]
    assert zoo.Batched(zoo_envs(3), scenes=scenes, lookup=False).get_attr("scene_name") == [*scenes, "builtin:1"]
    assert zoo.Batched(zoo_envs(1), scenes=scenes, lookup=False).get_attr("scene_name") == ["builtin:0"]


def test_different_open_scenes_stay_with_their_agents():
    rooms = [{**SMALL, "scene": f"builtin:{seed}"} for seed in (0, 1, 0, 1)]
    venv = DummyVecEnv([lambda room=room: AVPEnv(**room) for room in rooms])
    venv.seed(0)
    venv = zoo.Batched(venv, lookup=False)
    assert venv.get_attr("scene_name") == [room["scene"] for room in rooms]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [({"render_mode": "rgb_array"}, "they render"), ({"record": "r"}, "they are wrapped in RecordRollout")],
)
def test_what_a_batch_would_leave_out_is_left_alone(tmp_path, monkeypatch, capsys, changes, reason):
    monkeypatch.chdir(tmp_path)
    venv = zoo_envs(1, **changes)
    assert zoo.Batched(venv) is venv
    assert reason in capsys.readouterr().out


def test_environments_that_cannot_be_batched_are_refused_in_one_line():
    with pytest.raises(UsageError, match=r"Batched: expected environments of AVP-v0, got CartPoleEnv"):
        zoo.Batched(make_vec_env("CartPole-v1", n_envs=2))
    with pytest.raises(UsageError, match="one environment for each of the 3 scenes, got 2"):
        zoo.Batched(zoo_envs(2), scenes=["builtin:1", "builtin:2", "builtin:3"])
    with pytest.raises(UsageError, match="scenes: expected environments that can be stepped as one batch"):
        zoo.Batched(zoo_envs(2, render_mode="rgb_array"), scenes=["builtin:1"])
    with pytest.raises(SceneError, match=r"nowhere\.glb"):
        zoo.Batched(zoo_envs(2), scenes=["builtin:1", "nowhere.glb"])


def processes(n=2, **changes):
    """Environments in processes of their own, as rl_zoo3 makes them."""
    return zoo_envs(n, vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "forkserver"}, **changes)


@pytest.mark.slow
def test_processes_give_the_same_numbers_and_take_turns_in_the_given_scenes(tmp_path):
    old = processes(monitor_dir=str(tmp_path))
    batch = zoo.Batched(old, lookup=False)
    try:
        assert isinstance(batch.venv, AVPSubprocVecEnv)
        assert len(batch.venv.processes) == 2
        assert old.closed
        assert_same_walk(batch, zoo_envs(2))
    finally:
        batch.close()
    assert [path.name for path in tmp_path.iterdir()] == ["monitor.csv"]
    assert len((tmp_path / "monitor.csv").read_text().splitlines()) == 2 + 2 * 2
    scenes = ["builtin:1", "builtin:2"]
    batch = zoo.Batched(processes(), scenes=scenes)
    try:
        assert batch.get_attr("scene_name") == scenes
        assert batch.get_attr("settings")[0].lookup
        assert_same_walk(batch, zoo.Batched(zoo_envs(2), scenes=scenes))
    finally:
        batch.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenes", "error"),
    [
        (["builtin:1", "gone.glb"], r"gone\.glb: no such scene file"),
        (["builtin:1", "builtin:2", "builtin:3"], "one environment for each of the 3 scenes, got 2"),
    ],
)
def test_scenes_that_cannot_be_are_one_error_of_the_parent(scenes, error):
    with pytest.raises((SceneError, UsageError), match=error):
        zoo.Batched(processes(), scenes=scenes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kwargs", "told"),
    [
        ({"scene": "gone.glb"}, "error: gone.glb: no such scene file"),
        ({"reward": "cover"}, "error: unknown reward 'cover'"),
    ],
)
def test_processes_that_cannot_begin_say_why_in_one_line_each(tmp_path, kwargs, told):
    code = f"""
import avp_habitat, gymnasium
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
spec = gymnasium.spec(avp_habitat.ENV_ID)
make_vec_env(spec.make, n_envs=2, env_kwargs={kwargs!r}, vec_env_cls=SubprocVecEnv)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=100)
    lines = done.stderr.splitlines()
    assert sum(line.startswith(told) for line in lines) >= 1, "the other process may be ended before it can say it"
    assert lines[-1].startswith(("EOFError", "ConnectionResetError", "BrokenPipeError"))
    assert "Process ForkServerProcess" not in done.stderr, "that is how a traceback of a process begins"


@pytest.mark.slow
def test_a_killed_process_is_named_with_its_scene_and_the_others_are_ended():
    batch = zoo.Batched(processes())
    batch.reset()
    os.kill(batch.venv.processes[1].pid, signal.SIGKILL)
    with pytest.raises(SimulatorError, match=r"worker 1 of 2 \(scene builtin:0\) was killed by SIGKILL"):
        walk(batch)
    assert [process.exitcode for process in batch.venv.processes] == [0, -9]
    assert batch.get_attr("area", [1])[0].area_m2 > 1, "an interrupted run is still drawn"
    batch.close()


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A current folder with an MLflow store, and fresh hyper-parameters: rl_zoo3 empties what it reads."""
    mlflow_home(tmp_path, monkeypatch)
    monkeypatch.setattr(hyperparams, "hyperparams", deepcopy(hyperparams.hyperparams))
    return tmp_path


def experiment(home, **changes):
    options = {
        "log_folder": str(home / "logs"),
        "config": "avp_sb3.hyperparams",
        "env_kwargs": {**SMALL},
        "eval_freq": -1,
        "device": "cpu",
        "seed": 1,
        "verbose": 0,
        "log_interval": -1,
    }
    return ExperimentManager(Namespace(env="AVP-v0"), "ppo", "AVP-v0", **{**options, **changes})


def test_rl_zoo3_reads_table_4(home):
    manager = experiment(home)
    model, _ = manager.setup_experiment()
    assert isinstance(model, PPO)
    assert manager.n_timesteps == 300_000
    assert model.n_steps * model.n_envs == 2048
    found = {name: getattr(model, name) for name in ("ent_coef", "n_epochs", "batch_size", "gae_lambda", "gamma")}
    assert found == {"ent_coef": 0.02, "n_epochs": 10, "batch_size": 512, "gae_lambda": 0.95, "gamma": 0.99}
    assert (model.learning_rate(1.0), model.learning_rate(0.0)) == (3e-4, 3e-4)
    assert (model.clip_range(1.0), model.clip_range(0.0)) == (0.2, 0.2)
    names = [type(callback).__name__ for callback in manager.callbacks]
    assert names == ["MLflowCallback", "MetricsCallback", "RerunCallback"]


def test_rl_zoo3_trains_logs_and_saves_what_collect_can_use(home):
    fewer = {"n_envs": 4, "n_steps": 16, "batch_size": 32, "n_epochs": 1}
    manager = experiment(home, hyperparams=fewer, n_timesteps=64, eval_freq=32, n_eval_episodes=1)
    model, _ = manager.setup_experiment()
    assert model.get_env().get_attr("settings")[0].lookup
    manager.learn(model)
    manager.save_trained_model(model)
    run = MlflowClient().get_run(model.avp_mlflow_run_id)
    assert run.info.status == "FINISHED"
    assert {"avp/coverage", "rollout/ep_rew_mean", "eval/mean_reward"} <= run.data.metrics.keys()
    words = ["--scene", "builtin:0", "--budget", "3", "--width", "16", "--height", "12", "--out", str(home / "r")]
    assert command.run(collect, ["--policy", str(home / "logs/ppo/AVP-v0_1/AVP-v0.zip"), *words]) == 0
    assert read_rollout(home / "r").meta["mlflow_run_id"] == run.info.run_id


def line(module, *words, **env_kwargs):
    kwargs = [f"{name}:{value!r}" for name, value in {**SMALL, **env_kwargs}.items()]
    common = ["--algo", "ppo", "--env", "AVP-v0", "--gym-packages", "avp_habitat", "--device", "cpu", "-f", "logs"]
    return [sys.executable, "-m", f"rl_zoo3.{module}", *common, *words, "--env-kwargs", *kwargs]


TRAIN = ["--conf-file", "avp_sb3.hyperparams", "--eval-freq", "-1", "--seed", "1"]


@pytest.mark.slow
def test_the_commands_train_in_processes_enjoy_and_record(home):
    few = ["-n", "64", "--vec-env", "subproc", "-params", "n_envs:2", "n_steps:32", "batch_size:32", "n_epochs:1"]
    trained = subprocess.run(line("train", *TRAIN, *few), cwd=home, capture_output=True, text=True, timeout=300)
    assert trained.returncode == 0, trained.stderr
    for changes, words in (({}, ""), ({"record": "enjoyed"}, r"enjoyed: \d views, coverage")):
        enjoy = line("enjoy", "--no-render", "-n", "13", **changes)
        enjoyed = subprocess.run(enjoy, cwd=home, capture_output=True, text=True, timeout=300)
        assert enjoyed.returncode == 0, enjoyed.stderr
        assert "2 Episodes" in enjoyed.stdout
        assert re.search(words, enjoyed.stdout)
    assert len(read_rollout(home / "enjoyed").frames) == 6


FEW = ["n_envs:4", "n_steps:16", "batch_size:32", "n_epochs:1"]


def only_run():
    client = MlflowClient()
    (run,) = client.search_runs([client.get_experiment_by_name("avp").experiment_id])
    return run


def steps_of(run, metric):
    return [point.step for point in MlflowClient().get_metric_history(run.info.run_id, metric)]


@pytest.mark.slow
def test_the_configuration_alone_logs_to_mlflow_and_rerun(home):
    words = [*TRAIN, "-n", "192", "-params", *FEW]
    trained = subprocess.run(line("train", *words), cwd=home, capture_output=True, text=True, timeout=300)
    assert trained.returncode == 0, trained.stderr
    run = only_run()
    assert run.info.status == "FINISHED"
    assert steps_of(run, "rollout/ep_rew_mean") == steps_of(run, "avp/coverage") == [64, 128, 192]
    assert run.data.params["n_steps"] == "16"
    assert "model.zip" in {file.path for file in MlflowClient().list_artifacts(run.info.run_id)}
    (recording,) = (home / "runs").glob("avp-*.rrd")
    verify(recording)
    assert len(rows(recording, "/plots/coverage", "Scalars:scalars")) >= 6, "the first episode at least"


@pytest.mark.slow
def test_the_evaluation_is_added_by_the_documented_option(home):
    option = re.search(r"`-params (callback:.*)`\.", hyperparams.__doc__, re.DOTALL)[1]
    option = option.replace('callback:"', "callback:").rstrip('"').replace("\n", " ")
    option = option.replace("'every': 50000", "'every': 100, 'episodes': 2, 'best_model': 'best.zip'")
    words = [*TRAIN, "-n", "192", "-params", *FEW, option]
    trained = subprocess.run(line("train", *words), cwd=home, capture_output=True, text=True, timeout=300)
    assert trained.returncode == 0, trained.stderr
    run = only_run()
    assert steps_of(run, "eval/coverage") == [0, 100, 192]
    assert {"eval/cpv", "eval/return", "eval/builtin_7/coverage", "eval/builtin_8/views"} <= run.data.metrics.keys()
    assert run.data.metrics["eval/coverage"] == pytest.approx(
        (run.data.metrics["eval/builtin_7/coverage"] + run.data.metrics["eval/builtin_8/coverage"]) / 2
    )
    best = PPO.load(home / "best.zip", device="cpu")
    assert best.avp_best["value"] == pytest.approx(run.data.metrics["eval/best_return"])
    kept = MlflowClient().download_artifacts(run.info.run_id, "best_model.zip", str(home))
    assert PPO.load(kept, device="cpu").num_timesteps == best.num_timesteps


@pytest.mark.slow
def test_an_interrupted_training_keeps_its_model_and_its_run(home):
    process = subprocess.Popen(line("train", *TRAIN), cwd=home, stdout=subprocess.PIPE, text=True)
    try:
        for text in process.stdout:
            if "total_timesteps" in text:
                break
        time.sleep(0.2)
        os.kill(process.pid, signal.SIGINT)
        process.communicate(timeout=120)
    finally:
        process.kill()
    model = PPO.load(home / "logs/ppo/AVP-v0_1/AVP-v0.zip", device="cpu")
    assert 0 < model.num_timesteps < 300_000
    assert MlflowClient().get_run(model.avp_mlflow_run_id).info.status == "KILLED"
