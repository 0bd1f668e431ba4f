import csv
import json
import random
import signal
import subprocess
import sys
import time
import zipfile
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from corridor import Corridor
from mlflow import MlflowClient
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Image, KVWriter, Logger, configure
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tracking import SETTINGS, SmallEnv, mlflow_home, ppo

from avp_habitat.errors import SceneError, UsageError
from avp_habitat.rollout.drawing import draw_trajectory
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import TaskSettings
from avp_sb3 import AVPVecEnv, EvaluationCallback, MetricsCallback, MLflowCallback, evaluate_policy
from avp_sb3.callbacks.base import LoggedFile, MissingInfoError
from avp_sb3.callbacks.best_model import BestModel, BestModelError
from avp_sb3.evaluation.batch import means, run_batch, scenes_of
from avp_sb3.evaluation.picture import draw_curves, evaluation_picture

ROOMS = ("builtin:1", "builtin:2")
ROOM_SETTINGS = TaskSettings(budget=6, width=16, height=12)


class Dumps(KVWriter):
    """Everything that the logger dumps, in order."""

    def __init__(self):
        self.all = []

    def write(self, key_values, key_excluded, step=0):
        self.all.append((step, dict(key_values), dict(key_excluded)))

    def close(self):
        pass

    def evaluations(self):
        return [(step, values) for step, values, _ in self.all if "eval/coverage" in values]


def corridors(agents=4, **overrides):
    """Another simulator's rooms, as an environment for the evaluation."""
    return AVPVecEnv(agents=agents, simulator=Corridor(), settings=replace(SETTINGS, **overrides))


def evaluated(steps=256, env=None, *, model=None, others=(), **options):
    """Train a little with an evaluation, and what was dumped."""
    if "eval_env" not in options:
        options["eval_env"] = corridors()
    callback = EvaluationCallback(**{"every": 100, "episodes": 4, "best_model": None, "at_start": False, **options})
    model = model or ppo(env)
    dumps = Dumps()
    model.set_logger(Logger(None, [dumps]))
    model.learn(steps, callback=[callback, *others])
    return callback, dumps, model


@pytest.fixture(scope="module")
def rooms():
    """A model trained in the corridor and evaluated in two furnished rooms."""
    env = AVPVecEnv(agents=4, simulator=Corridor(), settings=ROOM_SETTINGS, seed=0)
    callback, dumps, model = evaluated(
        128, model=ppo(env, n_steps=16), eval_env=None, scenes=ROOMS, episodes=3, deterministic=True
    )
    return callback, dumps, model


def test_the_episodes_are_those_of_evaluate_policy(rooms, tmp_path):
    _, dumps, model = rooms
    path = str(tmp_path / "model.zip")
    model.save(path)
    step, logged = dumps.evaluations()[-1]
    assert step == model.num_timesteps == 128
    expected = {
        room: evaluate_policy(path, room, episodes=3, seed=1000, settings=ROOM_SETTINGS).figures for room in ROOMS
    }
    labels = dict(zip(ROOMS, ("builtin_1", "builtin_2"), strict=True))
    for name in expected[ROOMS[0]]:
        both = np.concatenate([expected[room][name] for room in ROOMS])
        assert logged[f"eval/{name}"] == pytest.approx(both.mean()), name
        for room, label in labels.items():
            assert logged[f"eval/{label}/{name}"] == pytest.approx(expected[room][name].mean()), (room, name)
    coverage, views = (np.concatenate([expected[room][name] for room in ROOMS]) for name in ("coverage", "views"))
    assert logged["eval/cpv"] == pytest.approx(100 * coverage.mean() / views.mean())
    assert len({*coverage}) > 3, "equal episodes would hide a mistake in their order"


@pytest.fixture(scope="module")
def env():
    """Three agents in each room."""
    return AVPVecEnv(ROOMS, agents=6, settings=ROOM_SETTINGS)


def test_each_agent_starts_where_evaluate_policy_does_every_time(rooms, env):
    _, _, model = rooms
    runs = [run_batch(model, env, 3, seed=50, deterministic=True) for _ in range(2)]
    for found in runs:
        assert list(found) == ["builtin_1", "builtin_2"]
        for room, episodes in zip(ROOMS, found.values(), strict=True):
            alone = AVPEnv(room, settings=ROOM_SETTINGS)
            for number, episode in enumerate(episodes):
                alone.reset(seed=50 + number)
                np.testing.assert_allclose(episode.trajectory.start, alone.agent_pose[0])
    np.testing.assert_array_equal(*(found["builtin_1"][2].curve for found in runs))


def test_the_return_is_the_sum_of_the_rewards_and_pictures_show_the_first_start(rooms, env):
    _, dumps, model = rooms
    found = run_batch(model, env, 3, seed=1000, deterministic=True)
    everything = [episode for episodes in found.values() for episode in episodes]
    for episode in everything:
        assert episode.figures["return"] == pytest.approx(episode.trajectory.reward.sum(), rel=1e-5)
    _, values, excluded = [entry for entry in dumps.all if "eval/coverage" in entry[1]][-1]
    assert values["eval/return"] == pytest.approx(means(everything)["return"])
    for agent, (scene, episodes) in enumerate(found.items()):
        picture = values[f"eval/{scene}/trajectory"]
        assert isinstance(picture, Image)
        assert picture.dataformats == "HWC"
        curves = [episode.curve for episode in episodes]
        expected = evaluation_picture(curves, env.get_attr("area", agent)[0], episodes[0].trajectory)
        np.testing.assert_array_equal(picture.image, expected)
        assert set(excluded[f"eval/{scene}/trajectory"]) == {"stdout", "log", "json", "csv"}


@pytest.mark.parametrize("agents", [1, 4])
def test_steps_of_all_agents_count_and_the_end_is_evaluated_once(agents):
    env = DummyVecEnv([SmallEnv] * agents)
    _, dumps, model = evaluated(384, model=ppo(env, n_steps=128 // agents), every=100)
    assert [step for step, _ in dumps.evaluations()] == [100, 200, 300, 384]
    assert model.num_timesteps == 384


def test_the_model_is_evaluated_before_its_first_step_too(tmp_path, monkeypatch):
    client, tracker = MlflowClient(mlflow_home(tmp_path, monkeypatch)), MLflowCallback(log_model=False)
    callback = EvaluationCallback(eval_env=corridors(), every=100, best_model=None)
    ppo().learn(128, callback=[callback, tracker])
    steps = [point.step for point in client.get_metric_history(tracker.run_id, "eval/coverage")]
    assert steps == [0, 100, 128]


def test_an_evaluation_due_in_the_last_rollout_is_left_to_the_end():
    _, dumps, _ = evaluated(200, every=200)
    assert [step for step, _ in dumps.evaluations()] == [256]


def test_a_resumed_training_goes_on_with_the_same_steps():
    model = ppo()
    evaluated(128, model=model, every=1000)
    callback, dumps = EvaluationCallback(eval_env=corridors(), at_start=False, every=100, best_model=None), Dumps()
    model.set_logger(Logger(None, [dumps]))
    model.learn(192, callback=callback, reset_num_timesteps=False)
    assert [step for step, _ in dumps.evaluations()] == [200, 300, 320]


class Weights(BaseCallback):
    """The policy's weights when a training ends."""

    def _on_step(self):
        return True

    def _on_training_end(self):
        self.found = [weights.detach().clone() for weights in self.model.policy.parameters()]


@pytest.mark.parametrize("make", [ppo, lambda: DQN("MlpPolicy", SmallEnv(), learning_starts=20, seed=3, device="cpu")])
@pytest.mark.parametrize("options", [{"deterministic": True}, {}, {"scenes": "builtin:1", "settings": ROOM_SETTINGS}])
def test_training_gives_the_same_weights_with_and_without_it(make, options, tmp_path):
    # Made first: SB3's vector environments draw from NumPy's global numbers when they are made.
    env = None if "scenes" in options else corridors()
    weights = Weights()
    make().learn(256, callback=weights)
    without = weights.found
    others, best = [weights], tmp_path / "best.zip"
    _, dumps, _ = evaluated(model=make(), every=50, eval_env=env, best_model=best, others=others, **options)
    assert len(dumps.evaluations()) >= 4
    for one, other in zip(without, weights.found, strict=True):
        assert torch.equal(one, other)


def numbers():
    return random.random(), np.random.random(), torch.rand(1).item()


def seed_all(seed):
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


class Drawing(VecEnvWrapper):
    """Uses all global random numbers at every step."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        numbers()
        return self.venv.step_wait()


def started(model, **options):
    """A callback at the start of a training, what it dumps, and the model."""
    callback, dumps = EvaluationCallback(**{"best_model": None, **options}), Dumps()
    model.set_logger(Logger(None, [dumps]))
    callback.init_callback(model)
    callback.on_training_start({}, {})
    return callback, dumps


def numbers_of(values):
    return {name: value for name, value in values.items() if isinstance(value, float)}


def test_the_random_numbers_of_python_numpy_and_torch_are_left_alone():
    callback, _ = started(ppo(), eval_env=Drawing(corridors()), deterministic=False)
    seed_all(1)
    expected = numbers()
    seed_all(1)
    callback._evaluate()
    assert numbers() == expected


def test_sampled_evaluations_draw_the_same_numbers_each_time():
    callback, dumps = started(ppo(), eval_env=corridors())
    for seed in (0, 1):
        seed_all(seed)
        callback._evaluate()
    (_, first), (_, second) = dumps.evaluations()
    first.pop("eval/best_return")
    assert numbers_of(first) == numbers_of(second)


def test_the_trainings_environment_is_not_stepped():
    class Counting(SmallEnv):
        steps = 0

        def step(self, action):
            Counting.steps += 1
            return super().step(action)

    evaluated(128, env=Counting(), every=10)
    assert Counting.steps == 128


def test_an_environment_with_fewer_agents_than_episodes_runs_them_one_after_another():
    (episodes,) = run_batch(ppo(), corridors(agents=2), 5, seed=7, deterministic=False).values()
    assert len(episodes) == 5
    # The first agent runs three of them, the second one the other two.
    alone = SmallEnv()
    for first, seed in ((0, 7), (3, 8)):
        alone.reset(seed=seed)
        np.testing.assert_allclose(episodes[first].trajectory.start, alone.agent_pose[0])


def test_pending_values_stay_with_the_training():
    class Pending(BaseCallback):
        def _on_step(self):
            self.logger.record("own/value", self.num_timesteps)
            self.logger.record_mean("own/mean", self.num_timesteps)
            return True

    _, dumps, _ = evaluated(256, every=100, others=[Pending()])
    for step, values, _ in dumps.all:
        if "eval/coverage" in values:
            assert all(name.startswith("eval/") or name == "time/total_timesteps" for name in values)
            assert values["time/total_timesteps"] == step
        elif "own/mean" in values:
            assert values["own/mean"] == np.mean(range(step - 63, step + 1)), "a dump in between would cut the mean"


class Closing(BaseCallback):
    """Like a tracker: takes its format out of the logger when the training ends."""

    def __init__(self):
        super().__init__()
        self.dumps = Dumps()

    def _on_training_start(self):
        self.logger.output_formats.append(self.dumps)

    def _on_step(self):
        return True

    def _on_training_end(self):
        self.logger.output_formats.remove(self.dumps)


def test_figures_pictures_and_the_best_model_reach_mlflow_once(tmp_path, monkeypatch):
    client = MlflowClient(mlflow_home(tmp_path, monkeypatch))
    tracker = MLflowCallback()
    callbacks = [
        tracker,
        MetricsCallback(),
        EvaluationCallback(eval_env=corridors(), at_start=False, every=100, best_model="best.zip"),
    ]
    ppo().learn(192, callback=callbacks)
    run = client.get_run(tracker.run_id)
    assert run.info.status == "FINISHED"
    for name, steps in (("eval/coverage", [100, 192]), ("avp/coverage", [64, 128, 192])):
        assert [point.step for point in client.get_metric_history(tracker.run_id, name)] == steps
    kept = client.download_artifacts(tracker.run_id, "best_model.zip", str(tmp_path))
    assert PPO.load(kept, device="cpu").avp_best["value"] == run.data.metrics["eval/best_return"]
    pictures = [file.path for file in client.list_artifacts(tracker.run_id, "images") if file.path.endswith("png")]
    assert len([path for path in pictures if "trajectory" in path]) == 2


def test_every_format_of_the_logger_takes_an_evaluation(tmp_path):
    model = ppo()
    model.set_logger(configure(str(tmp_path), ["stdout", "log", "csv", "json", "tensorboard"]))
    model.learn(
        192,
        callback=EvaluationCallback(eval_env=corridors(), at_start=False, every=100, best_model=tmp_path / "best.zip"),
    )
    rows = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    coverage = {row["time/total_timesteps"]: row["eval/coverage"] for row in rows if "eval/coverage" in row}
    assert list(coverage) == [100, 192]
    with (tmp_path / "progress.csv").open() as file:
        table = [row for row in csv.DictReader(file) if row["eval/coverage"]]
    assert {int(row["time/total_timesteps"]): float(row["eval/coverage"]) for row in table} == coverage
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [(event.step, event.value) for event in events.Scalars("eval/coverage")] == [
        (step, pytest.approx(value)) for step, value in coverage.items()
    ]
    assert [event.step for event in events.Images("eval/corridor/trajectory")] == [100, 192]


@pytest.mark.parametrize("progress_bar", [False, True])
def test_the_last_evaluation_reaches_trackers_that_stand_before_it_in_the_list(progress_bar):
    tracker = Closing()
    callbacks = [tracker, EvaluationCallback(eval_env=corridors(), at_start=False, every=100, best_model=None)]
    ppo().learn(128, callback=callbacks, progress_bar=progress_bar)
    assert [step for step, _ in tracker.dumps.evaluations()] == [100, 128]
    assert callbacks[0] is tracker


def test_an_interrupted_training_is_not_evaluated_when_rl_zoo3_cleans_up():
    class Interrupting(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 150:
                raise KeyboardInterrupt
            return True

    model, dumps = ppo(), Dumps()
    model.set_logger(Logger(None, [dumps]))
    callbacks = [EvaluationCallback(eval_env=corridors(), at_start=False, every=100, best_model=None), Interrupting()]
    try:
        model.learn(256, callback=callbacks)
    except KeyboardInterrupt:
        pass
    finally:
        callbacks[0].on_training_end()
    assert [step for step, _ in dumps.evaluations()] == [100]


def normalised(env):
    return VecNormalize(VecMonitor(env), norm_reward=True, clip_obs=3.0)


def test_normalised_training_is_evaluated_with_its_own_statistics_untrained():
    seen = []

    class Looking(PPO):
        def predict(self, observation, *arguments, **options):
            seen.append(observation)
            return super().predict(observation, *arguments, **options)

    env = normalised(DummyVecEnv([SmallEnv] * 2))
    model = Looking("MlpPolicy", env, n_steps=32, batch_size=64, n_epochs=1, seed=3, device="cpu")
    plain = corridors()
    evaluated(64, model=model, eval_env=plain, every=1000)
    statistics = env.obs_rms.mean.copy()
    plain.seed(1000)
    np.testing.assert_allclose(seen[0], env.normalize_obs(plain.reset()))

    other = normalised(corridors())
    before = other.training
    evaluated(64, model=model, eval_env=other, every=1000)
    assert other.training is before
    np.testing.assert_allclose(other.obs_rms.mean, env.obs_rms.mean)
    assert not np.allclose(statistics, env.obs_rms.mean), "the training itself goes on learning them"


def test_both_ways_of_normalising_give_the_same_figures():
    env = normalised(DummyVecEnv([SmallEnv] * 2))
    model = ppo(env, n_steps=32)
    model.learn(64)
    found = []
    for other in (corridors(), normalised(corridors())):
        callback, dumps = started(model, eval_env=other)
        callback._evaluate()
        found.append(numbers_of(dumps.evaluations()[0][1]))
    assert found[0] == pytest.approx(found[1])


@pytest.mark.slow
def test_environments_in_processes_of_their_own_can_be_evaluated():
    env = SubprocVecEnv([SmallEnv] * 2, start_method="forkserver")
    try:
        _, dumps, _ = evaluated(64, eval_env=env, every=1000, deterministic=True)
        _, here, _ = evaluated(64, eval_env=DummyVecEnv([SmallEnv] * 2), every=1000, deterministic=True)
    finally:
        env.close()
    assert numbers_of(dumps.evaluations()[0][1]) == pytest.approx(numbers_of(here.evaluations()[0][1]))


class Plain(gymnasium.Wrapper):
    """An environment of somebody else: figures in `info`, no scene, no settings, no trajectory."""

    def __init__(self, without=()):
        super().__init__(SmallEnv())
        self.without = set(without)

    def get_wrapper_attr(self, name):
        if name == "render_mode":
            return None
        raise AttributeError(name)

    def step(self, action):
        *rest, info = self.env.step(action)
        episode = {key: value for key, value in info.get("avp_episode", {}).items() if key not in self.without}
        kept = {"coverage": info["coverage"]} | ({"avp_episode": episode} if episode else {})
        return *rest, {key: value for key, value in kept.items() if key not in self.without}


def plain(without=()):
    return DummyVecEnv([lambda: Plain(without)] * 2)


def test_another_environment_needs_only_the_episodes_figures():
    _, dumps, _ = evaluated(64, eval_env=plain(without=["coverage_of_steps"]))
    values = dumps.evaluations()[0][1]
    assert {"eval/coverage", "eval/cpv", "eval/return", "eval/env/trajectory"} <= values.keys()
    assert "eval/coverage_area" not in values


@pytest.mark.parametrize("key", ["views", "avp_episode"])
def test_a_missing_key_is_named(key):
    with pytest.raises(MissingInfoError, match=f"EvaluationCallback: expected '{key}' in info"):
        evaluated(64, eval_env=plain(without=[key]))


def test_a_score_that_the_environment_cannot_give_is_named():
    with pytest.raises(MissingInfoError, match=r"score 'coverage_area': .* gives only annd_m, collisions, coverage"):
        evaluated(64, eval_env=plain(), score="coverage_area")


def test_scenes_of_the_same_name_are_told_apart():
    told = {"scene_name": ["a room.glb", "a room.glb", "b/c.glb", "a room.glb"], "scene_digest": list("1231")}

    class Named(DummyVecEnv):
        def get_attr(self, name, indices=None):
            return told[name] if name in told else super().get_attr(name, indices)

    assert scenes_of(Named([SmallEnv] * 4)) == {"a_room.glb": [0, 3], "a_room.glb-2": [1], "b_c.glb": [2]}


def test_long_names_of_scenes_do_not_break_the_screen(capsys):
    class Long(VecEnvWrapper):
        def reset(self):
            return self.venv.reset()

        def step_wait(self):
            return self.venv.step_wait()

        def get_attr(self, name, indices=None):
            if name == "scene_name":
                return [f"a_very_long_name_of_a_scanned_apartment_{agent % 2}.glb" for agent in range(self.num_envs)]
            return self.venv.get_attr(name, indices)

    model = ppo(verbose=1)
    env = Long(corridors())
    model.learn(64, callback=EvaluationCallback(eval_env=env, best_model=None))
    assert "coverage_area" in capsys.readouterr().out


def test_curves_are_drawn_from_nothing_to_the_last_view():
    picture = draw_curves([np.array([0.0, 0.5, 1.0]), np.array([0.0, 0.5])])
    assert picture.dtype == np.uint8
    assert picture.shape == (320, 420, 3)
    red = np.argwhere((picture == (178, 34, 52)).all(axis=-1))
    # The mean ends in the upper right corner of the axes: 100 % after three views.
    assert red[:, 1].max() == pytest.approx(420 - 14, abs=3)
    assert red[:, 0].min() == pytest.approx(30, abs=3)


def test_the_picture_has_the_map_beside_the_curve():
    env = corridors(agents=1)
    ((episode,),) = run_batch(ppo(), env, 1, seed=3, deterministic=False).values()
    area = env.get_attr("area", 0)[0]
    both = evaluation_picture([episode.curve], area, episode.trajectory)
    whole = draw_trajectory(area, episode.trajectory, longest_px=420)
    np.testing.assert_array_equal(both[:, : whole.shape[1]], whole)
    assert both.shape[1] > whole.shape[1] + 200
    np.testing.assert_array_equal(evaluation_picture([episode.curve]), draw_curves([episode.curve]))


def test_the_best_model_is_the_one_with_the_greatest_score(tmp_path):
    path = tmp_path / "runs" / "best.zip"
    callback, dumps, _ = evaluated(640, best_model=path, score="coverage_area", every=64)
    scores = [(step, values["eval/coverage_area"]) for step, values in dumps.evaluations()]
    best_step, best = max(scores, key=lambda entry: (entry[1], -entry[0]))
    kept = PPO.load(path, device="cpu")
    assert kept.num_timesteps == best_step
    assert callback.best == best
    assert callback.best_model == path
    record = -np.inf
    for _, values in dumps.evaluations():
        better = values["eval/coverage_area"] > record
        record = max(record, values["eval/coverage_area"])
        assert values.get("eval/best_coverage_area") == (record if better else None)
        assert values.get("eval/best_model") == (LoggedFile(path, "best_model.zip") if better else None)
    assert len(scores) == 10
    assert [file.name for file in path.parent.iterdir()] == ["best.zip"], "nothing half-written is left"


def offered(best, model, *values):
    return [best.offer(model, value) for value in values]


def test_the_least_is_best_where_less_is_better_and_nan_is_never_better():
    model = ppo()
    for score, expected in (("views", [True, False, False, True]), ("coverage", [True, False, True, False])):
        best = BestModel(None, score)
        best.start(model)
        assert offered(best, model, 5.0, float("nan"), 6.0, 4.0) == expected


def test_a_default_name_says_when_and_never_meets_another(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    paths = []
    for _ in range(2):
        callback, _, _ = evaluated(64, best_model="runs/best-DATE-TIME.zip")
        paths.append(callback.best_model)
    assert all(path.is_file() for path in paths)
    assert paths[0] != paths[1]
    assert paths[0].name.startswith("best-20")


def test_a_foreign_best_model_is_refused_before_the_training_and_left_as_it_is(tmp_path):
    path = tmp_path / "best.zip"
    ppo().save(path)
    before = path.read_bytes()
    model = ppo()
    with pytest.raises(UsageError, match=r"best_model .*best\.zip: exists already and is not of this training"):
        evaluated(64, model=model, best_model=path)
    assert model.num_timesteps == 0
    assert path.read_bytes() == before
    path.write_text("mine")
    with pytest.raises(UsageError, match="exists already"):
        evaluated(64, best_model=path)
    assert path.read_text() == "mine"


def test_a_resumed_training_goes_on_with_its_own_best_model(tmp_path):
    path, last = tmp_path / "best.zip", tmp_path / "last.zip"
    _, _, model = evaluated(64, best_model=path)
    with zipfile.ZipFile(path) as archive:
        value = json.loads(archive.read("data"))["avp_best"]["value"]
    model.save(last)
    resumed = PPO.load(last, env=SmallEnv(), device="cpu")
    best = BestModel(path, "return")
    best.start(resumed)
    assert best.value == value
    assert not best.offer(resumed, value)
    assert best.offer(resumed, value + 1)
    with pytest.raises(UsageError, match="holds this training's best by 'return', asked for is 'coverage'"):
        BestModel(path, "coverage").start(resumed)


def test_statistics_of_a_normalised_training_are_kept_beside_the_model(tmp_path):
    path = tmp_path / "best.zip"
    env = normalised(DummyVecEnv([SmallEnv] * 2))
    _, dumps, _ = evaluated(64, model=ppo(env, n_steps=32), best_model=path)
    kept = VecNormalize.load(str(tmp_path / "best_vecnormalize.pkl"), DummyVecEnv([SmallEnv]))
    np.testing.assert_array_equal(kept.obs_rms.mean, env.obs_rms.mean)
    names = {value.name for value in dumps.evaluations()[0][1].values() if isinstance(value, LoggedFile)}
    assert names == {"best_model.zip", "best_model_vecnormalize.pkl"}
    path.unlink()
    with pytest.raises(UsageError, match=r"best_vecnormalize\.pkl: exists already"):
        BestModel(path, "return").start(ppo(env, n_steps=32))


def test_a_folder_that_cannot_be_written_is_named_before_the_training(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(BestModelError, match=r"best_model .*file/best\.zip: cannot write there"):
        evaluated(64, best_model=tmp_path / "file" / "best.zip")


def test_a_best_model_that_cannot_be_written_is_a_warning_and_the_training_goes_on(tmp_path):
    folder = tmp_path / "gone"
    best, model = BestModel(folder / "best.zip", "return"), ppo()
    best.start(model)
    folder.write_text("a file in its place")
    with pytest.warns(UserWarning, match=r"best_model .*best\.zip: not written"):
        assert not best.offer(model, 1.0)
    assert best.value is None


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"every": 0}, UsageError, "EvaluationCallback every: expected at least 1, got 0"),
        ({"episodes": 0}, UsageError, "EvaluationCallback episodes: expected at least 1, got 0"),
        ({"score": "coverag"}, UsageError, "unknown score 'coverag': .* did you mean 'coverage'?"),
        ({"scenes": (), "settings": ROOM_SETTINGS}, UsageError, "scene: expected at least one, got none"),
        ({"scenes": "nowhere.glb", "settings": ROOM_SETTINGS}, SceneError, r"nowhere\.glb"),
        ({"scenes": "builtin:x", "settings": ROOM_SETTINGS}, UsageError, "builtin:x"),
    ],
)
def test_bad_options_are_refused_before_the_training(options, error, text):
    model = ppo()
    with pytest.raises(error, match=text):
        evaluated(64, model=model, eval_env=None, **options)
    assert model.num_timesteps == 0


def test_scenes_and_an_environment_together_are_refused():
    with pytest.raises(UsageError, match="expected scenes or eval_env, got both"):
        EvaluationCallback("builtin:1", eval_env=corridors())
    with pytest.raises(UsageError, match="expected settings or eval_env, got both"):
        EvaluationCallback(eval_env=corridors(), settings=SETTINGS)


def test_an_environment_that_does_not_fit_is_refused_with_both_spaces():
    with pytest.raises(UsageError, match=r"observation_space of the policy, Box\(.*\(12,\).* has Box\(.*\(\d{3,},\)"):
        evaluated(64, eval_env=corridors(observation="map"))
    stacked = ppo(VecFrameStack(DummyVecEnv([SmallEnv]), 2))
    with pytest.raises(UsageError, match=r"\(24,\).* has Box\(.*\(12,\).*wrap an eval_env"):
        evaluated(64, model=stacked)
    with pytest.raises(UsageError, match="VecNormalize, but the training's environment is not"):
        evaluated(64, eval_env=normalised(corridors()))


def test_the_trainings_own_environment_is_refused():
    env = DummyVecEnv([SmallEnv] * 2)
    with pytest.raises(UsageError, match="is the training's own environment"):
        evaluated(64, model=ppo(VecMonitor(env), n_steps=32), eval_env=env)


def test_a_training_without_settings_needs_its_own_environment_for_the_evaluation():
    with pytest.raises(UsageError, match=r"has no settings of AVP-v0; .* eval_env"):
        evaluated(64, model=ppo(plain(), n_steps=32), eval_env=None)


def test_settings_are_those_of_the_training_unless_given():
    env = DummyVecEnv([lambda: SmallEnv(budget=5)])
    for settings, budget in ((None, 5), (replace(SETTINGS, budget=3), 3)):
        callback, _, _ = evaluated(64, model=ppo(env), eval_env=None, scenes="builtin:1", settings=settings, episodes=1)
        assert callback._env.settings.budget == budget


def test_importing_the_callback_imports_no_tracker():
    code = "import sys, avp_sb3; avp_sb3.EvaluationCallback; print(sorted({'mlflow', 'rerun'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_names_by_scene_are_kept_apart_from_the_means():
    found = defaultdict(int)
    _, dumps, _ = evaluated(64)
    for name in dumps.evaluations()[0][1]:
        found[name.count("/")] += 1
    assert found[2] == 1, "one scene needs no figures of its own, only its picture"


@pytest.mark.slow
def test_a_training_killed_while_it_saves_leaves_no_half_written_best_model(tmp_path):
    code = (
        "import sys, time; from pathlib import Path; sys.path.insert(0, sys.argv[2])\n"
        "from tracking import ppo; from avp_sb3.callbacks.best_model import BestModel\n"
        "best, model, value = BestModel(Path(sys.argv[1]), 'return'), ppo(), 0.0\n"
        "best.start(model)\n"
        "while True:\n    value += 1\n    best.offer(model, value)\n    print(value, flush=True)\n"
    )
    path = tmp_path / "best.zip"
    line = [sys.executable, "-c", code, str(path), str(Path(__file__).parent)]
    process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "1.0\n"
    time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert PPO.load(path, device="cpu").avp_best["value"] >= 1.0
