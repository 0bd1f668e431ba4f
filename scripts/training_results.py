"""Train every configuration of the training results with several seeds, evaluate all, and write tables and pictures.

What is done is not done again: interrupted and started once more, it goes on with what is missing. Tables and pictures
are made from what the results' folder holds: `episodes.csv` (figures of each episode) and `curves.json` (mean coverage
by view).
"""

import csv
import itertools
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.scenes.location import HOME, ROOM

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


def draw_comparison(stored: Sequence[tuple[Any, Any]], picture: Path) -> None:
    """Mean coverage by view: baselines dashed, learned policies solid, a dot where those that stop do so on average."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.8), layout="constrained")
    axes = figure.subplots()
    for result, half_width in stored:
        learned = result.policy not in BASELINES
        mean, half = 100 * result.curve[0], 100 * half_width
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


def store(folder: Path, results: Sequence[Any], about: dict[str, Any]) -> None:
    """Write what tables and pictures need of a scene's evaluations: `episodes.csv` and `curves.json`."""
    from avp_sb3.evaluation.report import write_report

    shutil.rmtree(folder, ignore_errors=True)
    write_report(folder, results, about)
    shorten(folder)


def shorten(folder: Path) -> None:
    """Replace a report's `evaluation.json`, which has every view of every episode, by the mean curves in it."""
    path = folder / "evaluation.json"
    known = json.loads(path.read_text(encoding="utf-8"))
    rows = [
        {name: one[name] for name in ("policy", "observation", "training_run")}
        | {name: [float(f"{value:.6g}") for value in values] for name, values in one["curve"].items()}
        for one in known.pop("policies")
    ]
    lines = ",\n".join(json.dumps(row) for row in rows)
    text = f'{{"about": {json.dumps(known)},\n"policies": [\n{lines}\n]}}\n'
    (folder / "curves.json").write_text(text, encoding="utf-8")
    path.unlink()


def read_stored(folder: Path) -> list[tuple[Any, Any]]:
    """By policy: its result with the mean curve `(1, views)` in place of each episode's, and the curve's half width."""
    from avp_sb3.evaluation.policy import PolicyResult

    with (folder / "episodes.csv").open(newline="", encoding="utf-8") as file:
        episodes = list(csv.DictReader(file))
    found = []
    for row in json.loads((folder / "curves.json").read_text(encoding="utf-8"))["policies"]:
        mine = [episode for episode in episodes if episode["policy"] == row["policy"]]
        seeds = np.array([int(episode["seed"]) for episode in mine])
        names = [name for name in episodes[0] if name not in ("policy", "seed")]
        figures = {name: np.array([float(episode[name]) for episode in mine]) for name in names}
        curve = np.array([row["mean"]])
        result = PolicyResult(row["policy"], seeds, curve, figures, row["training_run"], row["observation"])
        found.append((result, np.array(row["half_width"])))
    return found


def write_tables(out: Path, scenes: Sequence[str]) -> None:
    """Tables and pictures of coverage from what is stored.

    Args:
        out: the results' folder.
        scenes: their names.
    """
    from avp_sb3.evaluation.report import table

    folders = {name: out / _slug(name) for name in scenes}
    about = json.loads((folders[scenes[0]] / "curves.json").read_text(encoding="utf-8"))["about"]
    text = [
        "# Training results",
        "",
        f"Made by `{about['command']}`; seeds, commit, machine and versions: the JSON files.",
    ]
    for name, folder in folders.items():
        stored = read_stored(folder)
        (folder / "table.md").write_text(table([result for result, _ in stored]) + "\n", encoding="utf-8")
        draw_comparison(stored, folder / "coverage.png")
        picture = f"![coverage by view]({folder.name}/coverage.png)"
        text += ["", f"## {name}", "", picture, "", _transposed(table([result for result, _ in stored]))]
    text += ["", "## While training", "", "![training curves](training_curves.png)", ""]
    (out / "README.md").write_text("\n".join(text), encoding="utf-8")


def write_results(options: "TrainingResults", trainings: Sequence[Trained]) -> None:
    """Everything in the results' folder, from models, evaluations and MLflow."""
    from avp_sb3.evaluation.report import read_report

    about = {"command": shlex.join(["python", "scripts/training_results.py", *sys.argv[1:]]), "seed": FIRST_SEED}
    options.out.mkdir(parents=True, exist_ok=True)
    for scene in options.scenes:
        results = read_report(_report(options.work, "baselines", scene))
        for _, group in itertools.groupby(trainings, key=lambda training: training.configuration):
            results.append(pooled(list(group), options.work, scene))
        store(options.out / _slug(scene), results, about | {"scene": {"name": Path(scene).name}})
    write_tables(options.out, [Path(scene).name for scene in options.scenes])
    draw_training_curves(trainings, options.out / "training_curves.png")
    configurations = [asdict(configuration) for configuration in CONFIGURATIONS]
    text = json.dumps(configurations, indent=1) + "\n"
    (options.out / "configurations.json").write_text(text, encoding="utf-8")


def _slug(scene: str) -> str:
    return Path(scene).stem.replace(":", "_")


def _report(work: Path, name: str, scene: str) -> Path:
    """The folder of an evaluation on a scene."""
    return work / f"{name}-on-{_slug(scene)}"


def _transposed(markdown: str) -> str:
    """A Markdown table with rows and columns exchanged: one policy on a line."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in markdown.splitlines()]
    columns = list(zip(rows[0], *rows[2:], strict=True))
    lines = [columns[0], tuple("---" for _ in columns[0]), *columns[1:]]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


@dataclass(frozen=True)
class TrainingResults:
    """Train every configuration of the training results with several seeds, evaluate all, write tables and pictures."""

    scene: str = "../shared/scenes/white_room.glb"
    """Trained in, and evaluated on."""
    unseen: str = "../shared/scenes/grey_white_room.glb"
    """Evaluated on, never trained in."""
    rooms: int = 16
    """Generated rooms of the configurations with many, builtin:0 upwards."""
    jobs: Annotated[int, Range(1, 1024)] = 2
    """Trainings or evaluations at a time."""
    work: Path = Path("runs/training-results")
    """Models, logs and evaluations."""
    out: Path = Path("docs/results/training")
    """Tables and pictures."""
    only: str = ""
    """Configurations whose names contain this; writes no tables."""
    stored: bool = False
    """Only make tables and pictures of coverage again, from what lies in --out."""

    def __post_init__(self) -> None:
        """Hold the ranges."""
        hold_ranges(self)

    @property
    def scenes(self) -> tuple[str, str]:
        """Evaluated on."""
        return self.scene, self.unseen


def main(options: TrainingResults) -> None:
    """Train, evaluate, write."""
    if options.stored:
        write_tables(options.out, [Path(scene).name for scene in options.scenes])
        return
    for scene in options.scenes:
        if not scene.startswith((ROOM, HOME)) and not (ROOT / scene).is_file():
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
    tasks = [
        partial(evaluate, scene, BASELINES, _report(options.work, "baselines", scene), "coverage")
        for scene in options.scenes
    ]
    for scene, reward in itertools.product(options.scenes, sorted({t.configuration.reward for t in trainings})):
        models = [str(training.model) for training in trainings if training.configuration.reward == reward]
        tasks.append(partial(evaluate, scene, models, _report(options.work, reward, scene), reward))
    in_parallel(options.jobs, "evaluating", tasks)
    if not options.only:
        write_results(options, trainings)
        print(f"{options.out}: tables and pictures")


if __name__ == "__main__":
    sys.exit(command.run(main))
