import json
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from corridor import Corridor
from stable_baselines3 import DQN, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecMonitor, VecNormalize
from tracking import SETTINGS, SmallEnv, ppo

from avp_sb3 import AVPVecEnv, MetricsCallback
from avp_sb3.callbacks.base import MissingInfoError, record
from avp_sb3.callbacks.metrics import EpisodeWindow

EPISODE = {
    "coverage": 0.5, "views": 10.0, "annd_m": 0.2, "ei": 0.05, "stopped": 1.0, "collisions": 2.0,
    "redundant_views": 3.0, "return_coverage": 4.0,
}  # fmt: skip


class Notes(BaseCallback):
    """What the environment reported, and what the logger held at each end of a rollout."""

    def __init__(self):
        super().__init__()
        self.episodes, self.held = [], []

    def _on_step(self):
        self.episodes += [info["avp_episode"] for info in self.locals["infos"] if "avp_episode" in info]
        return True

    def _on_rollout_end(self):
        self.held.append(dict(self.logger.name_to_value))


def test_recorded_values_are_the_means_of_the_last_episodes():
    notes = Notes()
    ppo(DummyVecEnv([SmallEnv] * 3)).learn(384, callback=[MetricsCallback(window=10), notes])
    last, held = notes.episodes[-10:], notes.held[-1]
    assert len(notes.episodes) > 20
    mean = {key: np.mean([episode[key] for episode in last]) for key in last[0]}
    assert held["avp/coverage"] == pytest.approx(mean["coverage"])
    assert held["avp/cpv"] == pytest.approx(100 * mean["coverage"] / mean["views"])
    assert held["avp/annd_m"] == pytest.approx(mean["annd_m"])
    assert held["avp/ei"] == pytest.approx(mean["ei"])
    assert held["avp/views"] == pytest.approx(mean["views"])
    assert held["avp/stop_share"] == pytest.approx(mean["stopped"])
    assert held["avp/collisions"] == pytest.approx(mean["collisions"])
    assert held["avp/redundant_views"] == pytest.approx(mean["redundant_views"])
    assert held["reward/coverage"] == pytest.approx(mean["return_coverage"])
    assert held["reward/step"] == pytest.approx(mean["return_step"])


def test_a_rollout_without_a_finished_episode_records_nothing_before_the_first_and_the_window_after_it():
    notes = Notes()
    ppo(SmallEnv(budget=100, reward="coverage")).learn(256, callback=[MetricsCallback(), notes])
    assert "avp/coverage" not in notes.held[0]
    assert notes.held[2]["avp/coverage"] == notes.held[1]["avp/coverage"] == notes.episodes[0]["coverage"]


def test_window_forgets_the_oldest_episode():
    window = EpisodeWindow(2)
    for coverage in (0.0, 0.4, 0.8):
        window.add(EPISODE | {"coverage": coverage})
    assert window.means()["avp/coverage"] == pytest.approx(0.6)
    assert window.means()["avp/cpv"] == pytest.approx(100 * 0.6 / 10)


def test_a_hundred_episodes_are_averaged_by_default():
    window = MetricsCallback()._window
    for coverage in range(150):
        window.add(EPISODE | {"coverage": coverage})
    assert window.means()["avp/coverage"] == pytest.approx(np.mean(range(50, 150)))


def test_window_of_one_holds_the_newest_episode():
    window = EpisodeWindow(1)
    window.add(EPISODE)
    window.add(EPISODE | {"return_coverage": 7.0})
    assert window.means()["reward/coverage"] == 7.0


def test_empty_window_has_no_means():
    assert EpisodeWindow(5).means() == {}


def test_window_below_one_is_refused():
    with pytest.raises(ValueError, match="at least 1 episode, got 0"):
        MetricsCallback(window=0)


def test_cpv_is_the_ratio_of_means_not_the_mean_of_ratios():
    window = EpisodeWindow(2)
    window.add(EPISODE | {"coverage": 1.0, "views": 10.0})
    window.add(EPISODE | {"coverage": 0.1, "views": 90.0})
    assert window.means()["avp/cpv"] == pytest.approx(1.1)


def test_an_episode_that_does_not_know_a_figure_does_not_count_for_it():
    window = EpisodeWindow(4)
    for coverage, spread in ((0.2, np.nan), (0.4, 3.0), (0.6, 5.0)):
        window.add(EPISODE | {"coverage": coverage, "annd_m": spread, "return_coverage": np.nan})
    found = window.means()
    assert found["avp/annd_m"] == 4.0
    assert found["avp/coverage"] == pytest.approx(0.4)
    assert found["avp/cpv"] == pytest.approx(100 * 0.4 / 10)
    assert "reward/coverage" not in found
    window.add(EPISODE | {"coverage": np.nan})
    assert window.means()["avp/coverage"] == pytest.approx(0.4)


def test_continued_training_keeps_the_window_and_a_new_one_clears_it():
    model, callback = ppo(SmallEnv()), MetricsCallback()
    model.learn(64, callback=callback)
    first = callback._window
    model.learn(64, callback=callback, reset_num_timesteps=False)
    assert callback._window is first
    model.learn(64, callback=callback)
    assert callback._window is not first


def test_an_environment_without_the_figures_is_named_with_the_one_to_use():
    with pytest.raises(MissingInfoError, match=r"MetricsCallback: expected 'avp_episode' in info .*train on AVP-v0"):
        ppo(gymnasium.make("CartPole-v1")).learn(256, callback=MetricsCallback())


@pytest.mark.parametrize("key", ["coverage", "views"])
def test_a_missing_figure_is_named(key):
    episode = {name: value for name, value in EPISODE.items() if name != key}
    with pytest.raises(MissingInfoError, match=rf"expected '{key}' in info\['avp_episode'\]"):
        EpisodeWindow(3).add(episode)


class Other(gymnasium.Wrapper):
    """An environment of somebody else that reports the figures and nothing else of ours."""

    def step(self, action):
        *rest, info = self.env.step(action)
        return *rest, {key: value for key, value in info.items() if key == "avp_episode"}


def others(count=2):
    return [lambda: Other(SmallEnv())] * count


@pytest.mark.parametrize(
    "wrapped",
    [
        lambda: DummyVecEnv(others()),
        lambda: VecMonitor(DummyVecEnv(others())),
        lambda: VecNormalize(VecMonitor(DummyVecEnv(others()))),
        lambda: VecFrameStack(DummyVecEnv(others()), 2),
        lambda: VecMonitor(AVPVecEnv(agents=2, simulator=Corridor(), settings=SETTINGS)),
        pytest.param(lambda: SubprocVecEnv(others(), start_method="forkserver"), marks=pytest.mark.slow),
    ],
    ids=["dummy", "monitor", "normalize", "stack", "batch", "processes"],
)
def test_figures_come_through_every_vector_environment_and_wrapper(wrapped):
    env, notes = wrapped(), Notes()
    try:
        ppo(env, n_steps=32).learn(64, callback=[MetricsCallback(), notes])
    finally:
        env.close()
    assert len(notes.episodes) >= 2 * 2
    assert notes.held[-1]["avp/coverage"] == pytest.approx(np.mean([each["coverage"] for each in notes.episodes]))


@pytest.mark.parametrize("make", [DQN, SAC])
def test_off_policy_algorithms_have_the_figures_too(make):
    class Continuous(gymnasium.ActionWrapper):
        action_space = gymnasium.spaces.Box(-1, 1, (1,))

        def action(self, action):
            return int((action[0] + 1) * 2.99)

    env = Other(SmallEnv()) if make is DQN else Continuous(Other(SmallEnv()))
    notes, dumps = Notes(), []
    model = make("MlpPolicy", env, learning_starts=1000, seed=3, device="cpu")
    model.set_logger(Logger(None, []))
    model.logger.dump = lambda step=0: dumps.append(dict(model.logger.name_to_value))
    model.learn(40, callback=[MetricsCallback(), notes])
    # They log after every fourth episode.
    assert len(dumps) == 1
    assert dumps[0]["avp/coverage"] == pytest.approx(np.mean([each["coverage"] for each in notes.episodes[:4]]))


def test_figures_and_reward_parts_of_any_name_are_recorded():
    window = EpisodeWindow(3)
    window.add(EPISODE)
    mine = {"sofas seen": 3.0, "return_sofa/blue": 5.0}
    window.add({name: value for name, value in EPISODE.items() if name != "return_coverage"} | mine)
    found = window.means()
    assert found["avp/sofas seen"] == 3.0, "the first episode did not know it"
    # A part that an episode does not have gave it nothing.
    assert (found["reward/sofa/blue"], found["reward/coverage"]) == (2.5, 2.0)


def test_names_that_the_screen_would_cut_to_the_same_reach_the_other_formats(tmp_path, capsys):
    logger = configure(str(tmp_path), ["stdout", "json"])
    for place, name in enumerate(("kitchen", "bath")):
        record(logger, f"reward/a_part_of_the_reward_with_a_long_name_in_the_{name}", place)
    record(logger, "reward/short", 2)
    logger.dump()
    assert set(json.loads((tmp_path / "progress.json").read_text()).values()) == {0, 1, 2}
    assert "long_name" not in capsys.readouterr().out


def test_importing_the_package_imports_no_host():
    code = "import sys, avp_sb3; print(sorted({'torch', 'mlflow', 'rerun', 'stable_baselines3'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_an_unknown_name_of_the_package_is_an_attribute_error():
    import avp_sb3

    with pytest.raises(AttributeError, match="no attribute 'WandbCallback'"):
        avp_sb3.WandbCallback  # noqa: B018
