"""Policies by name or by model file, as `collect` and evaluations ask for them."""

import importlib
import zipfile
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from avp_habitat.env import AVPEnv
from avp_habitat.errors import PolicyError, UsageError, unknown_name
from avp_habitat.saved_model import SCHEDULES, NormalisedPolicy, check_harmless, statistics_of


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
    "heuristic": "avp_habitat.baselines.reactive:HeuristicPolicy",
    "random": "avp_habitat.baselines.reactive:RandomPolicy",
    "spin": "avp_habitat.baselines.spin:SpinPolicy",
    "frontier": "avp_habitat.baselines.frontier:FrontierPolicy",
    "greedy": "avp_habitat.baselines.greedy:GreedyPolicy",
    "oracle": "avp_habitat.oracle.policy:OraclePolicy",
    "survey": "avp_habitat.oracle.policy:SurveyPolicy",
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
