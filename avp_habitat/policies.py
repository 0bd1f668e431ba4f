"""Policies by name or by model file, as `collect` and evaluations ask for them."""

import importlib
import pickle
import zipfile
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from avp_habitat.env import AVPEnv
from avp_habitat.errors import PolicyError, UsageError, unknown_name


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


def check_policy(policy: str) -> str:
    """The name itself when it is a baseline's or an existing model file's.

    Raises:
        UsageError: neither; the text names the nearest baseline.
    """
    if policy in _BASELINES:
        return policy
    if not policy.endswith(".zip"):
        raise unknown_name("policy", policy, [*POLICY_NAMES, "MODEL.zip"])
    if not Path(policy).is_file():
        raise UsageError(f"--policy {policy}: no such model file")
    return policy


def make_policy(policy: str, env: AVPEnv, seed: int) -> Policy:
    """The policy for an environment.

    Args:
        policy: a baseline's name, or a PPO model saved by Stable-Baselines3 (`.zip`).
        env: what it acts in.
        seed: of a policy that draws at random.

    Raises:
        UsageError: no such policy.
        PolicyError: the file is not a PPO model, or was trained for other observations or actions.
    """
    check_policy(policy)
    if policy in _BASELINES:
        module, _, name = _BASELINES[policy].partition(":")
        return getattr(importlib.import_module(module), name).for_env(env, seed)
    return _load_model(Path(policy), env, seed)


def _load_model(path: Path, env: AVPEnv, seed: int) -> Policy:
    try:
        from stable_baselines3 import PPO
    except ImportError:
        raise PolicyError(f"{path}: needs stable-baselines3; install it with `pip install 'avp-suite[sb3]'`") from None
    if not zipfile.is_zipfile(path):
        raise PolicyError(f"{path}: expected a model saved by Stable-Baselines3 (.zip), found another kind of file")
    try:
        model = PPO.load(path, device="cpu")
    except (ValueError, KeyError, RuntimeError, AttributeError, TypeError, EOFError, pickle.UnpicklingError) as error:
        raise PolicyError(f"{path}: expected a PPO model of Stable-Baselines3, could not load it: {error}") from None
    for kind in ("observation_space", "action_space"):
        trained, offered = getattr(model, kind), getattr(env, kind)
        if trained != offered:
            raise PolicyError(f"{path}: trained for the {kind} {trained}, but this environment has {offered}")
    model.set_random_seed(seed)
    return model
