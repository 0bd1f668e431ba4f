import os
import pickle
import shlex
import signal
import subprocess
import sys
import time
import zipfile

import pytest
from mlflow import MlflowClient
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from avp_habitat import command
from avp_habitat.rollout.format import read_rollout
from avp_habitat.task.settings import TaskSettings
from avp_sb3 import AVPVecEnv, MLflowCallback
from avp_sb3.callbacks.best_model import save_model
from avp_sb3.presets import TABLE_4
from avp_sb3.train import main


def run(*words, folder):
    """The training program as a user runs it; results go to `folder`."""
    env = {**os.environ, "MLFLOW_TRACKING_URI": f"sqlite:///{folder / 'mlflow.db'}", "PYTHONWARNINGS": "ignore"}
    line = [sys.executable, "-m", "avp_sb3.train", *map(str, words)]
    return subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, timeout=550, check=False)


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """The training program in this process: its exit code, and the one line that it says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path / 'mlflow.db'}")

    def call(*words):
        code = command.run(main, [str(word) for word in words])
        said = capsys.readouterr().err
        assert said.startswith("error: ")
        assert said.count("\n") == 1
        return code, said

    return call


def test_the_training_script_trains_tracks_and_saves(tmp_path):
    camera = ("--width", 16, "--height", 12)
    words = ("--steps", 2048, "--agents", 16, "--out", "model.zip", "--recording", "training.rrd", *camera)
    words += ("--run-name", "tiny", "--eval-scene", "builtin:1", "--eval-every", 1024)
    done = run(*words, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "model.zip: the policy after 2048 steps" in done.stdout
    assert (tmp_path / "training.rrd").stat().st_size > 10_000
    client = MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    (found,) = client.search_runs([client.get_experiment_by_name("avp").experiment_id])
    assert (found.info.run_name, found.info.status) == ("tiny", "FINISHED")
    assert 0 < found.data.metrics["avp/coverage"] < 1
    evaluated = client.get_metric_history(found.info.run_id, "eval/coverage")
    assert [point.step for point in evaluated] == [0, 1024, 2048]
    assert "best_model.zip" in {file.path for file in client.list_artifacts(found.info.run_id)}
    assert zipfile.is_zipfile(tmp_path / "model-best.zip")

    collected = subprocess.run(
        [sys.executable, "-m", "avp_habitat.collect", "--scene", "builtin:0", "--policy", "model.zip", "--budget", "3",
         "--width", "32", "--height", "24", "--out", "r"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert collected.returncode == 0, collected.stderr
    assert read_rollout(tmp_path / "r").meta["mlflow_run_id"] == found.info.run_id


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("--agents", 3), "--agents: expected a divisor of PPO's buffer of 2048 steps, got 3"),
        (("--reward", "cover"), "unknown reward 'cover'"),
        (("--steps", 0), "--steps: expected a whole number from 1 to 1,000,000,000,000, got 0"),
        (
            ("--observation", "maps"),
            "unknown observation 'maps': expected one of map, numbers, onboard, privileged, surface_map; did you mean "
            "'map'?",
        ),
        (("--resume", "no.zip"), "--resume no.zip: no such model file"),
        (("--resume", "runs:/1/model.zip"), "--resume runs:/1/model.zip: no MLflow database at sqlite:///"),
        (("--eval-every", 0), "--eval-every: expected a whole number from 1 to 1,000,000,000,000, got 0"),
        (("--gpu", 0), "--gpu: is of the simulator 'habitat', but 'raycast' was chosen"),
        (("--workers", 0), "workers: expected a multiple of the number of scenes, 1, got 0"),
        (
            ("--rooms", 2, "--workers", 99_999),
            "open-scenes, workers: 2 scenes in 100000 processes need about 120000.1 GiB",
        ),
    ],
)
def test_wrong_options_of_the_training_end_before_anything_is_made(refused, tmp_path, words, error):
    code, said = refused(*words)
    assert code == 2
    assert error in said
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_no_model_cannot_go_on(refused, tmp_path):
    (tmp_path / "notes.txt").write_text("no model")
    code, said = refused("--resume", "notes.txt", "--width", 16, "--height", 12, "--agents", 16)
    assert code == 1
    assert "notes.txt: expected a model of Stable-Baselines3" in said


def test_a_scene_that_cannot_be_evaluated_ends_before_a_run_or_a_model_is_made(refused, tmp_path):
    (tmp_path / "model.zip").write_text("an earlier one")
    words = ("--out", "model.zip", "--width", 16, "--height", 12, "--agents", 16, "--eval-scene", "no.glb")
    code, said = refused(*words)
    assert code == 1
    assert "no.glb" in said
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]
    assert (tmp_path / "model.zip").read_text() == "an earlier one"


@pytest.mark.slow
def test_the_training_script_trains_in_a_pool_of_generated_rooms(tmp_path):
    words = ("--steps", 2048, "--agents", 16, "--rooms", 3, "--open-scenes", 2, "--turnover", 1, "--out", "m.zip")
    done = run(*words, "--width", 16, "--height", 12, "--recording", "r.rrd", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    client = MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    (found,) = client.search_runs([client.get_experiment_by_name("avp").experiment_id])
    assert found.data.tags["avp.scene"] == "builtin:1000, builtin:1001, builtin:1002"
    assert found.info.status == "FINISHED"


@pytest.mark.slow
def test_the_training_script_trains_with_a_process_for_each_scene(tmp_path):
    words = ("--steps", 2048, "--agents", 16, "--scene", "builtin:0", "builtin:1", "--workers", 2, "--out", "m.zip")
    done = run(*words, "--width", 16, "--height", 12, "--eval-scene", "builtin:2", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "m.zip: the policy after 2048 steps" in done.stdout
    client = MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    (found,) = client.search_runs(["1"])
    assert found.data.tags["avp.scene"] == "builtin:0, builtin:1"
    assert found.info.status == "FINISHED"


@pytest.mark.slow
def test_a_training_goes_on_from_the_model_in_its_mlflow_run(tmp_path):
    words = ("--agents", 16, "--out", "model.zip", "--width", 16, "--height", 12)
    first = run(*words, "--steps", 2048, folder=tmp_path)
    assert first.returncode == 0, first.stderr
    client = MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    (found,) = client.search_runs(["1"])
    (tmp_path / "model.zip").unlink()
    address = f"runs:/{found.info.run_id}/model.zip"
    second = run(*words, "--steps", 4096, "--resume", address, folder=tmp_path)
    assert second.returncode == 0, second.stderr
    assert "model.zip: the policy after 4096 steps" in second.stdout
    for wrong in (f"runs:/{found.info.run_id}/nothing.zip", "runs:/" + "0" * 32 + "/model.zip"):
        failed = run(*words, "--resume", wrong, folder=tmp_path)
        assert failed.returncode == 2
        assert f"--resume {wrong}: not found at sqlite:///" in failed.stderr
        assert "Traceback" not in failed.stderr


@pytest.mark.slow
def test_an_interrupted_training_keeps_its_model_and_goes_on_by_the_printed_command(tmp_path):
    env = {**os.environ, "MLFLOW_TRACKING_URI": f"sqlite:///{tmp_path / 'mlflow.db'}", "PYTHONWARNINGS": "ignore"}
    line = [sys.executable, "-m", "avp_sb3.train", "--agents", "8", "--rays", "--out", "model.zip"]
    line += ["--width", "16", "--height", "12"]
    training = subprocess.Popen(line, cwd=tmp_path, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    client, steps = MlflowClient(env["MLFLOW_TRACKING_URI"]), 0
    for _ in range(600):
        time.sleep(0.2)
        steps = sampled_steps(client) if (tmp_path / "mlflow.db").exists() else 0
        if steps:
            break
    training.send_signal(signal.SIGINT)
    out, err = training.communicate(timeout=60)
    assert training.returncode == 130
    assert "Traceback" not in err
    assert (tmp_path / "model.zip").exists()
    (again,) = [text.removeprefix("to go on:") for text in out.splitlines() if text.startswith("to go on:")]
    words = shlex.split(again)
    assert words[:3] == ["python", "-m", "avp_sb3.train"]
    done = int(out.split("the policy after ")[1].split()[0])
    resumed = run(*words[3:], "--steps", done + 1, folder=tmp_path)
    assert resumed.returncode == 0, resumed.stderr
    assert f"model.zip: the policy after {done + 2048} steps" in resumed.stdout
    (found,) = client.search_runs(["1"])
    assert found.info.status == "FINISHED", "the resumed training goes on with the run"
    assert sampled_steps(client) == done + 2048


def sampled_steps(client):
    """Environment steps of the newest point that the only training has logged, 0 before the first."""
    found = client.search_runs(["1"])
    return int(found[0].data.metrics.get("time/total_timesteps", 0)) if found else 0


@pytest.mark.slow
def test_a_normalised_training_goes_on_with_its_statistics_from_a_file_and_from_mlflow(tmp_path):
    settings = TaskSettings(lookup=True, width=16, height=12)
    env = VecNormalize(VecMonitor(AVPVecEnv("builtin:0", agents=16, settings=settings, seed=0)))
    arguments = {**TABLE_4.arguments(), "n_steps": 128}
    model = PPO("MlpPolicy", env, device="cpu", **arguments)
    tracking = MLflowCallback(tracking_uri=f"sqlite:///{tmp_path / 'mlflow.db'}")
    model.learn(2048, callback=tracking)
    save_model(model, tmp_path / "first.zip")
    words = ("--agents", 16, "--width", 16, "--height", 12, "--steps", 4096)
    for resume, out in (("first.zip", "a.zip"), (f"runs:/{tracking.run_id}/model.zip", "b.zip")):
        done = run(*words, "--resume", resume, "--out", out, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        with (tmp_path / out.replace(".zip", "_vecnormalize.pkl")).open("rb") as file:
            # One more than twice the steps of one training: observations of the start count, too.
            assert pickle.load(file).obs_rms.count > 4096
    (tmp_path / "first_vecnormalize.pkl").unlink()
    refused = run(*words, "--resume", "first.zip", "--out", "c.zip", folder=tmp_path)
    assert refused.returncode == 1
    assert "first.zip: trained under VecNormalize" in refused.stderr
    assert not (tmp_path / "c.zip").exists()
