"""One episode of a policy in `AVP-v0`, step by step."""

import importlib
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import PolicyError, UsageError, unknown_name
from avp_habitat.policies.saved_model import SCHEDULES, NormalisedPolicy, check_harmless, statistics_of
from avp_habitat.simulators.base import Simulator
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import OBSERVATION_NAMES, TaskSettings


class MisfitError(PolicyError):
    """A model that was trained for other observations or actions."""


class Policy(Protocol):
    """Stable-Baselines3's `predict`."""

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray, Any]:
        """Actions and the next recurrent state."""
        ...


# Where each baseline's class lies; its `for_env(env, seed)` is imported when it is asked for.
_BASELINES = {
    "heuristic": "avp_habitat.policies.reactive:HeuristicPolicy",
    "random": "avp_habitat.policies.reactive:RandomPolicy",
    "spin": "avp_habitat.policies.reactive:SpinPolicy",
    "frontier": "avp_habitat.policies.frontier:FrontierPolicy",
    "greedy": "avp_habitat.policies.greedy:GreedyPolicy",
    "oracle": "avp_habitat.policies.oracle.policy:OraclePolicy",
    "survey": "avp_habitat.policies.oracle.policy:SurveyPolicy",
}
POLICY_NAMES = tuple(_BASELINES)
TRUSTED = "open a model also where that may run code which its file holds: only if you know who made it"
"""Help of the option `--trusted`."""


def check_policy(policy: str) -> str:
    """The name itself when it is a baseline's or an existing model file's that has its statistics.

    Raises:
        UsageError: neither; the text names the nearest baseline.
        PolicyError: the model was trained under `VecNormalize`, and its statistics are not beside it.
    """
    if policy in _BASELINES:
        return policy
    if not policy.endswith(".zip"):
        raise unknown_name("policy", policy, [*POLICY_NAMES, "MODEL.zip"])
    if not Path(policy).is_file():
        raise UsageError(f"--policy {policy}: no such model file")
    statistics_of(Path(policy))
    return policy


def described(policy: str) -> str:
    """A policy as it will act, for the screen: with the statistics by which a model sees."""
    statistics = statistics_of(Path(policy)) if policy.endswith(".zip") else None
    return policy if statistics is None else f"{policy} with the statistics {statistics}"


def make_policy(policy: str, env: AVPEnv, seed: int, *, trusted: bool = False) -> Policy:
    """The policy for an environment.

    Args:
        policy: a baseline's name, or a PPO model saved by Stable-Baselines3 (`.zip`). One that was trained under
            `VecNormalize` sees observations normalised with the statistics beside it.
        env: what it acts in.
        seed: of a policy that draws at random.
        trusted: open a model's file also where that may run code which the file holds.

    Raises:
        UsageError: no such policy.
        MisfitError: the model was trained for other observations or actions.
        PolicyError: the file is not a PPO model, holds what may run code, or lacks its statistics.
    """
    check_policy(policy)
    if policy in _BASELINES:
        module, _, name = _BASELINES[policy].partition(":")
        return getattr(importlib.import_module(module), name).for_env(env, seed)
    model = load_model(Path(policy), trusted=trusted)
    for kind in ("observation_space", "action_space"):
        learned, offered = getattr(model, kind), getattr(env, kind)
        if learned != offered:
            raise MisfitError(f"{policy}: trained for the {kind} {learned}, but this environment has {offered}")
    model.set_random_seed(seed)
    statistics = statistics_of(Path(policy))
    return model if statistics is None else NormalisedPolicy(model, statistics, trusted=trusted)


def load_model(path: Path, *, env: Any = None, trusted: bool = False) -> Any:
    """A PPO model of Stable-Baselines3, on the CPU.

    Args:
        path: of its `.zip`.
        env: in which its training goes on; without it, its schedules (of the learning rate, say) are left unread, which
            are often functions.
        trusted: open it also where that may run code which the file holds.

    Raises:
        PolicyError: it is none, or holds what may run code.
        ValueError: it does not fit `env`.
    """
    try:
        from stable_baselines3 import PPO
    except ImportError:
        raise PolicyError(f"{path}: needs stable-baselines3; install it with `pip install 'avp-suite[sb3]'`") from None
    if not zipfile.is_zipfile(path):
        raise PolicyError(f"{path}: expected a model saved by Stable-Baselines3 (.zip), found another kind of file")
    # Who only acts needs no schedules.
    replaced = SCHEDULES if env is None and not trusted else {}
    if not trusted:
        check_harmless(path, without=replaced)
    try:
        return PPO.load(path, env=env, device="cpu", custom_objects=replaced)
    except Exception as error:
        if env is not None and isinstance(error, ValueError):
            raise
        # A pickle may raise anything.
        raise PolicyError(f"{path}: expected a PPO model of Stable-Baselines3, could not load it: {error}") from None


def make_policy_env(
    policy: str,
    simulator: Simulator,
    settings: TaskSettings,
    *,
    seed: int = 0,
    observation: str | None = None,
    trusted: bool = False,
) -> tuple[AVPEnv, Policy]:
    """An environment, and the policy that acts in it.

    Args:
        policy: a baseline's name, or a model saved by Stable-Baselines3 (`.zip`).
        simulator: an open one.
        settings: of the task.
        seed: of a policy that draws at random.
        observation: the kind; when omitted, the first one that fits: a baseline fits each, a model its own.
        trusted: open a model's file also where that may run code which the file holds.

    Raises:
        UsageError: no such policy or observation.
        PolicyError: the model cannot be loaded, or fits no kind of observation.
    """
    first: MisfitError | None = None
    for kind in OBSERVATION_NAMES if observation is None else (observation,):
        env = AVPEnv(simulator.scene, simulator=simulator, settings=replace(settings, observation=kind))
        try:
            return env, make_policy(policy, env, seed, trusted=trusted)
        except MisfitError as error:
            first = first or error
    assert first is not None
    raise first


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
