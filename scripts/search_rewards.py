"""Search the rewards' constants: train with random ones, score the policies, log every trial to MLflow."""

import json
import multiprocessing
import os
import platform
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tqdm import tqdm
from tyro.conf import arg

from avp_habitat import command
from avp_habitat.provenance import git_commit
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.task.rewards import RewardConstants
from avp_habitat.task.settings import TaskSettings

EXPERIMENT = "avp-reward-search"
VIEWS_WEIGHT = 0.3
"""Worth of the whole budget of views beside the whole floor: one view fewer is worth 0.375 percentage points."""
_RANGES = {
    "alpha_proposed": (0.001, 0.02),
    "stop_bonus": (0.5, 5.0),
    "stop_per_step_left": (0.01, 0.1),
    "step": (0.005, 0.05),
    "spread": (0.0003, 0.01),
    "redundancy": (0.005, 0.1),
    "early_stop": (0.003, 0.05),
    "collision": (0.02, 0.2),
}
"""Drawn log-uniformly; β is drawn uniformly within (0.7, 0.95)."""


@dataclass(frozen=True)
class Trial:
    """One training with its own constants."""

    number: int
    """From 0; number 0 uses the constants as they are."""
    constants: RewardConstants
    """Of the rewards."""
    scenes: tuple[str, ...]
    """Where the policy is trained and scored."""
    steps: int
    """Environment steps."""
    seed: int
    """Of the policy and the starts."""


def draw_constants(number: int, seed: int) -> RewardConstants:
    """The constants of a trial; number 0 is what the project uses now."""
    if number == 0:
        return RewardConstants()
    rng = np.random.default_rng([seed, number])
    drawn = {name: float(np.exp(rng.uniform(np.log(low), np.log(high)))) for name, (low, high) in _RANGES.items()}
    drawn["beta"] = float(rng.uniform(0.7, 0.95))
    return replace(RewardConstants(), **{name: float(f"{value:.3g}") for name, value in drawn.items()})


def score(coverage: float, views: float, budget: int) -> float:
    """What a policy is worth: its coverage, less the share of the budget that it used (episodes without stop use all).

    Args:
        coverage: mean final coverage within [0, 1].
        views: mean views.
        budget: T.
    """
    return coverage - VIEWS_WEIGHT * views / budget


def run_trial(trial: Trial) -> dict[str, Any]:
    """Train, score and log one trial; gives its constants and figures."""
    # Late: each process of the pool loads these once, with one thread.
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor

    from avp_sb3 import AVPVecEnv, MetricsCallback, MLflowCallback
    from avp_sb3.presets import MAP

    torch.set_num_threads(1)
    settings = TaskSettings(reward="proposed", observation="map", lookup=True, constants=trial.constants)
    env = VecMonitor(AVPVecEnv(trial.scenes, agents=MAP.n_envs, settings=settings, seed=trial.seed))
    model = PPO("MlpPolicy", env, device="cpu", seed=trial.seed, **MAP.arguments())
    tags = {"trial": str(trial.number)}
    with MLflowCallback(EXPERIMENT, run_name=f"trial-{trial.number}", log_model=False, tags=tags) as tracking:
        model.learn(trial.steps, callback=[tracking, MetricsCallback()])
    figures = _evaluate(model, trial.scenes, settings)
    figures["score"] = score(figures["coverage"], figures["views"], settings.budget)
    _log(tracking.run_id, figures)
    about = {"run": tracking.run_id, "commit": git_commit(), "steps": trial.steps, "scenes": _names(trial.scenes)}
    return {"trial": trial.number, "seed": trial.seed, **about, "constants": asdict(trial.constants), **figures}


def _names(scenes: Sequence[str]) -> list[str]:
    """Scenes without their folders."""
    return [Path(scene).name for scene in scenes]


def is_done(trial: Trial, done: Sequence[dict[str, Any]]) -> bool:
    """Whether a trial's figures are known."""
    wanted = (trial.seed, trial.steps, _names(trial.scenes), asdict(trial.constants))
    return any((one["seed"], one["steps"], one["scenes"], one["constants"]) == wanted for one in done)


def write(out: Path, done: Sequence[dict[str, Any]]) -> None:
    """JSON, and beside it the same as a Markdown table, the best trial first."""
    trials = sorted(done, key=lambda trial: -trial["score"])
    out.parent.mkdir(parents=True, exist_ok=True)
    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    about = {"command": shlex.join(["python", "scripts/search_rewards.py", *sys.argv[1:]]), "machine": machine}
    out.write_text(json.dumps({**about, "trials": trials}, indent=1) + "\n", encoding="utf-8")
    varied = [*_RANGES, "beta"]
    figures = ["score", "coverage", "views", "stopped"]
    lines = [f"| {' | '.join(['trial', *figures, *varied])} |", "|" + " --- |" * (1 + len(figures) + len(varied))]
    for trial in trials:
        values = [*(trial[name] for name in figures), *(trial["constants"][name] for name in varied)]
        lines.append(f"| {trial['trial']} | {' | '.join(f'{value:.3g}' for value in values)} |")
    out.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def read(out: Path) -> list[dict[str, Any]]:
    """The trials of an earlier call."""
    return json.loads(out.read_text(encoding="utf-8"))["trials"] if out.exists() else []


def _evaluate(model: Any, scenes: Sequence[str], settings: TaskSettings, episodes: int = 64) -> dict[str, float]:
    """Mean figures of one sampled episode from each of 64 fixed starts."""
    from avp_sb3 import AVPVecEnv

    env = AVPVecEnv(scenes, agents=episodes, settings=settings, seed=1000)
    observation, first = env.reset(), {}
    for _ in range(settings.budget):
        observation, _, done, infos = env.step(model.predict(observation, deterministic=False)[0])
        for index in np.flatnonzero(done):
            first.setdefault(int(index), infos[index]["avp_episode"])
    means = {name: float(np.mean([episode[name] for episode in first.values()])) for name in first[0]}
    return {name: means[name] for name in ("coverage", "views", "stopped", "annd_m", "collisions")}


def _log(run: str | None, figures: dict[str, float]) -> None:
    import mlflow

    client = mlflow.MlflowClient()
    for name, value in figures.items():
        client.log_metric(str(run), f"search/{name}", value)


@dataclass(frozen=True)
class SearchRewards:
    """Search the rewards' constants: train with random ones, score the policies, log every trial to MLflow."""

    scene: Annotated[tuple[str, ...], arg(help=SCENES)]
    trials: int = 12
    """Trainings, the first with the constants in use."""
    steps: int = 400_000
    """Environment steps of each."""
    jobs: int = 2
    """Trainings at a time."""
    seed: int = 0
    """Of the draws, the policies and the starts."""
    out: Path = Path("docs/results/reward_search.json")
    """All trials, the best first."""


def main(options: SearchRewards) -> None:
    """Run the trials that are not in the output file yet; what is done is kept after Ctrl-C."""
    os.environ.setdefault("MLFLOW_TRACKING_URI", "sqlite:///mlflow.db")
    os.environ["OMP_NUM_THREADS"] = "1"
    done = read(options.out)
    trials = [
        Trial(number, draw_constants(number, options.seed), options.scene, options.steps, options.seed)
        for number in range(options.trials)
    ]
    trials = [trial for trial in trials if not is_done(trial, done)]
    # Made before the processes start: two that make one sqlite file's tables at a time get in each other's way.
    import mlflow

    if mlflow.get_experiment_by_name(EXPERIMENT) is None:
        mlflow.create_experiment(EXPERIMENT)
    # Forked processes would share MLflow's and Open3D's threads.
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool, tqdm(total=len(trials), unit="trial") as bar:
        for result in pool.imap_unordered(run_trial, trials):
            done.append(result)
            bar.update()
            bar.write(f"trial {result['trial']}: score {result['score']:.3f}")
            write(options.out, done)
    write(options.out, done)
    print(f"{options.out}: {len(done)} trials, in MLflow's experiment {EXPERIMENT!r}")


if __name__ == "__main__":
    sys.exit(command.run(main))
