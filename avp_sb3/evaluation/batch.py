"""Episodes of a model that still trains, run side by side in a vector environment of their own."""

import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv

from avp_habitat.simulators.registry import SimulatorChoice
from avp_habitat.task.settings import TaskSettings
from avp_sb3.vec_env.batched import AVPVecEnv
from avp_sb3.vec_env.subproc import AVPSubprocVecEnv

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm
from collections.abc import Mapping
from dataclasses import dataclass

from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from avp_habitat.metrics import coverage_per_view
from avp_habitat.task.trajectory import Trajectory
from avp_habitat.tracking.names import safe_name
from avp_sb3.callbacks.base import required
from avp_sb3.evaluation.fit import normaliser
from avp_sb3.evaluation.policy import COVERAGE_AFTER, KEPT, episode_figures


class FixedStarts(AVPVecEnv):
    """One agent for each episode in each of some scenes; seeded, episode i of every scene starts from `seed + i`."""

    def __init__(self, scenes: Sequence[str], *, episodes: int, **options: Any) -> None:
        """Open the scenes.

        Args:
            scenes: each as `avp_habitat.scenes.location.locate` takes it.
            episodes: in each scene.
            **options: of `AVPVecEnv`.

        Raises:
            AVPError: as `AVPVecEnv`.
        """
        super().__init__(list(scenes), agents=episodes * len(scenes), **options)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the starts of the next `reset`."""
        if seed is not None:
            self._seeds = _starts(seed, self.num_envs, len(self.simulators))
        return self._seeds


class FixedStartsInProcesses(AVPSubprocVecEnv):
    """The same with a process for each scene, whatever simulator this process itself holds."""

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the starts of the next `reset`."""
        if seed is not None:
            self._seeds = _starts(seed, self.num_envs, len(self.scenes))
        return self._seeds


def fixed_starts(scenes: Sequence[str], choice: SimulatorChoice, *, episodes: int, settings: TaskSettings) -> VecEnv:
    """The scenes in this process, or each in its own where a process can hold one simulator only.

    Args:
        scenes: as the simulator takes them.
        choice: of the simulator.
        episodes: in each scene.
        settings: of the task.

    Raises:
        AVPError: as `AVPVecEnv` and `AVPSubprocVecEnv`.
    """
    options = {"simulator": choice.simulator, "gpu": choice.gpu, "navmesh": choice.navmesh, "up": choice.up}
    if not choice.one_per_process:
        return FixedStarts(scenes, episodes=episodes, settings=settings, **options)
    return FixedStartsInProcesses(list(scenes), agents=episodes * len(scenes), settings=settings, **options)


def _starts(seed: int, agents: int, scenes: int) -> list[int | None]:
    """Agent i is in scene i modulo their number."""
    return [seed + row // scenes for row in range(agents)]


@contextmanager
def own_random_state(model: "BaseAlgorithm", seed: int) -> Iterator[None]:
    """Within the block, all generators that `model.predict` may use start from `seed`; after it they are as before.

    These are Python's, NumPy's and torch's global ones and that of the model's action space. The policy's training mode
    is given back, too.
    """
    space = model.action_space.np_random
    python, numpy_, mode = random.getstate(), np.random.get_state(), model.policy.training
    drawn = space.bit_generator.state
    on_gpu = model.device.type == "cuda"
    with torch.random.fork_rng([model.device] if on_gpu else []):
        try:
            random.seed(seed)
            np.random.seed(seed % 2**32)
            torch.default_generator.manual_seed(seed)
            if on_gpu:
                torch.cuda.manual_seed(seed)
            space.bit_generator.state = np.random.default_rng(seed).bit_generator.state
            yield
        finally:
            model.policy.set_training_mode(mode)
            space.bit_generator.state = drawn
            np.random.set_state(numpy_)
            random.setstate(python)


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
