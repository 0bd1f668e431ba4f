"""Habitat-Sim in processes: run where it is installed."""

import os
import signal

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from avp_habitat.errors import SimulatorError, UsageError
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import TaskSettings
from avp_sb3 import AVPSubprocVecEnv, EvaluationCallback, zoo

pytestmark = pytest.mark.habitat
SETTINGS = TaskSettings(width=32, height=24, budget=6)
SMALL = {"width": 32, "height": 24, "budget": 6}
ROOMS = ["builtin:0", "builtin:1"]


def test_each_scene_has_its_process_and_a_killed_one_is_named():
    env = AVPSubprocVecEnv(ROOMS, agents=4, simulator="habitat", settings=SETTINGS, seed=3)
    try:
        assert env.reset().shape == (4, 12)
        *_, infos = env.step(np.zeros(4, dtype=np.int64))
        assert env.get_attr("scene_name") == [*ROOMS, *ROOMS]
        assert max(info["coverage"] for info in infos) > 0
        os.kill(env.processes[1].pid, signal.SIGKILL)
        with pytest.raises(SimulatorError, match=r"worker 1 of 2 \(scene builtin:1\) was killed by SIGKILL"):
            env.step(np.zeros(4, dtype=np.int64))
    finally:
        env.close()
    assert env.processes[0].exitcode == 0


def test_rl_zoo3s_processes_take_turns_in_scenes():
    kwargs = {**SMALL, "simulator": "habitat", "render_mode": None}
    # A worker knows the id only with the package's name before it: nothing else imports the package there.
    venv = make_vec_env("avp_habitat:AVP-v0", n_envs=2, env_kwargs=kwargs, vec_env_cls=SubprocVecEnv)
    watched = zoo.Batched(venv, scenes=ROOMS)
    try:
        assert watched.get_attr("scene_name") == ROOMS
        watched.reset()
        watched.step(np.zeros(2, dtype=np.int64))
    finally:
        watched.close()
    assert [process.exitcode for process in watched.venv.processes] == [0, 0]


def test_an_evaluation_opens_other_scenes_beside_the_trainings(tmp_path):
    env = AVPEnv("builtin:0", simulator="habitat", **SMALL)
    with pytest.raises(SimulatorError, match="this one has builtin:0 open already, so that builtin:1 needs a process"):
        AVPEnv("builtin:1", simulator="habitat", **SMALL)
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu")
    evaluation = EvaluationCallback(
        ROOMS, simulator="habitat", every=1000, episodes=1, best_model=tmp_path / "best.zip"
    )
    model.learn(16, callback=evaluation)
    assert evaluation.best is not None
    assert (tmp_path / "best.zip").exists()
    with pytest.raises(UsageError, match=r"expected one scene, got 2: .*rl_zoo3: --vec-env subproc"):
        zoo.Batched(DummyVecEnv([lambda: AVPEnv("builtin:0", simulator="habitat", **SMALL)] * 2), scenes=ROOMS)
    version = env.simulator.version
    assert version.startswith("habitat-sim 0.")
    env.change_scene("builtin:1")
    assert env.scene_name == "builtin:1"
    assert env.reset(seed=0)[0].shape == (12,)
