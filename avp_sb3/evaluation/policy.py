"""Episodes of a policy on fixed starts, and the figures by which policies are compared."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.metrics import FIGURES, Figure, figures
from avp_habitat.plugins import name_of
from avp_habitat.policies.registry import check_policy, make_policy, make_policy_env, steps_of
from avp_habitat.simulators.base import Simulator
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.task.settings import TaskSettings
from avp_habitat.task.trajectory import Trajectory

COVERAGE_AFTER = (20, 40, 60, 80)
"""Views after which the coverage is a figure of its own, as far as the budget reaches."""
_OWN = (
    FIGURES["coverage_area"],
    *(Figure(f"coverage_at_{k}", f"coverage at {k} views", "%", 100, better="higher") for k in COVERAGE_AFTER),
    Figure("return", "return", digits=3, better="higher"),
)
RETURN = "return_"
"""Before the name of a reward's part in `info["avp_episode"]`."""


def figures_of(metrics: Iterable[Any] = ()) -> dict[str, Figure]:
    """All figures that an evaluation with `TaskSettings.metrics` may have, by name, in the order of the tables."""
    known = figures(tuple(metrics))
    return {"coverage": known["coverage"]} | {figure.name: figure for figure in _OWN} | known


@dataclass(frozen=True)
class Episode:
    """One episode."""

    curve: NDArray[np.float64]
    """`(T,)` coverage after 1 … T views, within [0, 1]; the last value is held after a stop."""
    figures: dict[str, float]
    """What `info["avp_episode"]` holds but the returns of reward parts, with redundant_share (of the views) in place of
    redundant_views, coverage_area (mean over 1 … T views) and coverage_at_K (after K views)."""
    trajectory: Trajectory | None
    """What the agent did, where the environment tells."""


def episode_of(coverage: Sequence[float], info: Mapping[str, Any], budget: int | None) -> Episode:
    """A finished episode, of which `info` is that of the last step.

    `coverage` is `(v,)` after each view, empty where it is not known. Without it, or without the budget T, the figures
    of the whole curve are left out.
    """
    found = {name: float(value) for name, value in info["avp_episode"].items() if not name.startswith(RETURN)}
    if "redundant_views" in found:
        found["redundant_share"] = found.pop("redundant_views") / found["views"]
    curve = held_curve(coverage or [found["coverage"]], budget or max(len(coverage), 1))
    if coverage and budget is not None:
        found["coverage_area"] = float(curve.mean())
        found |= {f"coverage_at_{k}": float(curve[k - 1]) for k in COVERAGE_AFTER if k <= budget}
    return Episode(curve, found, info.get("avp_trajectory"))


def held_curve(values: Sequence[float], budget: int) -> NDArray[np.float64]:
    """`(T,)` values after 1 … T views, of an episode that may have stopped after v views and then holds the last."""
    return np.pad(np.asarray(values, dtype=np.float64), (0, budget - len(values)), mode="edge")


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
    """`(n,)` each: the figures of `Episode`."""
    training_run: str | None = None
    """MLflow run that trained the model."""
    observation: str | None = None
    """Kind of observation that the policy was given."""


class PolicyRunner:
    """A policy beside the environment that it fits, ready to run episodes."""

    def __init__(
        self,
        policy: str,
        simulator: Simulator,
        settings: TaskSettings,
        *,
        observation: str | None = None,
        stochastic: bool = False,
        trusted: bool = False,
    ) -> None:
        """Open a policy, by a baseline's name or a model's file, as `evaluate_policy` does.

        Raises:
            UsageError: an unknown name.
            PolicyError: the model cannot be loaded or fits no kind of observation.
        """
        self.name = check_policy(policy)
        self._deterministic = not stochastic
        self.env, self._policy = make_policy_env(
            policy, simulator, replace(settings, lookup=False), observation=observation, trusted=trusted
        )

    def run(self, seed: int) -> Episode:
        """One episode; it depends on the seed alone, not on the episodes before it."""
        policy = self._policy
        if hasattr(policy, "set_random_seed"):
            policy.set_random_seed(seed)  # type: ignore[attr-defined]
        else:
            policy = make_policy(self.name, self.env, seed)
        infos = [step.info for step in steps_of(self.env, policy, seed=seed, deterministic=self._deterministic)]
        return episode_of([info["coverage"] for info in infos], infos[-1], self.env.settings.budget)

    def result(self, episodes: Sequence[Episode], seed: int) -> PolicyResult:
        """At least one episode of this policy, stacked; the first one started from `seed`, the next from `seed + 1`."""
        return PolicyResult(
            policy=name_of(self.name),
            seeds=seed + np.arange(len(episodes)),
            curve=np.stack([episode.curve for episode in episodes]),
            figures={name: np.array([each.figures[name] for each in episodes]) for name in episodes[0].figures},
            training_run=getattr(self._policy, "avp_mlflow_run_id", None),
            observation=name_of(self.env.settings.observation),
        )


def evaluate_policy(
    policy: str,
    scene: str | Path,
    *,
    episodes: int = 20,
    seed: int = 1000,
    settings: TaskSettings | None = None,
    simulator: str = "raycast",
    gpu: int | None = None,
    navmesh: str | Path | None = None,
    up: str | None = None,
    **options: Any,
) -> PolicyResult:
    """Run a policy from fixed starts: episode i starts from `seed + i`, whatever the policy.

    Args:
        policy: a baseline's name, or a model saved by Stable-Baselines3 (`.zip`).
        scene: as `avp_habitat.scenes.location.locate` takes it.
        episodes: n, at least 1.
        seed: of the first episode.
        settings: of the task; the defaults when omitted. Visibility is computed, never looked up.
        simulator: as of `SimulatorChoice`, like the next three.
        gpu: its CUDA device.
        navmesh: file of the scene's NavMesh.
        up: axis of a mesh file that points up.
        **options: `observation` (what the model was trained on when omitted), `stochastic` (sample a model's actions
            instead of taking the likeliest), `trusted` (open a model's file also where that may run code in it).

    Raises:
        AVPError: as `make_simulator` and `PolicyRunner`.
    """
    opened = make_simulator(simulator, scene, gpu=gpu, navmesh=navmesh, up=up)
    runner = PolicyRunner(policy, opened, settings or TaskSettings(), **options)
    return runner.result([runner.run(seed + number) for number in range(episodes)], seed)
