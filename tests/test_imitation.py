"""Beginning a training by imitation: what is watched, what is learned from it, and the command."""

import numpy as np
import pytest
from stable_baselines3 import PPO

from avp_habitat import command
from avp_habitat.errors import UsageError
from avp_habitat.policies.registry import make_policy_env, steps_of
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.settings import TURN_LEFT, TaskSettings
from avp_sb3 import train
from avp_sb3.imitation import demonstrate, imitate
from avp_sb3.presets import ONBOARD
from avp_sb3.vec_env.batched import AVPVecEnv

SETTINGS = TaskSettings(reward="multiview", observation="onboard", budget=10, width=16, height=12)
SCENES = ("builtin:3", "builtin:4")


@pytest.fixture(scope="module")
def shown():
    return demonstrate("spin", SCENES, SETTINGS, episodes=8, gamma=0.9, seed=5)


def test_it_watches_whole_episodes_of_the_policy_in_all_scenes(shown):
    assert shown.episode.tolist() == np.repeat(np.arange(8), 10).tolist()
    assert shown.observation.shape == (80, 1120)
    simulator = open_simulator(SimulatorChoice(), SCENES[1])
    env, policy = make_policy_env("spin", simulator, SETTINGS, seed=5 + 2, observation="onboard")
    steps = list(steps_of(env, policy, seed=5 + 2))
    third = shown.episode == 2
    assert shown.action[third].tolist() == [step.action for step in steps]
    rewards = [step.reward for step in steps]
    expected = [sum(0.9**k * reward for k, reward in enumerate(rewards[start:])) for start in range(10)]
    assert shown.returned[third] == pytest.approx(expected, rel=1e-4)


def test_it_learns_to_do_what_was_shown(shown):
    env = AVPVecEnv(SCENES[0], agents=2, settings=SETTINGS)
    model = PPO("MlpPolicy", env, device="cpu", seed=0, **ONBOARD.arguments())
    before = {name: each.clone() for name, each in model.policy.state_dict().items()}
    fit = imitate(model, shown)
    assert fit.episodes == 8
    # It turns and turns, and sometimes walks.
    assert fit.agreement > 0.8
    action, _ = model.predict(shown.observation[shown.episode == 0], deterministic=True)
    assert (action == TURN_LEFT).mean() > 0.8
    assert any((before[name] != each).any() for name, each in model.policy.state_dict().items())


def test_too_few_episodes_and_other_observations_are_refused():
    with pytest.raises(UsageError, match="demonstrations: expected at least 8 episodes, got 2"):
        demonstrate("spin", SCENES, SETTINGS, episodes=2, gamma=0.9)
    with pytest.raises(UsageError, match="unknown policy 'spim'"):
        demonstrate("spim", SCENES, SETTINGS, episodes=8, gamma=0.9)


def test_a_training_can_begin_by_imitation(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/mlflow.db")
    words = ["--scene", "builtin:3", "--reward", "multiview", "--observation", "onboard", "--steps", "8192"]
    words += ["--width", "16", "--height", "12", "--rays", "--imitate", "spin", "--demonstrations", "8"]
    assert command.run(train.main, [*words, "--out", "m.zip"]) == 0
    assert "imitation: learned from 8 episodes: does the same in" in capsys.readouterr().out
    assert (tmp_path / "m.zip").is_file()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--imitate", "survey-multiviev"], "did you mean 'survey-multiview'"),
        (["--imitate", "spin", "--start", "pretrained"], "imitate: expected no --start or --resume beside it"),
        (["--imitate", "spin", "--demonstrations", "3"], "demonstrations"),
    ],
)
def test_wrong_options_are_one_line(words, said, capsys):
    assert command.run(train.main, words) == 2
    assert said in capsys.readouterr().err
