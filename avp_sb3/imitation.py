"""Begin a training by imitation: actor and critic learn what another policy does before PPO goes on by reward.

A planner with full knowledge of the scenes shows what good episodes look like; the learner sees of them only its own
observation (behavioural cloning). PPO then corrects what cannot be known from that.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from numpy.typing import NDArray

from avp_habitat.command import progress
from avp_habitat.errors import UsageError
from avp_habitat.policies.registry import make_policy_env, steps_of
from avp_habitat.simulators.base import Simulator
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.settings import TaskSettings

EPISODES_OF_A_SCENE = 2
_EPOCHS, _BATCH, _RATE = 30, 256, 3e-4
_ENTROPY, _VALUE = 0.01, 0.5
_HELD_OUT = 8
"""One in so many episodes is not learned from, but tells which epoch is kept."""


@dataclass(frozen=True)
class Demonstrations:
    """What another policy did, m steps of several episodes."""

    observation: NDArray[np.float32]
    """`(m, …)` before each step."""
    action: NDArray[np.int64]
    """`(m,)` what it did then."""
    returned: NDArray[np.float32]
    """`(m,)` the discounted rewards from that step to the end of the episode."""
    episode: NDArray[np.int64]
    """`(m,)` number of the episode."""


@dataclass(frozen=True)
class ImitationFit:
    """How well a policy imitates."""

    episodes: int
    """Learned from or held out."""
    agreement: float
    """Share of the held-out steps in which the likeliest action is the one that was shown."""

    def __str__(self) -> str:
        """For the screen."""
        return f"learned from {self.episodes} episodes: does the same in {self.agreement:.0%} of the held-out steps"


def demonstrate(
    policy: str,
    scenes: Sequence[str],
    settings: TaskSettings,
    *,
    episodes: int,
    gamma: float,
    seed: int = 0,
    choice: SimulatorChoice | None = None,
) -> Demonstrations:
    """Let a policy act in some of the scenes, spread over all of them, two episodes in each.

    Raises:
        UsageError: no such policy, too few episodes, or an observation of several arrays.
        SceneError: a scene cannot be used.
    """
    if episodes < _HELD_OUT:
        raise UsageError(f"demonstrations: expected at least {_HELD_OUT} episodes, got {episodes}")
    count = min(len(scenes), -(-episodes // EPISODES_OF_A_SCENE))
    chosen = [str(scenes[round(index)]) for index in np.linspace(0, len(scenes) - 1, count).tolist()]
    shown: list[Demonstrations] = []
    for number in progress(range(episodes), unit="episode", desc=f"watching {policy}"):
        if number % EPISODES_OF_A_SCENE == 0:
            simulator = open_simulator(choice or SimulatorChoice(), chosen[number // EPISODES_OF_A_SCENE % count])
        shown.append(_episode(policy, simulator, settings, number, gamma, seed + number))
    return Demonstrations(*map(np.concatenate, zip(*(vars(each).values() for each in shown), strict=True)))


def _episode(
    policy: str, simulator: Simulator, settings: TaskSettings, number: int, gamma: float, seed: int
) -> Demonstrations:
    env, acting = make_policy_env(policy, simulator, settings, seed=seed, observation=settings.observation)
    if not isinstance(env.observation_space, Box):
        raise UsageError(f"imitate: expected an observation that is one array, got {env.observation_space}")
    steps = list(steps_of(env, acting, seed=seed))
    rewards = (step.reward for step in reversed(steps))
    returned = list(itertools.accumulate(rewards, lambda later, reward: reward + gamma * later))[::-1]
    return Demonstrations(
        np.stack([np.array(step.observation, np.float32) for step in steps]),
        np.array([step.action for step in steps]),
        np.array(returned, np.float32),
        np.full(len(steps), number),
    )


def imitate(model: Any, shown: Demonstrations) -> ImitationFit:
    """Teach PPO's policy what was shown: the actor the actions, the critic the returns; the best epoch is kept."""
    policy = model.policy
    held_out = shown.episode % _HELD_OUT == _HELD_OUT - 1
    observation, action, returned = (
        torch.from_numpy(each).to(policy.device) for each in (shown.observation, shown.action, shown.returned)
    )
    optimiser, best, kept = torch.optim.Adam(policy.parameters(), _RATE), np.inf, policy.state_dict()
    agreement = 0.0
    epochs = _epochs(np.flatnonzero(~held_out), seed=model.seed or 0)
    for rows in progress(epochs, total=_EPOCHS, unit="epoch", desc="imitating"):
        for batch in np.array_split(rows, max(1, len(rows) // _BATCH)):
            value, log_probability, entropy = policy.evaluate_actions(observation[batch], action[batch])
            error = ((value[:, 0] - returned[batch]) ** 2).mean()
            loss = -log_probability.mean() - _ENTROPY * entropy.mean() + _VALUE * error
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        with torch.no_grad():
            distribution = policy.get_distribution(observation[held_out])
            surprise = -float(distribution.log_prob(action[held_out]).mean())
            if surprise < best:
                best, kept = surprise, {name: each.clone() for name, each in policy.state_dict().items()}
                agreement = float((distribution.mode() == action[held_out]).float().mean())
    policy.load_state_dict(kept)
    return ImitationFit(int(shown.episode.max()) + 1, agreement)


def _epochs(rows: NDArray[np.int64], *, seed: int) -> Iterator[NDArray[np.int64]]:
    generator = np.random.default_rng(seed)
    for _ in range(_EPOCHS):
        yield generator.permutation(rows)
