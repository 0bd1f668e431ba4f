import pytest
from mlflow import MlflowClient
from rrd import entities, rows, verify
from stable_baselines3 import PPO
from tracking import mlflow_home, ppo

from avp_habitat.task.env import AVPEnv
from avp_sb3 import MetricsCallback, MLflowCallback, RerunCallback


@pytest.fixture(scope="module")
def env():
    """The real thing: a furnished room, ray-cast."""
    return AVPEnv("builtin:0", budget=20, width=32, height=24)


def test_a_training_in_a_furnished_room_feeds_all_trackers(env, tmp_path, monkeypatch):
    client = MlflowClient(mlflow_home(tmp_path, monkeypatch))
    mlflow_callback, rerun_callback = (
        MLflowCallback(),
        RerunCallback(tmp_path / "a.rrd", every=2, max_share=1, pictures=3),
    )
    ppo(env).learn(128, callback=[MetricsCallback(), mlflow_callback, rerun_callback])

    run = client.get_run(mlflow_callback.run_id)
    assert run.info.status == "FINISHED"
    assert run.data.tags["avp.scene"] == "builtin:0"
    assert run.data.tags["avp.scene_digest"] == env.scene_digest
    assert 0 < run.data.metrics["avp/coverage"] <= 1
    assert run.data.metrics["avp/views"] == 20
    assert run.data.metrics["avp/cpv"] == pytest.approx(100 * run.data.metrics["avp/coverage"] / 20)
    assert {file.path for file in client.list_artifacts(run.info.run_id)} == {
        "model.zip",
        "params.json",
        "trajectory.png",
    }
    model = PPO.load(client.download_artifacts(run.info.run_id, "model.zip", str(tmp_path)), device="cpu")
    action, _ = model.predict(env.reset(seed=0)[0])
    assert env.action_space.contains(action)

    verify(tmp_path / "a.rrd")
    assert {"/world/floor", "/world/agent", "/world/camera/rgb", "/world/camera/depth"} <= entities(tmp_path / "a.rrd")
    assert len(rows(tmp_path / "a.rrd", "/plots/coverage", "Scalars:scalars")) == 3 * 20
