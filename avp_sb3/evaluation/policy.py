"""Episodes of a policy on fixed starts, and the figures by which policies are compared."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.metrics import CONFIDENCE, mean_and_half_width
from avp_habitat.policies.registry import Policy, check_policy, make_policy, make_policy_env, steps_of
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.task.settings import TaskSettings
from avp_habitat.task.trajectory import Trajectory

__all__ = ["CONFIDENCE", "held_curve", "mean_and_half_width"]

Float = NDArray[np.floating]


def held_curve(values: Sequence[float] | Float, budget: int) -> NDArray[np.float64]:
    """A figure after 1 … T views, of an episode that may have stopped earlier and then holds its last value.

    Args:
        values: `(v,)` after each view, 1 ≤ v ≤ T.
        budget: T.

    Returns:
        `(T,)`.
    """
    values = np.asarray(values, dtype=np.float64)
    return np.concatenate([values, np.full(budget - len(values), values[-1])])


COVERAGE_AFTER = (20, 40, 60, 80)
"""Views after which the coverage is a figure of its own, as far as the budget reaches."""
KEPT = ("coverage", "views", "annd_m", "ei", "path_length_m", "collisions", "stopped")
"""Keys of `info["avp_episode"]` that are figures as they are."""


@dataclass(frozen=True)
class EpisodeResult:
    """One episode."""

    seed: int
    """Of its start."""
    curve: NDArray[np.float64]
    """`(T,)` coverage after 1 … T views, within [0, 1]; the last value is held after a stop."""
    figures: dict[str, float]
    """coverage, coverage_area (its mean over 1 … T views), coverage_at_K (after K views), views, annd_m, ei,
    path_length_m, collisions, redundant_share (of the views) and stopped, with the units of `episode_metrics`."""


@dataclass(frozen=True)
class PolicyResult:
    """n episodes of one policy."""

    policy: str
    """A baseline's name or a model file, as given."""
    seeds: NDArray[np.int64]
    """`(n,)` of the starts."""
    curve: NDArray[np.float64]
    """`(n, T)` coverage after 1 … T views, within [0, 1]."""
    figures: dict[str, NDArray[np.float64]]
    """`(n,)` each: the figures of `EpisodeResult`."""
    training_run: str | None = None
    """MLflow run that trained the model."""
    observation: str | None = None
    """Kind of observation that the policy was given."""

    @classmethod
    def of(
        cls,
        policy: str,
        episodes: Sequence[EpisodeResult],
        *,
        training_run: str | None = None,
        observation: str | None = None,
    ) -> "PolicyResult":
        """Stack at least one episode."""
        return cls(
            policy=policy,
            seeds=np.array([episode.seed for episode in episodes]),
            curve=np.stack([episode.curve for episode in episodes]),
            figures={name: np.array([episode.figures[name] for episode in episodes]) for name in episodes[0].figures},
            training_run=training_run,
            observation=observation,
        )


class Contestant:
    """A policy beside the environment that it fits, ready to run episodes."""

    def __init__(
        self,
        policy: str,
        scene: str | Path,
        settings: TaskSettings,
        *,
        simulator: str = "raycast",
        gpu: int | None = None,
        navmesh: str | Path | None = None,
        up: str | None = None,
        observation: str | None = None,
        stochastic: bool = False,
        trusted: bool = False,
    ) -> None:
        """Open the scene and the policy.

        Args:
            policy: a baseline's name, or a model saved by Stable-Baselines3 (`.zip`).
            scene: as `avp_habitat.scenes.location.locate` takes it.
            settings: of the task; visibility is always computed, never looked up.
            simulator: the simulator's name.
            gpu: the CUDA device of `habitat`; -1 for none, None for the first one there is.
            navmesh: file of the scene's NavMesh; computed when omitted.
            up: axis of a mesh file that points up, `y` or `z`; what is known of the file when omitted.
            observation: kind of observation; what the model was trained on when omitted.
            stochastic: sample a model's actions instead of taking the likeliest.
            trusted: open a model's file also where that may run code which the file holds.

        Raises:
            UsageError: an unknown name.
            PolicyError: the model cannot be loaded or fits no kind of observation.
            SceneError: the scene cannot be used.
            SimulatorError: the simulator cannot run here.
        """
        self.name = check_policy(policy)
        self.trajectory: Trajectory | None = None
        """Of the last episode that ended."""
        self._stochastic = stochastic
        opened = make_simulator(simulator, scene, gpu=gpu, navmesh=navmesh, up=up)
        self.env, self._policy = make_policy_env(
            policy, opened, replace(settings, lookup=False), observation=observation, trusted=trusted
        )

    @property
    def training_run(self) -> str | None:
        """MLflow run that trained the model, if one did."""
        return getattr(self._policy, "avp_mlflow_run_id", None)

    @property
    def observation(self) -> str:
        """Kind of observation in use."""
        return self.env.settings.observation

    def run(self, seed: int) -> EpisodeResult:
        """One episode; it depends on the seed alone, not on the episodes before it."""
        coverage, info = [], {}
        steps = steps_of(self.env, self._renewed(seed), seed=seed, deterministic=not self._stochastic)
        for step in steps:
            info = step.info
            coverage.append(info["coverage"])
        self.trajectory = info["avp_trajectory"]
        return EpisodeResult(seed, *episode_figures(coverage, info["avp_episode"], self.env.settings.budget))

    def result(self, episodes: Sequence[EpisodeResult]) -> PolicyResult:
        """At least one episode of this policy, stacked."""
        return PolicyResult.of(self.name, episodes, training_run=self.training_run, observation=self.observation)

    def _renewed(self, seed: int) -> Policy:
        if hasattr(self._policy, "set_random_seed"):
            self._policy.set_random_seed(seed)  # type: ignore[attr-defined]
            return self._policy
        return make_policy(self.name, self.env, seed)


def evaluate_policy(
    policy: str,
    scene: str | Path,
    *,
    episodes: int = 20,
    seed: int = 1000,
    settings: TaskSettings | None = None,
    on_episode: Callable[[], object] = lambda: None,
    **options: Any,
) -> PolicyResult:
    """Run a policy from fixed starts: episode i starts from `seed + i`, whatever the policy.

    Args:
        policy: a baseline's name, or a model saved by Stable-Baselines3 (`.zip`).
        scene: as `avp_habitat.scenes.location.locate` takes it.
        episodes: n, at least 1.
        seed: of the first episode.
        settings: of the task; the design's defaults when omitted. Visibility is always computed, never looked up.
        on_episode: called after each episode.
        **options: `simulator`, `gpu`, `navmesh`, `up`, `observation`, `stochastic` and `trusted` of `Contestant`.

    Raises:
        AVPError: as `Contestant`.
    """
    contestant = Contestant(policy, scene, settings or TaskSettings(), **options)
    return contestant.result(list(run_episodes(contestant, episodes, seed, on_episode)))


def run_episodes(
    contestant: Contestant, episodes: int, seed: int, on_episode: Callable[[], object] = lambda: None
) -> Iterator[EpisodeResult]:
    """The episodes from `seed`, `seed + 1`, … as they end."""
    for number in range(episodes):
        yield contestant.run(seed + number)
        on_episode()


def episode_figures(
    coverage: Sequence[float], episode: Mapping[str, float], budget: int
) -> tuple[NDArray[np.float64], dict[str, float]]:
    """An episode's curve and figures, as `EpisodeResult` holds them.

    Args:
        coverage: `(v,)` after each view, within [0, 1].
        episode: `info["avp_episode"]`.
        budget: T, at least v.
    """
    curve = held_curve(coverage, budget)
    return curve, {
        **{name: episode[name] for name in KEPT},
        "redundant_share": episode["redundant_views"] / episode["views"],
        "coverage_area": float(curve.mean()),
        **{f"coverage_at_{views}": float(curve[views - 1]) for views in COVERAGE_AFTER if views <= budget},
    }
