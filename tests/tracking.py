"""What the tests of the trackers share: `AVP-v0` in the analytic corridor, a small PPO, an empty MLflow database."""

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

from corridor import Corridor
from mlflow import MlflowClient
from stable_baselines3 import PPO

from avp_habitat.task.env import AVPEnv
from avp_habitat.task.rewards import RewardConstants
from avp_habitat.task.settings import TaskSettings

SETTINGS = TaskSettings(budget=8, width=16, height=12, constants=replace(RewardConstants(), stop_coverage=0.1))


class SmallEnv(AVPEnv):
    def __init__(self, **overrides):
        super().__init__(simulator=Corridor(), settings=SETTINGS, **overrides)


class BreakingEnv(SmallEnv):
    """Breaks in its 100th step."""

    def __init__(self, error):
        super().__init__()
        self.error, self.steps = error, 0

    def step(self, action):
        self.steps += 1
        if self.steps == 100:
            raise self.error
        return super().step(action)


def ppo(env=None, **options):
    defaults = {"n_steps": 64, "batch_size": 64, "n_epochs": 1, "seed": 3, "device": "cpu"}
    return PPO("MlpPolicy", env or SmallEnv(), **{**defaults, **options})


@cache
def _empty_database():
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mlflow.db"
        MlflowClient(f"sqlite:///{path}").search_experiments()
        return path.read_bytes()


def mlflow_home(folder, monkeypatch):
    """Make `folder` the current one, with an empty MLflow database that is the configured one; its address."""
    uri = f"sqlite:///{folder}/mlflow.db"
    (folder / "mlflow.db").write_bytes(_empty_database())
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    for name in ("AVP_MLFLOW_SPOOL", "MLFLOW_EXPERIMENT_NAME", "MLFLOW_EXPERIMENT_ID"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    return uri
