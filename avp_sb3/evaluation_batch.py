"""Episodes of a model that still trains, run side by side in a vector environment of their own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from avp_habitat.metrics import coverage_per_view
from avp_habitat.settings import TaskSettings
from avp_habitat.tracking.names import safe_name
from avp_habitat.trajectory import Trajectory
from avp_sb3.evaluation import COVERAGE_AFTER, KEPT, episode_figures
from avp_sb3.evaluation_fit import normaliser
from avp_sb3.finished_episodes import required

READER = "EvaluationCallback"
"""Who needs what an environment reports, for the errors' texts."""
_OF_BUDGET = ("coverage_area", *(f"coverage_at_{views}" for views in COVERAGE_AFTER))
FIGURES = (*KEPT, "redundant_share", "return", "cpv", *_OF_BUDGET)
"""Everything that an evaluation may log, below `eval/`."""


@dataclass(frozen=True)
class BatchEpisode:
    """One episode."""

    agent: int
    """Number of its environment."""
    curve: NDArray[np.float64]
    """`(v,)` coverage after each view, within [0, 1], held up to the budget where there is one; the last one alone
    where the environment tells no other."""
    figures: dict[str, float]
    """As `EpisodeResult.figures`, and `return`; without those of the whole curve where budget or curve are not told."""
    trajectory: Trajectory | None
    """What the agent did, where the environment tells."""


def scenes_of(env: VecEnv) -> dict[str, list[int]]:
    """Numbers of the environments in each scene, by a name that every logger takes.

    Different scenes of the same name get different ones; environments without scenes are one, called `env`.
    """
    if not env.has_attr("scene_name"):
        return {"env": list(range(env.num_envs))}
    names = env.get_attr("scene_name")
    digests = env.get_attr("scene_digest") if env.has_attr("scene_digest") else names
    labels: dict[tuple[str, str], str] = {}
    found: dict[str, list[int]] = {}
    for agent, scene in enumerate(zip(names, digests, strict=True)):
        if scene not in labels:
            label = safe_name(str(scene[0]).replace("/", "_")).replace(" ", "_")
            labels[scene] = _not_in(label, found)
        found.setdefault(labels[scene], []).append(agent)
    return found


def _not_in(label: str, taken: Mapping[str, Any]) -> str:
    numbered = [label, *(f"{label}-{number}" for number in range(2, len(taken) + 2))]
    return next(name for name in numbered if name not in taken)


def budget_of(env: VecEnv) -> int | None:
    """Views that an episode may have, if the environment tells."""
    settings = env.get_attr("settings", 0)[0] if env.has_attr("settings") else None
    return settings.budget if isinstance(settings, TaskSettings) else None


def run_batch(
    model: BaseAlgorithm, env: VecEnv, episodes: Mapping[int, int], *, seed: int, deterministic: bool
) -> list[BatchEpisode]:
    """Run episodes; all environments are stepped by one call, and those that have done theirs are not counted further.

    Args:
        model: whose policy acts; it is asked once for each step. Where the model trains with `VecNormalize` and `env`
            has none, it sees observations normalised with the training's statistics.
        env: seeded and reset here.
        episodes: how many of each environment, by its number.
        seed: of the starts.
        deterministic: False to sample the actions.

    Raises:
        MissingInfoError: the environment does not report what is needed.

    Returns:
        The episodes, sorted by environment.
    """
    normalise = normaliser(model, env)
    budget = budget_of(env)
    wanted = np.array([episodes.get(agent, 0) for agent in range(env.num_envs)])
    env.seed(seed)
    observation, state, starts = normalise(env.reset()), None, np.ones(env.num_envs, dtype=np.bool_)
    running = [_Running() for _ in range(env.num_envs)]
    done: list[BatchEpisode] = []
    while wanted.any():
        actions, state = model.predict(observation, state, starts, deterministic=deterministic)  # type: ignore[arg-type]
        observation, rewards, starts, infos = env.step(actions)
        observation, rewards = normalise(observation), _original(env, rewards)
        for agent in np.flatnonzero(wanted):
            running[agent].add(float(rewards[agent]), infos[agent])
            if starts[agent]:
                done.append(running[agent].finished(int(agent), infos[agent], budget))
                running[agent], wanted[agent] = _Running(), wanted[agent] - 1
    return sorted(done, key=lambda episode: episode.agent)


class _Running:
    """What is known of an episode before it ends."""

    def __init__(self) -> None:
        self.coverage: list[float] = []
        self.reward = 0.0

    def add(self, reward: float, info: Mapping[str, Any]) -> None:
        if "coverage" in info:
            self.coverage.append(float(info["coverage"]))
        self.reward += reward

    def finished(self, agent: int, info: Mapping[str, Any], budget: int | None) -> BatchEpisode:
        told = required(info, "avp_episode", reader=READER)
        for key in (*KEPT, "redundant_views"):
            required(told, key, reader=READER, inside="info['avp_episode']")
        curve, figures = episode_figures(self.coverage or [told["coverage"]], told, budget or len(self.coverage) or 1)
        if budget is None or not self.coverage:
            figures = {name: value for name, value in figures.items() if name not in _OF_BUDGET}
        return BatchEpisode(agent, curve, figures | {"return": self.reward}, info.get("avp_trajectory"))


def means(episodes: Sequence[BatchEpisode]) -> dict[str, float]:
    """Mean of each figure over at least one episode, and CpV of all of them."""
    mean = {name: float(np.mean([episode.figures[name] for episode in episodes])) for name in episodes[0].figures}
    coverages, lengths = (np.array([each.figures[name] for each in episodes]) for name in ("coverage", "views"))
    return mean | {"cpv": coverage_per_view(coverages, lengths)}


def _original(env: VecEnv, rewards: NDArray) -> NDArray:
    normalised = unwrap_vec_normalize(env)
    return rewards if normalised is None else normalised.get_original_reward()
