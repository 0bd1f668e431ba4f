"""Episodes of a model that still trains, run side by side in a vector environment of their own."""

import random
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from avp_habitat.errors import UsageError
from avp_habitat.metrics import coverage_per_view
from avp_habitat.tracking.names import safe_name
from avp_sb3.callbacks.base import required, settings_of
from avp_sb3.evaluation.policy import Episode, episode_of

READER = "EvaluationCallback"
"""Who needs what an environment reports, for the errors' texts."""


def check_fit(model: BaseAlgorithm, training: VecEnv, env: VecEnv) -> None:
    """Refuse an evaluation's environment `env` that the policy cannot act in.

    Raises:
        UsageError: the spaces differ, only the evaluation is normalised, or it is the training's own environment.
    """
    if training.unwrapped is env.unwrapped:
        raise UsageError(f"{READER} eval_env: is the training's own environment; expected another one")
    normalised, own = model.get_vec_normalize_env(), unwrap_vec_normalize(env)
    if own is not None and normalised is None:
        raise UsageError(f"{READER} eval_env: is wrapped in VecNormalize, but the training's environment is not")
    raw = None if normalised is None or own is not None else normalised.venv
    seen = model.observation_space if raw is None else raw.observation_space
    for kind, expected in (("observation_space", seen), ("action_space", model.action_space)):
        if expected != getattr(env, kind):
            raise UsageError(
                f"{READER}: expected the {kind} of the policy, {expected}, but the evaluation's environment has "
                f"{getattr(env, kind)}; wrap an eval_env as the training's environment is wrapped"
            )


@contextmanager
def own_random_state(model: BaseAlgorithm, seed: int) -> Iterator[None]:
    """Within the block, all generators that `model.predict` may use start from `seed`; after it they are as before.

    The policy's training mode is given back, too.
    """
    drawing = model.action_space.np_random.bit_generator
    before = random.getstate(), np.random.get_state(), drawing.state, model.policy.training
    with torch.random.fork_rng([model.device] if model.device.type == "cuda" else []):
        try:
            set_random_seed(seed)
            drawing.state = np.random.default_rng(seed).bit_generator.state
            yield
        finally:
            random.setstate(before[0])
            np.random.set_state(before[1])
            drawing.state = before[2]
            model.policy.set_training_mode(before[3])


def scenes_of(env: VecEnv) -> dict[str, list[int]]:
    """Numbers of the environments in each scene, by a name that every logger takes.

    Different scenes of the same name get different ones; environments without scenes are one, called `env`.
    """
    if not env.has_attr("scene_name"):
        return {"env": list(range(env.num_envs))}
    names = env.get_attr("scene_name")
    digests = env.get_attr("scene_digest") if env.has_attr("scene_digest") else names
    agents = defaultdict(list)
    for agent, scene in enumerate(zip(names, digests, strict=True)):
        agents[scene].append(agent)
    found: dict[str, list[int]] = {}
    for (name, _), own in agents.items():
        label = safe_name(str(name).replace("/", "_")).replace(" ", "_")
        numbered = [label, *(f"{label}-{number}" for number in range(2, len(found) + 2))]
        found[next(each for each in numbered if each not in found)] = own
    return found


def run_batch(
    model: BaseAlgorithm, env: VecEnv, episodes: int, *, seed: int, deterministic: bool
) -> dict[str, list[Episode]]:
    """So many episodes in each scene (`scenes_of`), spread over its environments, of which the i-th has `seed + i`.

    All environments are stepped by one call, and those that have done theirs are not counted further. A model that
    trains with `VecNormalize` sees observations normalised with the training's statistics.

    Raises:
        MissingInfoError: the environment does not report what is needed.
    """
    scenes = scenes_of(env)
    wanted = np.zeros(env.num_envs, dtype=np.int64)
    seeds: list[int | None] = [None] * env.num_envs
    for agents in scenes.values():
        for place, agent in enumerate(agents):
            wanted[agent] = (episodes + len(agents) - 1 - place) // len(agents)
            seeds[agent] = seed + place
    settings = settings_of(env)
    budget = None if settings is None else settings.budget
    done: dict[int, list[Episode]] = {agent: [] for agent in range(env.num_envs)}
    coverage: list[list[float]] = [[] for _ in done]
    returned, ours = np.zeros(env.num_envs), unwrap_vec_normalize(env)
    with _normalised(model, env) as normalise:
        env.seed(seed)
        env.unwrapped._seeds = [*seeds]  # Other starts than seed, seed + 1, … over all scenes.
        observation, state, starts = normalise(env.reset()), None, np.ones(env.num_envs, dtype=np.bool_)
        while wanted.any():
            actions, state = model.predict(observation, state, starts, deterministic=deterministic)  # type: ignore[arg-type]
            observation, rewards, starts, infos = env.step(actions)
            observation = normalise(observation)
            returned += rewards if ours is None else ours.get_original_reward()
            for agent in np.flatnonzero(wanted):
                if "coverage" in infos[agent]:
                    coverage[agent].append(float(infos[agent]["coverage"]))
                if starts[agent]:
                    done[agent].append(_finished(coverage[agent], infos[agent], budget, float(returned[agent])))
                    coverage[agent], returned[agent], wanted[agent] = [], 0.0, wanted[agent] - 1
    return {scene: [episode for agent in agents for episode in done[agent]] for scene, agents in scenes.items()}


def _finished(coverage: list[float], info: dict[str, Any], budget: int | None, returned: float) -> Episode:
    told = required(info, "avp_episode", reader=READER)
    for key in ("coverage", "views"):
        required(told, key, reader=READER, inside="info['avp_episode']")
    episode = episode_of(coverage, info, budget)
    episode.figures["return"] = returned
    return episode


def means(episodes: list[Episode]) -> dict[str, float]:
    """Mean of each figure over at least one episode, and CpV of all of them."""
    columns = {name: np.array([each.figures[name] for each in episodes]) for name in episodes[0].figures}
    cpv = coverage_per_view(columns["coverage"], columns["views"])
    return {name: float(values.mean()) for name, values in columns.items()} | {"cpv": cpv}


@contextmanager
def _normalised(model: BaseAlgorithm, env: VecEnv) -> Iterator[Callable[[Any], Any]]:
    """A block with what turns the environment's observations into those that the policy knows.

    Its own `VecNormalize` uses the training's statistics in the block, unchanged.
    """
    theirs, ours = model.get_vec_normalize_env(), unwrap_vec_normalize(env)
    if theirs is None or ours is None:
        yield (lambda observation: observation) if theirs is None else theirs.normalize_obs
        return
    if theirs.norm_obs:
        ours.obs_rms = deepcopy(theirs.obs_rms)
    ours.ret_rms = deepcopy(theirs.ret_rms)
    before, ours.training = ours.training, False
    try:
        yield lambda observation: observation
    finally:
        ours.training = before
