"""The whole chain on one room: train a policy, capture with it and with two baselines, reconstruct, score, compare.

Every stage is a command line of the suite or of a host, printed before it runs. Finished stages are remembered, so an
interrupted demo goes on where it was. Takes about six minutes on two CPU cores.
"""

import argparse
import csv
import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.metrics import explained
from avp_habitat.rollout.format import read_rollout

METHODS = ("heuristic", "random", "learned")
NOT_COMPUTED = "not computed"
EXPERIMENT = "avp-demo"
_TRACKING_URI = "sqlite:///mlflow.db"


@dataclass(frozen=True)
class Settings:
    """What the results depend on; kept beside them."""

    scene: str = "builtin:0"
    """The room."""
    steps: int = 300_000
    """Environment steps of the training."""
    iterations: int = 1000
    """Of each reconstruction."""
    width: int = 192
    """Of the pictures in pixels; small, because a CPU reconstructs them."""
    height: int = 144
    """Of the pictures in pixels."""
    seed: int = 0
    """Of the training and of the episodes."""


@dataclass(frozen=True)
class Demo:
    """Where the demo's results are, and how it runs a stage."""

    settings: Settings
    folder: Path
    started: float = field(default_factory=time.monotonic)

    def run(self, title: str, *words: Any, fresh: Sequence[Path] = ()) -> None:
        """Run a command line, unless it has been done before; its output goes to the screen.

        Args:
            title: of the stage.
            *words: the program, found beside this Python, and its arguments.
            fresh: what an interrupted run of this stage may have left, removed first.

        Raises:
            AVPError: the command failed.
        """
        minutes = (time.monotonic() - self.started) / 60
        print(f"\n== {title}  [{minutes:.1f} min]", flush=True)
        marker = self.folder / ".done" / title.replace(" ", "-")
        if marker.exists():
            print("   done before")
            return
        line = [str(word) for word in words]
        print(f"   $ {shlex.join(line)}", flush=True)
        for path in fresh:
            _remove(path)
        # One tracking store for the whole chain, whatever the user's environment says; and none of the hosts' warnings
        # about each other's versions, which nobody can act on here.
        env = {**os.environ, "MLFLOW_TRACKING_URI": _TRACKING_URI, "PYTHONWARNINGS": "ignore"}
        program = Path(sys.executable).parent / line[0]
        with subprocess.Popen([str(program), *line[1:]], env=env) as stage:
            try:
                code = stage.wait()
            except KeyboardInterrupt as interrupt:
                # Ctrl-C has reached the stage too, and it ends by itself: `subprocess.run` would kill it after 0.25 s,
                # while it saves what it has. A SIGTERM has reached this program only.
                if str(interrupt):
                    stage.terminate()
                stage.wait()
                raise
        if code:
            raise AVPError(f"{title}: the command above ended with exit code {code}")
        marker.parent.mkdir(exist_ok=True)
        marker.touch()

    def train(self) -> Path:
        """PPO with the suite's callbacks; gives the model."""
        model, recording = self.folder / "learned.zip", self.folder / "training.rrd"
        options = ("--scene", self.settings.scene, "--steps", self.settings.steps, "--seed", self.settings.seed)
        observation = ("--observation", "map")
        target = ("--out", model, "--recording", recording, "--experiment", EXPERIMENT, "--run-name", "demo-training")
        line = ("python", os.path.relpath(Path(__file__).with_name("train.py")), *options, *observation, *target)
        self.run("train a policy", *line, fresh=[model, recording])
        return model

    def collect(self, method: str, model: Path) -> Path:
        """One episode of a method; gives the rollout."""
        out = self.folder / "rollouts" / method
        policy = ("--policy", model, "--stochastic") if method == "learned" else ("--policy", method)
        size = ("--width", self.settings.width, "--height", self.settings.height)
        options = ("--scene", self.settings.scene, "--seed", self.settings.seed, *size, "--out", out)
        options += ("--experiment", EXPERIMENT)
        self.run(f"collect {method}", "python", "-m", "avp_habitat.collect", *policy, *options, fresh=[out])
        return out

    def reconstruct(self, method: str, rollout: Path) -> "Reconstruction":
        """A reconstruction with equal settings for all methods, and its scores."""
        runs, scores = self.folder / "reconstructions", self.folder / "scores" / f"{method}.json"
        name = ("--output-dir", runs, "--experiment-name", method, "--timestamp", "demo")
        length = ("--max-num-iterations", self.settings.iterations)
        line = ("ns-train", "avp-nerfacto", "--data", rollout, *name, *length)
        self.run(f"reconstruct {method}", *line, fresh=[runs / method])
        config = runs / method / "avp-nerfacto" / "demo" / "config.yml"
        scores.parent.mkdir(exist_ok=True)
        line = ("ns-eval", "--load-config", config, "--output-path", scores)
        self.run(f"score {method}", *line, fresh=[scores])
        return Reconstruction(config, scores)

    def compare(self) -> None:
        """One MLflow run that compares what the experiment holds."""
        self.run("compare in MLflow", "python", "-m", "avp_habitat.tracking.compare", "--experiment", EXPERIMENT)


@dataclass(frozen=True)
class Reconstruction:
    """What a reconstruction left behind."""

    config: Path
    """nerfstudio's `config.yml`."""
    scores: Path
    """ns-eval's file."""


@dataclass(frozen=True)
class Row:
    """One method's line of the table."""

    method: str
    metrics: dict[str, float]
    """By the names used in MLflow; a score that was not computed is missing."""
    run: str | None
    """MLflow run of the reconstruction."""

    def cells(self) -> dict[str, str]:
        """The line as text."""
        columns = {
            "views": ("eval/views", ".0f", 1),
            "coverage [%]": ("eval/coverage", ".1f", 100),
            "ANND [m]": ("eval/annd_m", ".3f", 1),
            "EI [%/view]": ("eval/ei", ".2f", 100),
            "PSNR [dB]": ("eval/psnr", ".2f", 1),
            "SSIM": ("eval/ssim", ".3f", 1),
            "LPIPS": ("eval/lpips", ".3f", 1),
        }
        texts = {
            title: format(self.metrics[name] * factor, form) if name in self.metrics else NOT_COMPUTED
            for title, (name, form, factor) in columns.items()
        }
        return {"method": self.method, **texts}


def read_row(method: str, rollout: Path, reconstruction: Reconstruction) -> tuple[Row, str | None]:
    """A method's figures from its rollout and ns-eval's file; and why LPIPS is missing, if it is."""
    from avp_nerfstudio.method.scores import read_scores
    from avp_nerfstudio.tracking.mlflow import remembered_id

    meta = read_rollout(rollout).meta
    found = read_scores(reconstruction.scores)
    metrics = {f"eval/{name}": meta["metrics"][name] for name in ("views", "coverage", "annd_m", "ei", "path_length_m")}
    metrics |= {"eval/psnr": found.psnr, "eval/ssim": found.ssim}
    if found.lpips is not None:
        metrics["eval/lpips"] = found.lpips
    return Row(method, metrics, remembered_id(reconstruction.config.parent)), found.lpips_reason


def write_table(folder: Path, rows: Sequence[Row], settings: Settings) -> str:
    """The comparison as Markdown, CSV and JSON in the folder; gives the Markdown."""
    from avp_habitat.provenance import git_commit

    lines = [row.cells() for row in rows]
    titles = list(lines[0])
    width = {title: max(len(title), *(len(line[title]) for line in lines)) for title in titles}
    table = [" | ".join(title.ljust(width[title]) for title in titles), " | ".join("-" * width[t] for t in titles)]
    table += [" | ".join(line[title].ljust(width[title]) for title in titles) for line in lines]
    terms = ("coverage", "ANND", "EI", "PSNR", "SSIM", "LPIPS")
    text = "\n".join(f"| {line} |" for line in table) + f"\n\n{explained(*terms)}"
    (folder / "table.md").write_text(text + "\n", encoding="utf-8")
    with (folder / "table.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, titles)
        writer.writeheader()
        writer.writerows(lines)
    origin = {
        "settings": asdict(settings),
        "commit": git_commit(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }
    figures = {row.method: row.metrics for row in rows}
    (folder / "table.json").write_text(json.dumps({**origin, "methods": figures}, indent=2) + "\n", encoding="utf-8")
    return text


def track(demo: Demo, rows: Sequence[Row]) -> None:
    """Scores for the reconstructions' MLflow runs, which lie below those of their rollouts; then the comparison."""
    from avp_habitat.tracking.names import find_run
    from avp_habitat.tracking.opening import join_run
    from avp_habitat.tracking.stores import connect

    client = connect(_TRACKING_URI)
    for row in rows:
        known = find_run(client, row.run)
        if known is None or "eval/psnr" in known.data.metrics:
            continue
        run = join_run(_TRACKING_URI, known.info.run_id)
        scores = {name: value for name, value in row.metrics.items() if name not in known.data.metrics}
        run.metrics(scores, demo.settings.iterations - 1)
        run.close("FINISHED")
    demo.compare()


def record(demo: Demo, rollouts: Sequence[Path]) -> Path:
    """The rollouts side by side as one Rerun recording."""
    from avp_sb3.rerun.rollout import write_rollout_recording

    target = demo.folder / "rollouts.rrd"
    _remove(target)
    return write_rollout_recording(rollouts, target)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _open(argv: Sequence[str]) -> Demo:
    parser = argparse.ArgumentParser(
        description="The whole chain on one room.", formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--out", default=Path("runs/demo"), type=Path, help="folder of the results")
    for name, value in asdict(Settings()).items():
        parser.add_argument(f"--{name}", default=value, type=type(value), help=" ")
    options = vars(parser.parse_args(argv))
    folder = options.pop("out")
    settings = Settings(**options)
    known = folder / "settings.json"
    if known.exists() and json.loads(known.read_text(encoding="utf-8")) != asdict(settings):
        raise UsageError(
            f"--out {folder}: holds a demo with other settings ({known}); remove it or name another folder"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        known.write_text(json.dumps(asdict(settings), indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise AVPError(f"--out {folder}: cannot write there: {error.strerror}") from None
    return Demo(settings, folder)


def main(argv: Sequence[str]) -> None:
    """Run every stage that is not done, then compare."""
    demo = _open(argv)
    model = demo.train()
    rollouts = {method: demo.collect(method, model) for method in METHODS}
    reconstructions = {method: demo.reconstruct(method, rollouts[method]) for method in METHODS}
    found = [read_row(method, rollouts[method], reconstructions[method]) for method in METHODS]
    rows = [row for row, _ in found]
    table = write_table(demo.folder, rows, demo.settings)
    track(demo, rows)
    recording = record(demo, list(rollouts.values()))
    minutes = (time.monotonic() - demo.started) / 60
    print(f"\n== {demo.settings.scene}: {demo.settings.iterations} iterations each  [{minutes:.1f} min]\n")
    print(table)
    if reason := next((reason for _, reason in found if reason), None):
        print(f"\nLPIPS {NOT_COMPUTED}: {reason}")
    print(f"\ntable:        {demo.folder}/table.md, table.csv, table.json")
    print(f"pictures:     {demo.folder}/rollouts/*/trajectory.png")
    print(f"compare runs: .venv/bin/mlflow ui --backend-store-uri {_TRACKING_URI}")
    print(f"trajectories: .venv/bin/rerun {recording}")
    print(f"training:     .venv/bin/rerun {demo.folder}/training.rrd")


if __name__ == "__main__":
    sys.exit(command.run(main))
