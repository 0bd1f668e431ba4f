"""One PPO training with Table 4's values, in the ways whose speed is compared."""

import logging
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from mlflow import MlflowClient
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from avp_habitat.simulators.base import Simulator
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import TaskSettings
from avp_sb3 import AVPVecEnv, MetricsCallback, MLflowCallback, RerunCallback
from avp_sb3.presets import TABLE_4

BUFFER = TABLE_4.n_envs * TABLE_4.n_steps
"""Steps of all agents between two updates."""
_EXPERIMENT = "benchmark"


@dataclass(frozen=True)
class Way:
    """How the environment is stepped, and what is recorded."""

    name: str
    """For the table."""
    agents: int
    """1 for a single `AVPEnv` under `DummyVecEnv`, unless it is a batch."""
    batched: bool
    """Whether it is one `AVPVecEnv`."""
    lookup: bool
    """Whether views are looked up in tables."""
    callbacks: Literal["none", "tracking", "all"]
    """none. tracking: metrics and MLflow. all: also Rerun with its defaults, which renders pictures."""


@dataclass(frozen=True)
class Timing:
    """What one training took."""

    steps: int
    """Steps of all agents together; whole buffers of PPO."""
    loop_s: float
    """Seconds from the first step to the end of the last update: what grows with the steps."""
    learn_s: float
    """Seconds of the whole `learn()`: also opening and closing the MLflow run and the Rerun file."""
    first_step_at: float
    """When the first step was done, seconds since the epoch."""


class Clock(BaseCallback):
    """Times the training between the other callbacks' opening and closing; to be the first callback."""

    def __init__(self) -> None:
        """Make a clock that has not started."""
        super().__init__()
        self.start = self.end = self.first_step_at = 0.0

    def _on_rollout_start(self) -> None:
        self.start = self.start or time.perf_counter()

    def _on_step(self) -> bool:
        self.first_step_at = self.first_step_at or time.time()
        return True

    def _on_training_end(self) -> None:
        self.end = time.perf_counter()


def prepare_tracking(folder: Path) -> str:
    """Make an empty MLflow store in a folder, so that no training pays for it.

    Returns:
        The tracking URI.
    """
    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    uri = f"sqlite:///{folder / 'mlflow.db'}"
    client = MlflowClient(uri)
    if client.get_experiment_by_name(_EXPERIMENT) is None:
        client.create_experiment(_EXPERIMENT, artifact_location=(folder / "artifacts").resolve().as_uri())
    return uri


def train(way: Way, simulator: Simulator, *, reward: str, steps: int, seed: int, folder: Path, tracking: str) -> Timing:
    """Train once.

    Args:
        way: how.
        simulator: an open scene.
        reward: its name.
        steps: at least so many; PPO completes its buffer.
        seed: of the policy and the starts.
        folder: for the Rerun recording, which is removed again.
        tracking: MLflow's tracking URI.
    """
    torch.set_num_threads(1)
    model = PPO(
        "MlpPolicy",
        _environment(way, simulator, reward, seed),
        **replace(TABLE_4, n_steps=BUFFER // way.agents).arguments(),
        device="cpu",
        seed=seed,
    )
    clock = Clock()
    recording = folder / "training.rrd"
    callbacks: list[BaseCallback] = [clock]
    if way.callbacks != "none":
        callbacks += [MetricsCallback(), MLflowCallback(_EXPERIMENT, tracking_uri=tracking)]
    if way.callbacks == "all":
        callbacks.append(RerunCallback(recording))
    start = time.perf_counter()
    try:
        model.learn(steps, callback=callbacks)
    finally:
        recording.unlink(missing_ok=True)
    return Timing(model.num_timesteps, clock.end - clock.start, time.perf_counter() - start, clock.first_step_at)


def _environment(way: Way, simulator: Simulator, reward: str, seed: int) -> VecEnv:
    settings = TaskSettings(reward=reward, lookup=way.lookup)
    if way.batched:
        return VecMonitor(AVPVecEnv(agents=way.agents, simulator=simulator, settings=settings, seed=seed))
    return DummyVecEnv([lambda: Monitor(AVPEnv(simulator=simulator, settings=settings))] * way.agents)
