"""Doing what is left of an experiment: several cells at a time, each in a process of its own with a log file.

Importing torch, nerfstudio and Stable-Baselines3 takes 10 to 20 seconds of a core, which hundreds of cells would pay;
multiprocessing's forkserver pays it once.
"""

import importlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from tqdm import tqdm

from avp_experiment.cells import Cell, facts_of
from avp_experiment.folder import Folder
from avp_habitat import command
from avp_habitat.errors import AVPError
from avp_habitat.provenance import git_commit

PRELOAD = ("avp_sb3", "avp_nerfstudio.method.reconstruction", "avp_habitat.collect", "avp_experiment.runner")
"""Everything heavy that cells use; multiprocessing passes over what is not installed."""
_MLFLOW_OURS = ("MLFLOW_RUN_ID", "MLFLOW_EXPERIMENT_ID", "MLFLOW_EXPERIMENT_NAME")
_TERMINATION_S = 30.0


def environment(tracking_uri: str) -> dict[str, str]:
    """Variables of the cells: this process's, one thread each, and not MLflow's run, which is the experiment's own."""
    kept = {name: value for name, value in os.environ.items() if name not in _MLFLOW_OURS}
    return kept | {"OMP_NUM_THREADS": "1", "MLFLOW_TRACKING_URI": tracking_uri, "PYTHONWARNINGS": "ignore"}


@dataclass
class Runner:
    """The scheduler, of so many jobs at a time, with the variables of their processes."""

    folder: Folder
    jobs: int
    environment: dict[str, str]
    preload: Sequence[str] = PRELOAD
    """Modules imported once, before any cell; with none each cell has a new process, as Habitat-Sim wants it."""
    failed: dict[str, str] = field(default_factory=dict)
    """Reasons by the cell's key."""

    def run(self, cells: Sequence[Cell]) -> None:
        """Do all cells that are not done; those that fail, and those that need them, are passed over."""
        # Libraries read these when they are loaded, which is in the process from which cells are forked: with two
        # threads each, two reconstructions on two cores were ten times slower.
        os.environ.update({name: self.environment[name] for name in ("OMP_NUM_THREADS", "PYTHONWARNINGS")})
        context: Any = multiprocessing.get_context("forkserver" if self.preload else "spawn")
        if self.preload:
            context.set_forkserver_preload(list(self.preload))
        waiting = [cell for cell in cells if not self.folder.is_done(cell)]
        running: dict[Any, Cell] = {}
        done = len(cells) - len(waiting)
        shown = time.monotonic()
        with command.progress(total=len(cells), initial=done, desc="experiment", unit="cell") as bar:
            try:
                while waiting or running:
                    self._start(context, waiting, running)
                    # In a file each showing is a line.
                    due = sys.stderr.isatty() or time.monotonic() >= shown + command.SECONDS
                    shown = time.monotonic() if due else shown
                    bar.set_postfix_str(", ".join(cell.key for cell in running.values()), refresh=due)
                    wait([process.sentinel for process in running], timeout=1)
                    bar.update(self._collect(running) + self._pass_over(waiting))
            except BaseException:
                _stop(list(running))
                raise

    def _start(self, context: Any, waiting: list[Cell], running: dict[Any, Cell]) -> None:
        for cell in [cell for cell in waiting if cell.needs is None or self.folder.is_done(cell.needs)]:
            if len(running) >= self.jobs:
                return
            waiting.remove(cell)
            arguments = (cell, self.folder.prepare(cell), self.folder.root, self.environment)
            process = context.Process(target=execute, args=arguments, name=cell.key)
            process.start()
            running[process] = cell

    def _collect(self, running: dict[Any, Cell]) -> int:
        """Judge the cells that have ended; how many."""
        ended = [process for process in running if process.exitcode is not None]
        for process in ended:
            cell, code = running.pop(process), process.exitcode
            if code or self.folder.record(cell) is None:
                ending = f"killed by signal {-code}" if code < 0 else f"exit code {code}"
                self.failed[cell.key] = reason = f"{ending}: {_last_lines(self.folder.log(cell))}"
                self.folder.fail(cell, reason)
                tqdm.write(f"failed: {cell.key}: {reason}", file=sys.stderr)
        return len(ended)

    def _pass_over(self, waiting: list[Cell]) -> int:
        """Drop cells that have nothing to do, or whose need has failed; how many."""
        lost = [cell for cell in waiting if cell.needs is not None and cell.needs.key in self.failed]
        self.failed |= {cell.key: f"needs {cell.needs.key}, which failed" for cell in lost if cell.needs}
        dropped = [cell for cell in waiting if cell in lost or self.folder.is_empty(cell)]
        for cell in dropped:
            waiting.remove(cell)
        return len(dropped)


def _stop(running: Sequence[Any]) -> None:
    """End processes as Ctrl-C would; what does not end in time is killed."""
    for process in running:
        process.terminate()
    until = time.monotonic() + _TERMINATION_S
    for process in running:
        process.join(max(until - time.monotonic(), 0))
        if process.exitcode is None:
            process.kill()


def _last_lines(log: Path) -> str:
    """The error that a log ends with, else its last three lines that say something, as one."""
    text = log.read_text(encoding="utf-8", errors="replace") if log.exists() else "no log"
    said = [line.strip() for line in text.replace("\r", "\n").splitlines() if line.strip()]
    errors = [line for line in said if line.startswith("error: ")]
    return errors[-1].removeprefix("error: ") if errors else " | ".join(said[-3:])[-400:]


def execute(cell: Cell, words: Sequence[str], root: Path, variables: dict[str, str]) -> None:
    """Run a cell's command line in this process, keep what came of it, and end the process with its exit code."""
    threading.Thread(target=_end_with_experiment, name="end with the experiment", daemon=True).start()
    os.environ.clear()
    os.environ.update(variables)
    folder = Folder(root)
    with folder.log(cell).open("a", encoding="utf-8") as log:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
            os.dup2(log.fileno(), stream.fileno())
    started = time.monotonic()
    print(f"$ {cell.command}", flush=True)
    code = command.run(importlib.import_module(words[2]).main, words[3:])
    sys.exit(code or _finish(folder, cell, time.monotonic() - started))


def _finish(folder: Folder, cell: Cell, seconds: float) -> int:
    finished = datetime.now(UTC).isoformat(timespec="seconds")
    about = {"seconds": round(seconds, 1), "commit": git_commit(), "finished": finished}
    try:
        folder.finish(cell, {**about, "facts": facts_of(cell, folder.root)})
    except (AVPError, OSError, ValueError, KeyError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _end_with_experiment() -> None:
    """End this process when the experiment ends, also by SIGKILL, or two programs would write one cell.

    The process that forked this one lives on as long as its children do, so that waiting for that one is no help.
    """
    experiment = multiprocessing.parent_process()
    assert experiment is not None
    experiment.join()
    os.kill(os.getpid(), signal.SIGKILL)
