"""`python -m avp_experiment.compare`: train, collect, reconstruct and compare; `mlflow run . -e compare`."""

import os
import shlex
import sys
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from avp_experiment.cells import plan
from avp_experiment.configuration import DEFAULT, PRESETS, ROOMS, Configuration, chosen_methods, read_scenes
from avp_experiment.folder import open_folder
from avp_experiment.runner import PRELOAD, Runner, environment
from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError, unknown_name
from avp_habitat.metrics import METRICS_HELP, find_metrics
from avp_habitat.scenes.location import UP_HELP
from avp_habitat.simulators.registry import SIMULATORS, SimulatorChoice

AUTO = "auto"
NONE = "none"
_METHODS = f"with commas between: policies, rewards, rewards with {ROOMS}, module:object; auto: {', '.join(DEFAULT)}"


@dataclass(frozen=True)
class Compare:
    """Train every reward, let all methods take views from the same starts, reconstruct, score and compare.

    Writes tables, figures and the answers to the paper's questions. What is done is not done again.
    """

    scene: str = "builtin:0"
    """Scenes to train in, with commas between."""
    unseen: str = "builtin:1"
    """Scenes never trained in, with commas between, or none."""
    preset: Annotated[str, arg(help=", ".join(PRESETS))] = "cpu"
    seeds: str = AUTO
    """Trainings of each reward; auto: the preset's number."""
    starts: str = AUTO
    """Episodes of each method, scene and seed; auto: the preset's number."""
    methods: Annotated[str, arg(help=_METHODS)] = AUTO
    metrics: Annotated[str, arg(help=f"with commas between, or none: {METRICS_HELP}")] = NONE
    simulator: Annotated[str, arg(help=f"{', '.join(SIMULATORS)} or MODULE:FACTORY")] = "raycast"
    up: Annotated[str | None, arg(help=UP_HELP)] = None
    out: str = AUTO
    """The experiment's folder, also of one to go on with; auto: runs/experiment-PRESET."""
    jobs: str = AUTO
    """Cells at a time; auto: one per core."""

    def configuration(self) -> Configuration:
        """Everything that can be known to be wrong is refused here, before anything is written.

        Raises:
            UsageError: an option cannot be right.
            AVPError: a scene cannot be used.
        """
        if self.preset not in PRESETS:
            raise unknown_name("preset", self.preset, PRESETS)
        methods = chosen_methods(DEFAULT if self.methods == AUTO else _split(self.methods))
        preset = PRESETS[self.preset]
        preset = replace(preset, seeds=_number("seeds", self.seeds, preset.seeds))
        preset = replace(preset, starts=_number("starts", self.starts, preset.starts))
        choice = SimulatorChoice(self.simulator, up=self.up)
        metrics = _split(self.metrics)
        find_metrics(metrics)
        scenes = read_scenes(_split(self.scene), _split(self.unseen), choice)
        return Configuration(self.preset, preset, scenes, methods, tuple(metrics), self.simulator, self.up)

    @property
    def line(self) -> str:
        """The command line as a user types it."""
        given = {field.name: (getattr(self, field.name), field.default) for field in fields(self)}
        chosen = {name: str(value) for name, (value, default) in given.items() if value != default}
        if os.environ.get("MLFLOW_RUN_ID"):
            options = [f"-P {name}={shlex.quote(value)}" for name, value in chosen.items()]
            return " ".join(["mlflow run . -e compare --env-manager local", *options])
        options = [word for name, value in chosen.items() for word in (f"--{name}", value)]
        return shlex.join(["python", "-m", "avp_experiment.compare", *options])


def _split(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip() not in ("", NONE)]


def _number(option: str, text: str, auto: int) -> int:
    if text == AUTO:
        return auto
    if not text.isdecimal() or int(text) < 1:
        raise UsageError(f"{option}: expected a whole number from 1, or {AUTO}, got {text!r}")
    return int(text)


def compare(configuration: Configuration, out: Path, *, jobs: int, line: str) -> None:
    """Do what is left, `jobs` cells at a time, then write tables and figures and log them with the command's line.

    Raises:
        AVPError: the folder cannot be used, or some cells failed; the others are done then.
    """
    from avp_experiment.report import write_report
    from avp_experiment.results import gather
    from avp_experiment.tracking import log_results, open_parent, tracking_uri

    folder = open_folder(configuration, out)
    with folder.alone():
        folder.check_disk(plan(configuration, out, tracking="?"), configuration)
        parent, experiment = open_parent(f"compare {configuration.preset_name}")
        status = "FAILED"
        try:
            cells = plan(configuration, out, tracking=experiment)
            preload = () if SimulatorChoice(configuration.simulator).one_per_process else PRELOAD
            runner = Runner(folder, jobs, environment(tracking_uri()), preload)
            runner.run(cells)
            results = gather(configuration, folder, cells, command=line)
            write_report(out)
            log_results(parent, experiment, results, out)
            status = "FINISHED"
        except KeyboardInterrupt:
            status = "KILLED"
            print(f"\nwhat is done is kept in {out}; to go on:  {line}", file=sys.stderr)
            raise
        finally:
            parent.close(status)
    print(f"results:      {out}/results.md (tables, figures, claims; from {out}/results.json)")
    print(f"MLflow run:   {parent.run_id}")
    if runner.failed:
        raise AVPError(
            f"{len(runner.failed)} of {len(cells)} cells failed (reasons: {out}/results.md); "
            f"the same command tries them again"
        )


def main(options: Compare) -> None:
    """Compare."""
    began = time.monotonic()
    configuration = options.configuration()
    out = Path("runs") / f"experiment-{options.preset}" if options.out == AUTO else Path(options.out)
    jobs = _number("jobs", options.jobs, len(os.sched_getaffinity(0)))
    compare(configuration, out, jobs=jobs, line=options.line)
    print(f"done in {(time.monotonic() - began) / 60:.1f} min")


if __name__ == "__main__":
    sys.exit(command.run(main))
