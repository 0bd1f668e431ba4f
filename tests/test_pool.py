import gc
import weakref

import numpy as np
import pytest
from corridor import Corridor
from mlflow import MlflowClient
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor
from tracking import mlflow_home

from avp_habitat.errors import SceneError, UsageError
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.task.settings import TaskSettings
from avp_sb3 import AVPSubprocVecEnv, AVPVecEnv, MetricsCallback, MLflowCallback, RerunCallback
from avp_sb3.train import Train
from avp_sb3.vec_env.pool import describe

BUDGET = 6
SETTINGS = TaskSettings(width=16, height=12, budget=BUDGET)
ROOMS = [f"builtin:{seed}" for seed in range(4)]


@pytest.fixture(scope="module", autouse=True)
def opened():
    """The rooms, which stay open while this module's tests use them."""
    return [make_simulator("raycast", room) for room in ROOMS]


def pool(scenes=ROOMS, **options):
    return AVPVecEnv(
        scenes, **{"agents": 4, "settings": SETTINGS, "seed": 5, "open_scenes": 2, "turnover": 1, **options}
    )


def walk(env, steps):
    """Random steps, the same ones every time: scenes after each of them, observations, and who ended."""
    rng = np.random.default_rng(0)
    observed, scenes, ended, infos = [env.reset()], [env.get_attr("scene_name")], [], []
    for _ in range(steps):
        observation, _, done, info = env.step(rng.integers(0, 5, env.num_envs))
        observed.append(observation)
        ended.append(done)
        infos.append(info)
        scenes.append(env.get_attr("scene_name"))
    return observed, scenes, ended, infos


def test_every_scene_comes_once_in_a_round_and_few_are_open():
    env = pool()
    entered, most = [*dict.fromkeys(env.get_attr("scene_name"))], 0
    env.reset()
    for _ in range(3 * len(ROOMS) * BUDGET):
        before = set(env._task._rooms)
        env.step(np.ones(4, dtype=int))
        entered += [env._task._rooms[number].simulator.scene for number in set(env._task._rooms) - before]
        most = max(most, len(env.simulators))
    rounds = [sorted(entered[start : start + 4]) for start in range(0, len(entered) - 3, 4)]
    assert len(rounds) > 2
    assert rounds == [ROOMS] * len(rounds)
    # Two, and the one that is entered while the last agents are still in another.
    assert most == 3


def test_episodes_are_whole_and_their_scene_is_the_one_that_is_told():
    env = pool()
    _, scenes, ended, infos = walk(env, 40)
    changes = 0
    for step, (done, info) in enumerate(zip(ended, infos, strict=True)):
        for row in np.flatnonzero(done):
            assert info[row]["avp_episode"]["views"] == BUDGET
            assert info[row]["TimeLimit.truncated"]
            assert info[row]["terminal_observation"].shape == env.observation_space.shape
            # What callbacks then ask is about the episode that ended, not about the next one.
            assert scenes[step + 1][row] == scenes[step][row]
            cells = len(make_simulator("raycast", scenes[step][row]).area.centres)
            assert len(info[row]["avp_trajectory"].first_seen) == cells
        changes += sum(a != b for a, b in zip(scenes[step], scenes[step + 1], strict=True))
    assert changes > 8


def test_agents_that_end_at_different_times_enter_one_by_one():
    env = pool(turnover=2)
    env.reset()
    env._task.steps[:] = [0, 1, 2, 3]
    before, moved = env.get_attr("scene_name"), set()
    for _ in range(30):
        env.step(np.ones(4, dtype=int))
        now = env.get_attr("scene_name")
        moved.add(sum(a != b for a, b in zip(before, now, strict=True)))
        before = now
    assert moved == {0, 1}


def test_the_seed_decides_scenes_and_starts():
    once, again, other = (walk(pool(seed=seed), 40) for seed in (5, 5, 6))
    assert once[1] == again[1]
    np.testing.assert_array_equal(once[0], again[0])
    assert once[1] != other[1]


def test_a_scene_that_was_left_is_freed():
    made = []

    def factory(scene):
        room = Corridor()
        room.scene = scene
        made.append(weakref.ref(room))
        return room

    env = pool([f"corridor {number}" for number in range(5)], simulator=factory)
    walk(env, 60)
    gc.collect()
    assert len(made) > 5
    assert sum(room() is not None for room in made) <= 3


def test_a_scene_that_cannot_be_used_is_left_out_with_a_warning():
    with pytest.warns(UserWarning, match=r"no\.glb.*goes on without this scene"):
        scenes = walk(pool([*ROOMS[:3], "no.glb"]), 40)[1]
    assert {name for now in scenes for name in now} == set(ROOMS[:3])
    with pytest.raises(SceneError, match=r"no(ne)?\.glb"), pytest.warns(UserWarning, match=".glb"):
        pool(["no.glb", "none.glb"], open_scenes=1)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"open_scenes": 0}, "open_scenes: expected"),
        ({"turnover": 0}, "turnover: expected"),
        ({"agents": 1}, "agents: expected at least 2, one for each scene, got 1"),
    ],
)
def test_numbers_that_cannot_be_are_refused(options, error):
    with pytest.raises(UsageError, match=error):
        pool(**options)


def test_many_scenes_are_called_by_their_kinds():
    assert describe(ROOMS) == "builtin:0, builtin:1, builtin:2, builtin:3"
    assert Train(rooms=256, homes=128).scenes[255:257] == ["builtin:1255", "builtin-home:1000"]
    assert describe(Train(rooms=256, homes=128).scenes) == "256 rooms, 128 homes"
    assert Train(scene=("a.glb",), rooms=1).scenes == ["a.glb", "builtin:1000"]
    assert Train().scenes == ["builtin:0"]


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_training_in_a_pool_with_all_callbacks(tmp_path, monkeypatch, workers):
    home = mlflow_home(tmp_path, monkeypatch)
    scenes = [f"builtin:{seed}" for seed in (0, 1, 2, 3, 0, 1)]
    options = {"agents": 4, "settings": SETTINGS, "seed": 5, "open_scenes": 2, "turnover": 1}
    env = VecMonitor(AVPSubprocVecEnv(scenes, workers=2, **options) if workers else AVPVecEnv(scenes, **options))
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=64, n_epochs=1, seed=0, device="cpu")
    recording = RerunCallback(tmp_path / "r.rrd", every=1, pictures=0, max_share=1.0)
    tracking = MLflowCallback()
    try:
        model.learn(256, callback=[MetricsCallback(), tracking, recording])
    finally:
        env.close()
    run = MlflowClient(home).get_run(tracking.run_id)
    assert run.data.tags["avp.scene"] == "6 rooms"
    assert run.info.run_name == "ppo proposed 6 rooms seed 0"
    assert 0 < run.data.metrics["avp/coverage"] < 1
    assert (tmp_path / "r.rrd").stat().st_size > 10_000
