"""`python -m avp_experiment.compare`: train, collect, reconstruct and compare; `mlflow run . -e compare`."""

import argparse
import os
import shlex
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from avp_experiment.cells import Cell, plan
from avp_experiment.configuration import DEFAULT, METHODS, Configuration, chosen_methods, keep, read_scenes
from avp_experiment.presets import PRESETS, preset_named
from avp_experiment.runner import PRELOAD, Runner, default_jobs
from avp_experiment.store import Store, bytes_needed
from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.rollout.capture import VIEWS
from avp_habitat.simulators.registry import SIMULATORS, SimulatorChoice, add_up_option

if TYPE_CHECKING:
    from avp_experiment.tracking import Parent

AUTO = "auto"
NONE = "none"


@dataclass(frozen=True)
class Options:
    """What was asked for."""

    configuration: Configuration
    """Of the experiment."""
    out: Path
    """Its folder."""
    jobs: int
    """Cells at a time."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m avp_experiment.compare", description=__doc__)
    add = parser.add_argument
    add("--scene", default="builtin:0", help="scenes to train in, with commas between (default: %(default)s)")
    add("--unseen", default="builtin:1", help="scenes never trained in, with commas between, or none (%(default)s)")
    add("--preset", default="cpu", help=f"{', '.join(PRESETS)} (default: %(default)s)")
    add("--seeds", default=AUTO, help="trainings of each reward; auto: the preset's (default: %(default)s)")
    add("--starts", default=AUTO, help="episodes of each method, scene and seed; auto: the preset's")
    add("--methods", default=AUTO, help=f"with commas between, of {', '.join(METHODS)}; auto: {', '.join(DEFAULT)}")
    add("--simulator", default="raycast", help=f"{', '.join(SIMULATORS)} or MODULE:FACTORY (default: %(default)s)")
    add_up_option(parser)
    add(
        "--out",
        default=AUTO,
        help="the experiment's folder, also of one to go on with (default: runs/experiment-PRESET)",
    )
    add("--jobs", default=AUTO, help="cells at a time; auto: one per core (default: %(default)s)")
    return parser


def read_options(argv: Sequence[str]) -> Options:
    """Everything that can be known to be wrong is refused here, before anything is written.

    Raises:
        UsageError: an option cannot be right.
        AVPError: a scene cannot be used.
    """
    given = _parser().parse_args(argv)
    preset = preset_named(given.preset)
    methods = chosen_methods(DEFAULT if given.methods == AUTO else _split(given.methods))
    seeds = preset.seeds if given.seeds == AUTO else _number("seeds", given.seeds)
    if given.starts != AUTO:
        preset = replace(preset, starts=_number("starts", given.starts))
    jobs = default_jobs() if given.jobs == AUTO else _number("jobs", given.jobs)
    SimulatorChoice(given.simulator)
    unseen = [] if given.unseen == NONE else _split(given.unseen)
    scenes = read_scenes(_split(given.scene), unseen, SimulatorChoice(given.simulator, up=given.up))
    out = Path("runs") / f"experiment-{given.preset}" if given.out == AUTO else Path(given.out)
    configuration = Configuration(given.preset, preset, seeds, scenes, methods, given.simulator, given.up)
    return Options(configuration, out, jobs)


def _split(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _number(option: str, text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise UsageError(f"{option}: expected a whole number from 1, or {AUTO}, got {text!r}")
    return int(text)


def check_disk(options: Options, store: Store, cells: Sequence[Cell]) -> None:
    """Refuse to begin what the disk cannot hold.

    Raises:
        AVPError: there is too little room.
    """
    preset, (width, height) = options.configuration.preset, options.configuration.preset.size
    left = [cell for cell in cells if not store.is_done(cell)]
    needed = bytes_needed(left, width=width, height=height, budget=preset.budget, heldout=VIEWS)
    free = shutil.disk_usage(options.out).free
    if needed > free:
        raise AVPError(
            f"out: {options.out}: the {len(left)} cells to do need about {_size(needed)}, and {_size(free)} are free "
            "there; name a folder on another disk, or a smaller preset, fewer seeds, starts or methods"
        )
    print(f"{len(left)} of {len(cells)} cells to do, about {_size(needed)} of disk ({_size(free)} free): {options.out}")


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


def run(options: Options, line: str) -> None:
    """Do what is left, then write tables and figures and log them.

    Raises:
        AVPError: nothing could be done, or some cells failed; the others are done then.
    """
    from avp_experiment.execute import environment
    from avp_experiment.tracking import open_parent, tracking_uri

    keep(options.configuration, options.out)
    store = Store(options.out)
    with store.alone():
        check_disk(options, store, plan(options.configuration, options.out, tracking="?"))
        parent = open_parent(f"compare {options.configuration.preset_name}")
        status = "FAILED"
        try:
            cells = plan(options.configuration, options.out, tracking=parent.experiment)
            preload = () if SimulatorChoice(options.configuration.simulator).one_per_process else PRELOAD
            runner = Runner(store, options.jobs, environment(tracking_uri()), preload)
            runner.run(cells)
            write_report(options, store, cells, line, parent)
            status = "FINISHED"
        except KeyboardInterrupt:
            status = "KILLED"
            print(f"\nwhat is done is kept in {options.out}; to go on:  {line}", file=sys.stderr)
            raise
        finally:
            parent.close(status)
    if runner.failed:
        raise AVPError(
            f"{len(runner.failed)} of {len(cells)} cells failed (reasons: {options.out}/results.md); "
            f"the same command tries them again"
        )


def write_report(options: Options, store: Store, cells: Sequence[Cell], line: str, parent: "Parent") -> None:
    """Gather what was found; tables and figures from it; all of it into MLflow."""
    from avp_experiment.report import write_report as tables_and_figures
    from avp_experiment.results import copy_pictures, gather, write
    from avp_experiment.tracking import log_results

    hours = sum(record["seconds"] for cell in cells if (record := store.record(cell))) / 3600
    results = gather(options.configuration, store, cells, command=line, hours=hours)
    copy_pictures(store, cells)
    write(results, options.out)
    tables_and_figures(options.out)
    log_results(parent, results, options.out)
    print(f"results:      {options.out}/results.md (tables, figures, claims; from {options.out}/results.json)")
    print(f"MLflow run:   {parent.run.run_id}")


def main(argv: Sequence[str]) -> None:
    """Compare."""
    began = time.monotonic()
    options = read_options(argv)
    run(options, typed(argv))
    print(f"done in {(time.monotonic() - began) / 60:.1f} min")


def typed(argv: Sequence[str]) -> str:
    """The command line as the user would type it."""
    if not os.environ.get("MLFLOW_RUN_ID"):
        return shlex.join(["python", "-m", "avp_experiment.compare", *argv])
    given = vars(_parser().parse_args(argv))
    default = vars(_parser().parse_args([]))
    chosen = [f"-P {name}={shlex.quote(value)}" for name, value in given.items() if value != default[name]]
    return " ".join(["mlflow run . -e compare --env-manager local", *chosen])


if __name__ == "__main__":
    sys.exit(command.run(main))
