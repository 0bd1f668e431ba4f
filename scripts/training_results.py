"""Train every configuration of the training results with several seeds, evaluate all, and write tables and pictures.

What is done is not done again: interrupted and started once more, it goes on with what is missing.
"""

import argparse
import itertools
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.metrics import mean_and_half_width

ROOT = Path(__file__).resolve().parent.parent
BASELINES = ("heuristic", "random", "spin", "frontier", "greedy", "oracle")
EXPERIMENT = "avp-training-results"
EPISODES, FIRST_SEED = 20, 1000
CURVES = {"coverage": "coverage", "coverage_redundancy": "coverage + redundancy", "proposed": "proposed"}
"""Rewards in the picture of training curves, with their labels."""


@dataclass(frozen=True)
class Configuration:
    """One way to train."""

    name: str
    """In files and tables."""
    reward: str
    """The reward's name."""
    observation: str
    """The observation's name."""
    rooms: str
    """one: trained in the scene of the results; many: in generated rooms, never in it."""
    steps: int
    """Environment steps."""
    seeds: int
    """How many of the training seeds; fewer for what is only shown beside."""


CONFIGURATIONS = (
    Configuration("coverage, 12 numbers", "coverage", "numbers", "one", 1_250_000, 3),
    Configuration("coverage, map", "coverage", "map", "one", 700_000, 3),
    Configuration("coverage + redundancy, map", "coverage_redundancy", "map", "one", 400_000, 1),
    Configuration("proposed, 12 numbers", "proposed", "numbers", "one", 300_000, 3),
    Configuration("proposed, map", "proposed", "map", "one", 700_000, 3),
    Configuration("coverage, map, many rooms", "coverage", "map", "many", 1_800_000, 1),
    Configuration("proposed, map, many rooms", "proposed", "map", "many", 1_400_000, 2),
)


@dataclass(frozen=True)
class Trained:
    """A configuration with a seed, and its files."""

    configuration: Configuration
    """How it is trained."""
    seed: int
    """Of the policy and the starts."""
    folder: Path
    """Where its files lie."""

    @property
    def key(self) -> str:
        """For files."""
        return f"{self.configuration.name.replace(', ', '-').replace(' + ', '_').replace(' ', '_')}-{self.seed}"

    @property
    def model(self) -> Path:
        """The policy."""
        return self.folder / f"{self.key}.zip"

    @property
    def marker(self) -> Path:
        """Exists once the training is complete."""
        return self.folder / f"{self.key}.done"

    def train(self, scene: str, rooms: Sequence[str]) -> None:
        """Train, or go on with an interrupted training."""
        if self.marker.exists():
            return
        how = self.configuration
        words = ["python", "-m", "avp_sb3.train", "--scene", *([scene] if how.rooms == "one" else rooms)]
        words += ["--reward", how.reward, "--observation", how.observation, "--steps", str(how.steps)]
        words += ["--seed", str(self.seed), "--out", str(self.model), "--experiment", EXPERIMENT]
        words += ["--run-name", f"{how.name} (seed {self.seed})"]
        run(words + (["--resume", str(self.model)] if self.model.exists() else []), self.folder / f"{self.key}.log")
        self.marker.touch()


def run(words: Sequence[str], log: Path) -> None:
    """Run a command of the project in its root; its output goes to a file.

    Raises:
        AVPError: it failed.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    line = [sys.executable, *words[1:]]
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    with log.open("a", encoding="utf-8") as file:
        file.write(f"$ {shlex.join(words)}\n")
        file.flush()
        code = subprocess.run(line, cwd=ROOT, env=env, stdout=file, stderr=file, check=False).returncode
    if code:
        raise AVPError(f"{shlex.join(words)}: exit code {code}; see {log}")


def evaluate(scene: str, policies: Sequence[str], out: Path, reward: str) -> None:
    """Evaluate policies on a scene, once."""
    if out.exists():
        return
    words = ["python", "-m", "avp_sb3.evaluate", "--scene", scene, "--reward", reward, "--stochastic", "--no-mlflow"]
    words += ["--episodes", str(EPISODES), "--seed", str(FIRST_SEED), "--out", str(out)]
    run(words + [word for policy in policies for word in ("--policy", policy)], out.with_suffix(".log"))


def in_parallel(jobs: int, title: str, tasks: Sequence[Any]) -> None:
    """Call functions of no arguments, `jobs` at a time, with a progress bar."""
    with ThreadPoolExecutor(jobs) as pool, tqdm(total=len(tasks), desc=title, unit="job") as bar:
        futures = [pool.submit(task) for task in tasks]
        try:
            for future in futures:
                future.result()
                bar.update()
        except BaseException:
            for future in futures:
                future.cancel()
            raise


def pooled(trainings: Sequence[Trained], work: Path, scene: str) -> Any:
    """The results of all seeds of a configuration on a scene, as one."""
    from avp_sb3.evaluation.report import read_report

    found = {part.policy: part for part in read_report(_report(work, trainings[0].configuration.reward, scene))}
    parts = [found[str(training.model)] for training in trainings]
    return replace(
        parts[0],
        policy=trainings[0].configuration.name,
        seeds=np.concatenate([part.seeds for part in parts]),
        curve=np.concatenate([part.curve for part in parts]),
        figures={name: np.concatenate([part.figures[name] for part in parts]) for name in parts[0].figures},
    )


def draw_training_curves(trainings: Sequence[Trained], picture: Path) -> None:
    """CpV and mean episode reward while training, for the three rewards with the map in one room, from MLflow."""
    from matplotlib.figure import Figure
    from mlflow import MlflowClient

    client = MlflowClient(os.environ["MLFLOW_TRACKING_URI"])
    figure = Figure(figsize=(11, 4), layout="constrained")
    columns = figure.subplots(1, 2)
    titles = {"avp/cpv": "CpV [% per view]", "rollout/ep_rew_mean": "mean episode reward, share of its last value"}
    for axes, (metric, title) in zip(columns, titles.items(), strict=True):
        for reward, label in CURVES.items():
            chosen = [t for t in trainings if t.configuration.name == f"{label}, map"]
            curves = [_history(client, training, metric) for training in chosen]
            steps = np.linspace(max(c[0][0] for c in curves), min(c[0][-1] for c in curves), 200)
            values = np.array([np.interp(steps, *curve) for curve in curves])
            if metric == "rollout/ep_rew_mean":
                values /= np.abs(values[:, -10:].mean())
            (line,) = axes.plot(steps / 1000, values.mean(axis=0), label=f"{reward} ({len(curves)} seeds)")
            low, high = values.min(axis=0), values.max(axis=0)
            axes.fill_between(steps / 1000, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
        axes.set(xlabel="environment steps [thousands]", ylabel=title)
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(picture, dpi=120)


def draw_comparison(results: Sequence[Any], picture: Path) -> None:
    """Mean coverage by view: baselines dashed, learned policies solid, a dot where those that stop do so on average."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.8), layout="constrained")
    axes = figure.subplots()
    for result in results:
        learned = result.policy not in BASELINES
        mean, half = mean_and_half_width(100 * result.curve)
        views = np.arange(1, len(mean) + 1)
        label = f"{result.policy} ({len(result.seeds)} episodes)"
        (line,) = axes.plot(views, mean, "-" if learned else "--", linewidth=2 if learned else 1.2, label=label)
        if learned:
            axes.fill_between(views, mean - half, mean + half, color=line.get_color(), alpha=0.15, linewidth=0)
        if result.figures["stopped"].any():
            end = float(result.figures["views"].mean())
            axes.plot(end, np.interp(end, views, mean), "o", color=line.get_color())
    axes.set(xlabel="views", ylabel="coverage [%]", ylim=(0, 100), xlim=(1, len(mean)))
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(picture, dpi=120)


def _history(client: Any, training: Trained, metric: str) -> tuple[list[int], list[float]]:
    """Steps and values of a metric in a training's run, and in those that it continued."""
    from stable_baselines3 import PPO

    run_id = PPO.load(training.model, device="cpu").avp_mlflow_run_id  # type: ignore[attr-defined]
    points = []
    while run_id is not None:
        points += [(point.step, point.value) for point in client.get_metric_history(run_id, metric)]
        run_id = client.get_run(run_id).data.tags.get("avp.continued_from")
    points.sort()
    return [step for step, _ in points], [value for _, value in points]


def write_results(options: argparse.Namespace, trainings: Sequence[Trained], argv: Sequence[str]) -> None:
    """Tables, JSON, and pictures in the results' folder."""
    from avp_sb3.evaluation.report import read_report, table, write_report

    about = {"command": shlex.join(["python", "scripts/training_results.py", *argv]), "seed": FIRST_SEED}
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    text = [
        "# Training results",
        "",
        f"Made by `{about['command']}`; seeds, commit, machine and versions: the JSON files.",
    ]
    for scene in (options.scene, options.unseen):
        name = Path(scene).stem.replace(":", "_")
        results = read_report(_report(options.work, "baselines", scene))
        for _, group in itertools.groupby(trainings, key=lambda training: training.configuration):
            results.append(pooled(list(group), options.work, scene))
        folder = out / name
        if folder.exists():
            for file in folder.iterdir():
                file.unlink()
            folder.rmdir()
        write_report(folder, results, about | {"scene": {"name": Path(scene).name}})
        draw_comparison(results, folder / "coverage.png")
        text += [
            "",
            f"## {Path(scene).name}",
            "",
            f"![coverage by view]({name}/coverage.png)",
            "",
            _transposed(table(results)),
        ]
    draw_training_curves(trainings, out / "training_curves.png")
    text += ["", "## While training", "", "![training curves](training_curves.png)", ""]
    (out / "README.md").write_text("\n".join(text), encoding="utf-8")
    (out / "configurations.json").write_text(
        json.dumps([c.__dict__ for c in CONFIGURATIONS], indent=1) + "\n", encoding="utf-8"
    )


def _report(work: Path, name: str, scene: str) -> Path:
    """The folder of an evaluation on a scene."""
    return work / f"{name}-on-{Path(scene).stem.replace(':', '_')}"


def _transposed(markdown: str) -> str:
    """A Markdown table with rows and columns exchanged: one policy on a line."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in markdown.splitlines()]
    columns = list(zip(rows[0], *rows[2:], strict=True))
    lines = [columns[0], tuple("---" for _ in columns[0]), *columns[1:]]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    add = parser.add_argument
    add("--scene", default="../shared/scenes/white_room.glb", help="trained in, and evaluated on")
    add("--unseen", default="../shared/scenes/grey_white_room.glb", help="evaluated on, never trained in")
    add("--rooms", default=16, type=int, help="generated rooms of the configurations with many, builtin:0 upwards")
    add("--jobs", default=2, type=int, help="trainings or evaluations at a time")
    add("--work", default=Path("runs/training-results"), type=Path, help="models, logs and evaluations")
    add("--out", default=Path("docs/results/training"), type=Path, help="tables and pictures")
    add("--only", default="", help="configurations whose names contain this")
    return parser


def main(argv: Sequence[str]) -> None:
    """Train, evaluate, write."""
    options = _parser().parse_args(argv)
    for scene in (options.scene, options.unseen):
        if not scene.startswith("builtin:") and not (ROOT / scene).is_file():
            raise UsageError(f"{scene}: no such file")
    os.environ.setdefault("MLFLOW_TRACKING_URI", f"sqlite:///{(ROOT / options.work / 'mlflow.db').resolve()}")
    options.work.mkdir(parents=True, exist_ok=True)
    import mlflow

    # Made before the processes start: two that make one sqlite file's tables at a time get in each other's way.
    if mlflow.get_experiment_by_name(EXPERIMENT) is None:
        mlflow.create_experiment(EXPERIMENT)
    rooms = [f"builtin:{seed}" for seed in range(options.rooms)]
    trainings = [
        Trained(configuration, seed, options.work)
        for configuration in CONFIGURATIONS
        if options.only in configuration.name
        for seed in range(configuration.seeds)
    ]
    longest = sorted(trainings, key=lambda training: -training.configuration.steps)
    in_parallel(options.jobs, "training", [partial(training.train, options.scene, rooms) for training in longest])
    scenes = (options.scene, options.unseen)
    tasks = [
        partial(evaluate, scene, BASELINES, _report(options.work, "baselines", scene), "coverage") for scene in scenes
    ]
    for scene, reward in itertools.product(scenes, sorted({t.configuration.reward for t in trainings})):
        models = [str(training.model) for training in trainings if training.configuration.reward == reward]
        tasks.append(partial(evaluate, scene, models, _report(options.work, reward, scene), reward))
    in_parallel(options.jobs, "evaluating", tasks)
    if not options.only:
        write_results(options, trainings, argv)
        print(f"{options.out}: tables and pictures")


if __name__ == "__main__":
    sys.exit(command.run(main))
