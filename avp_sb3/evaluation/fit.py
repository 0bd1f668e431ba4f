"""How an evaluation's environment fits a training: its spaces, and the same normalisation."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import gymnasium
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, unwrap_vec_normalize

from avp_habitat.errors import UsageError


def normaliser(model: BaseAlgorithm, env: VecEnv) -> Callable[[Any], Any]:
    """What turns the environment's observations into those that the policy knows.

    Where the model trains with `VecNormalize` and the environment has none, these are the training's statistics.
    """
    normalised = model.get_vec_normalize_env()
    if normalised is None or unwrap_vec_normalize(env) is not None:
        return lambda observation: observation
    return normalised.normalize_obs


def check_fit(model: BaseAlgorithm, training: VecEnv, env: VecEnv, *, reader: str) -> None:
    """Refuse an evaluation's environment that the policy cannot act in.

    Args:
        model: that trains.
        training: its environment.
        env: of the evaluation.
        reader: who evaluates, for the error's text.

    Raises:
        UsageError: the spaces differ, only the evaluation is normalised, or it is the training's own environment.
    """
    if _chain(training) & _chain(env):
        raise UsageError(f"{reader} eval_env: is the training's own environment; expected another one")
    expected = _expected_space(model, env, reader)
    for kind, ours, theirs in (
        ("observation_space", expected, env.observation_space),
        ("action_space", model.action_space, env.action_space),
    ):
        if ours != theirs:
            raise UsageError(
                f"{reader}: expected the {kind} of the policy, {ours}, but the evaluation's environment has {theirs}; "
                "wrap an eval_env as the training's environment is wrapped"
            )


def _expected_space(model: BaseAlgorithm, env: VecEnv, reader: str) -> gymnasium.Space:
    normalised, own = model.get_vec_normalize_env(), unwrap_vec_normalize(env)
    space = model.observation_space
    assert space is not None
    if normalised is None:
        if own is not None:
            raise UsageError(f"{reader} eval_env: is wrapped in VecNormalize, but the training's environment is not")
        return space
    if own is not None:
        return space
    if space != normalised.observation_space:
        raise UsageError(
            f"{reader}: the training's environment changes observations after VecNormalize; expected an eval_env that "
            "is wrapped in the same way"
        )
    assert normalised.venv is not None
    return normalised.venv.observation_space


def _chain(env: VecEnv) -> set[int]:
    """Identities of an environment and of all that it wraps."""
    found = {id(env)}
    while isinstance(env, VecEnvWrapper):
        env = env.venv
        found.add(id(env))
    return found


@contextmanager
def normalised_like(model: BaseAlgorithm, env: VecEnv) -> Iterator[None]:
    """Within the block, an evaluation environment's own `VecNormalize` uses the training's statistics, unchanged."""
    ours, theirs = unwrap_vec_normalize(env), model.get_vec_normalize_env()
    if ours is None or theirs is None:
        yield
        return
    if theirs.norm_obs:
        ours.obs_rms = deepcopy(theirs.obs_rms)
    ours.ret_rms = deepcopy(theirs.ret_rms)
    before, ours.training = ours.training, False
    try:
        yield
    finally:
        ours.training = before
