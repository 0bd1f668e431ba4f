import copy

import numpy as np
import pytest
import torch
from corridor import Corridor
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.vec_env import VecMonitor
from tracking import SmallEnv, ppo

from avp_habitat.task.settings import STOP, TaskSettings
from avp_sb3 import AVPVecEnv, StopCallback
from avp_sb3.callbacks.base import MissingInfoError
from avp_sb3.callbacks.stopping import advantage_of_stop, fit_stop, lost_by_stops

BUDGET, AGENTS = 12, 8


@pytest.fixture(scope="module")
def trained():
    settings = TaskSettings(reward="surface", budget=BUDGET, width=16, height=12)
    env = VecMonitor(AVPVecEnv(agents=AGENTS, simulator=Corridor(), settings=settings, seed=0))
    model = PPO("MlpPolicy", env, n_steps=BUDGET, batch_size=48, n_epochs=1, device="cpu", seed=0)
    callback, lengths = StopCallback(episodes=8), []
    model.learn(4 * BUDGET * AGENTS, callback=[callback, ConvertCallback(lambda found, _: note(lengths, found))])
    return model, callback.fit, lengths


def note(lengths, found):
    lengths += [info["episode"]["l"] for info in found["infos"] if "episode" in info]
    return True


def test_no_episode_ends_by_stop_before_it_is_fitted_and_most_do_afterwards(trained):
    model, fit, lengths = trained
    assert set(lengths) == {BUDGET}
    assert fit.episodes == 8 * AGENTS
    assert fit.share > 0.8
    env, stopped = model.get_env(), []
    observation = env.reset()
    for _ in range(3 * BUDGET):
        observation, _, _, infos = env.step(model.predict(observation, deterministic=True)[0])
        stopped += [info["avp_episode"]["stopped"] for info in infos if "avp_episode" in info]
    assert np.mean(stopped) > 0.8
    assert f"ends {fit.share:.0%} of them" in str(fit)


def test_the_other_actions_stay_about_as_likely_among_each_other(trained):
    model, _, _ = trained
    again, others = copy.deepcopy(model.policy.state_dict()), [number for number in range(6) if number != STOP]
    observation = model.policy.obs_to_tensor(model.get_env().reset())[0]

    def among_others(policy):
        with torch.no_grad():
            return policy.get_distribution(observation).distribution.logits[:, others].softmax(dim=1)

    before = among_others(model.policy)
    fit_stop(model, model.get_env(), episodes=1)
    assert (among_others(model.policy) - before).abs().max() < 0.1
    model.policy.load_state_dict(again)


def test_the_advantage_of_a_stop_is_that_over_all_later_ones_and_over_none():
    rng = np.random.default_rng(3)
    reward, pays = rng.normal(size=(2, 9, 3)), rng.uniform(0, 2, (2, 9, 3))
    found = advantage_of_stop(reward, pays)
    for e, t, n in np.ndindex(found.shape):
        # What a stop in step t brings: the steps before it, and what was to be had after the last of them.
        stops = [reward[e, :s, n].sum() + (pays[e, s - 1, n] if s else 0) for s in range(9)]
        assert found[e, t, n] == pytest.approx(stops[t] - max([*stops[t + 1 :], reward[e, :, n].sum()]))


def test_what_stops_lose_is_that_of_the_first_of_them_or_of_none():
    better = np.array([[-3.0, -1.0, 0.5, 2.0]]).reshape(1, 4, 1)

    def lost(*stops):
        return lost_by_stops(np.isin(np.arange(4), stops).reshape(1, 4, 1), better)

    assert [lost(0), lost(1, 2), lost(2), lost(3), lost()] == [3.0, 1.0, 0.0, 0.0, 2.0]


def test_environments_that_do_not_say_what_a_stop_pays_are_refused():
    with pytest.raises(MissingInfoError, match="StopCallback"):
        ppo(SmallEnv(), n_steps=32).learn(32, callback=StopCallback())
