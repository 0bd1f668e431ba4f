"""Teach the action stop once the others are learned: from episodes that went on, the best time to stop is known."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from avp_habitat.task.settings import ACTION_NAMES, STOP
from avp_sb3.callbacks.base import MissingInfoError, settings_of

_NEVER = -20.0
_OTHERS = [number for number in range(len(ACTION_NAMES)) if number != STOP]
_ROUNDS, _BATCH, _RATE, _RATE_OF_LAST = 800, 1024, 3e-3, 9e-3
_KEPT = 3.0
"""Weight of what keeps the other actions as they were."""
_HELD_OUT = 4
"""The episodes of every so many-th agent are not learned from, but tell by how much to shift the logit in the end."""
_SHIFTS = np.arange(0.0, 4.1, 0.5)


@dataclass(frozen=True)
class StopFit:
    """How the fitted stop does in the episodes from which it was learned."""

    episodes: int
    """Number of them."""
    share: float
    """Of those that it ends, within [0, 1]."""
    views: float
    """Mean number of views until it does, or the budget ends."""

    def __str__(self) -> str:
        """For the screen."""
        return f"learned from {self.episodes} episodes: ends {self.share:.0%} of them, after {self.views:.1f} views"


class StopCallback(BaseCallback):
    """No episode ends by stop while a policy trains; when the training ends, its feed-forward actor learns to stop.

    Where stop ends an episode at any time, most stops come too early at first, and PPO learns never to stop before it
    could find out that a late one pays. A training that is interrupted has no stop.
    """

    def __init__(self, episodes: int = 3) -> None:
        """Fit from so many episodes of each agent, which go on to the end of their budget."""
        super().__init__()
        self._episodes = episodes
        self.fit: StopFit | None = None
        """Once the training has ended."""

    def _on_training_start(self) -> None:
        layer: Any = self.model.policy.action_net
        with torch.no_grad():
            layer.weight[STOP], layer.bias[STOP] = 0.0, _NEVER

    def _on_step(self) -> bool:
        _pays(self.locals["infos"][:1])  # now rather than after a whole training
        return True

    def _on_training_end(self) -> None:
        self.fit = fit_stop(self.model, self.training_env, episodes=self._episodes)


def fit_stop(model: Any, env: VecEnv, *, episodes: int) -> StopFit:
    """Let an actor learn when stopping pays most, from episodes of the other actions' likeliest.

    The cross-entropy of its probability of stop with "no later stop pays more" is minimised, each step weighted by how
    much is lost by the wrong choice, and with it the divergence of the other actions' probabilities among each other
    from what they were. Then the logit is raised by what loses least in other episodes, for no stop at all costs more
    than one a little early. What the picture of the stop itself costs is left out.

    Raises:
        MissingInfoError: the environments do not say what a stop pays.
    """
    settings = settings_of(env)
    if settings is None:
        raise MissingInfoError("StopCallback: expected environments of the suite")
    seen, others, reward, pays = [], [], [], []
    observation = env.reset()
    for _ in range(episodes * settings.budget):
        seen.append(model.policy.obs_to_tensor(observation)[0])
        with torch.no_grad():
            others.append(_logits(model.policy, seen[-1])[:, _OTHERS])
        observation, _, _, infos = env.step(others[-1].argmax(dim=1).cpu().numpy())
        reward.append([sum(info["reward_parts"].values()) for info in infos])
        pays.append(_pays(infos))
    better = advantage_of_stop(*(np.reshape(each, (episodes, settings.budget, -1)) for each in (reward, pays)))
    chosen = np.broadcast_to(np.arange(better.shape[2]) % _HELD_OUT != _HELD_OUT - 1, better.shape).reshape(-1)
    told = torch.cat(seen), torch.cat(others), torch.from_numpy(better.reshape(-1)).to(others[0])
    _learn(model.policy, *(each[chosen] for each in told))
    with torch.no_grad():
        logits = torch.cat([_logits(model.policy, each) for each in seen])
        margin = (logits[:, STOP] - logits[:, _OTHERS].amax(dim=1)).cpu().numpy().reshape(better.shape)
        held_out = slice(_HELD_OUT - 1, None, _HELD_OUT) if better.shape[2] >= _HELD_OUT else slice(None)
        lost = [lost_by_stops(margin[..., held_out] > -shift, better[..., held_out]) for shift in _SHIFTS]
        shift = float(_SHIFTS[int(np.argmin(lost))])
        model.policy.action_net.bias[STOP] += shift
    ended, step = _ends(margin > -shift)
    return StopFit(ended.size, float(ended.mean()), float((step + 1).mean()))


def _pays(infos: Sequence[Mapping[str, Any]]) -> list[float]:
    if "stop_pays" not in infos[0]:
        raise MissingInfoError(
            "StopCallback: expected `stop_pays` in info; train on AVPVecEnv or AVPSubprocVecEnv, for a reward whose "
            "stop always ends the episode"
        )
    return [info["stop_pays"] for info in infos]


def lost_by_stops(stops: NDArray[np.bool_], better: NDArray[np.floating]) -> float:
    """What episodes lose in the mean by where they stop first, of `(e, T, n)` stops and their advantages."""
    ended, step = _ends(stops)
    at = np.take_along_axis(better, step[:, None], axis=1)[:, 0]
    return float(np.maximum(np.where(ended, -at, better[:, -1]), 0.0).mean())


def _ends(stops: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """`(e, n)` whether episodes are stopped, and the step in which they end, from 0."""
    ended = np.asarray(stops.any(axis=1))
    return ended, np.where(ended, stops.argmax(axis=1), stops.shape[1] - 1)


def advantage_of_stop(reward: NDArray[np.floating], pays: NDArray[np.floating]) -> NDArray[np.float64]:
    """`(e, T, n)` by how much a stop in each step is better than the best later one, or than none.

    `reward` `(e, T, n)` is that of episodes without a stop, `pays` what choosing stop would have added in each step.
    """
    gained = np.cumsum(reward, axis=1)
    value = np.zeros(reward.shape)
    value[:, 1:] = gained[:, :-1] + pays[:, :-1]
    later = np.concatenate([value[:, 1:], gained[:, -1:]], axis=1)
    return value - np.maximum.accumulate(later[:, ::-1], axis=1)[:, ::-1]


def _logits(policy: Any, observation: torch.Tensor) -> torch.Tensor:
    """`(n, actions)` of the actor."""
    features = policy.extract_features(observation, policy.pi_features_extractor)
    return policy.action_net(policy.mlp_extractor.forward_actor(features))


def _learn(policy: Any, observation: torch.Tensor, others: torch.Tensor, better: torch.Tensor) -> None:
    """Minimise what `fit_stop` says for `(k, …)` observations, `(k, actions - 1)` logits and `(k,)` advantages."""
    lost, wanted = better.abs() / better.abs().mean().clamp(min=1e-12), (better > 0).to(better)
    before = others.log_softmax(dim=1)
    layers = {"params": policy.mlp_extractor.policy_net.parameters(), "lr": _RATE}
    last = {"params": policy.action_net.parameters(), "lr": _RATE_OF_LAST}
    layers = {"params": policy.mlp_extractor.policy_net.parameters(), "lr": _RATE}
    last = {"params": policy.action_net.parameters(), "lr": _RATE_OF_LAST}
    optimizer = torch.optim.Adam([layers, last])
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, _ROUNDS)
    for _ in range(_ROUNDS):
        rows = torch.randint(len(better), (_BATCH,))
        logits = _logits(policy, observation[rows])
        stop = logits[:, STOP] - logits[:, _OTHERS].logsumexp(dim=1)
        now = logits[:, _OTHERS].log_softmax(dim=1)
        kept = torch.nn.functional.kl_div(now, before[rows], reduction="batchmean", log_target=True)
        loss = torch.nn.functional.binary_cross_entropy_with_logits(stop, wanted[rows], lost[rows]) + _KEPT * kept
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
