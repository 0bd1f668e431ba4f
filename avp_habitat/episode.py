"""One episode of a policy in `AVP-v0`, step by step."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from avp_habitat.policies import Policy


@dataclass(frozen=True)
class Step:
    """What one step of the environment gave."""

    action: int
    """Number of the action taken."""
    reward: float
    """Of the step."""
    info: dict[str, Any]
    """Of the step; the last one of the episode holds `avp_episode` and `avp_trajectory`."""


def steps_of(env: gymnasium.Env, policy: Policy, *, seed: int, deterministic: bool = True) -> Iterator[Step]:
    """Run one episode; the environment stands where each step left it while the caller has that step.

    Args:
        env: a `AVPEnv`, also a wrapped one.
        policy: asked with its recurrent state, if it has one.
        seed: of the start.
        deterministic: False to sample a model's actions.
    """
    observation, _ = env.reset(seed=seed)
    state: Any = None
    first = np.array([True])
    ended = False
    while not ended:
        chosen, state = policy.predict(observation, state, first, deterministic=deterministic)
        action = int(chosen)
        observation, reward, terminated, truncated, info = env.step(action)
        first = np.array([False])
        ended = terminated or truncated
        yield Step(action, float(reward), info)
