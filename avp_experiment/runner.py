"""Doing what is left of an experiment: several cells at a time, each as soon as what it needs is there."""

import multiprocessing
import os
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from typing import Any

from tqdm import tqdm

from avp_experiment.cells import COLLECT, RECONSTRUCT, TRAIN, Cell
from avp_experiment.execute import Order, execute, last_words
from avp_experiment.store import Store
from avp_habitat.command import progress

PRELOAD = ("avp_experiment.preload",)
_GUESS_S = {TRAIN: 120.0, COLLECT: 10.0, RECONSTRUCT: 30.0}
_POLL_S = 1.0
_PATIENCE_S = 30.0


@dataclass
class _Running:
    """A cell that is being done."""

    cell: Cell
    process: Any
    began: float


@dataclass
class Runner:
    """The scheduler."""

    store: Store
    jobs: int
    """Cells at a time."""
    environment: dict[str, str]
    """Of their processes."""
    preload: Sequence[str] = PRELOAD
    """Modules imported once, before any cell; with none each cell has a new process, as Habitat-Sim wants it."""
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    """How long cells of each kind took."""
    failed: dict[str, str] = field(default_factory=dict)
    """Reasons by the cell's key."""

    def run(self, cells: Sequence[Cell]) -> None:
        """Do all cells that are not done; those that fail, and those that need them, are passed over.

        Args:
            cells: each after the one that it needs.
        """
        for cell in cells:
            if (record := self.store.record(cell)) is not None:
                self.seconds[cell.kind].append(record["seconds"])
        waiting = [cell for cell in cells if not self.store.is_done(cell)]
        # Libraries read these when they are loaded, which is in the process from which cells are forked: with two
        # threads each, two reconstructions on two cores were ten times slower.
        os.environ.update({name: value for name, value in self.environment.items() if name.endswith("_NUM_THREADS")})
        context = multiprocessing.get_context("forkserver" if self.preload else "spawn")
        if self.preload:
            context.set_forkserver_preload(list(self.preload))
        running: list[_Running] = []
        done = len(cells) - len(waiting)
        options = {"total": len(cells), "initial": done, "desc": "experiment", "unit": "cell", "bar_format": _BAR}
        with progress(miniters=0, **options) as bar:
            try:
                while waiting or running:
                    self._start(context, waiting, running)
                    bar.set_postfix_str(self._state(waiting, running), refresh=sys.stderr.isatty())
                    bar.update(self._collect(running))
                    bar.update(self._pass_over(waiting))
            except BaseException:
                self._stop(running)
                raise

    def _start(self, context: Any, waiting: list[Cell], running: list[_Running]) -> None:
        for cell in list(waiting):
            if len(running) >= self.jobs:
                return
            if cell.needs is not None and not self.store.is_done(cell.needs):
                continue
            waiting.remove(cell)
            order = Order(cell, self.store.prepare(cell), self.store.root, self.environment)
            process = context.Process(target=execute, args=(order,), name=cell.key)
            process.start()
            running.append(_Running(cell, process, time.monotonic()))

    def _collect(self, running: list[_Running]) -> int:
        """Wait a moment; how many cells have ended."""
        wait([one.process.sentinel for one in running], timeout=_POLL_S)
        ended = [one for one in running if one.process.exitcode is not None]
        for one in ended:
            running.remove(one)
            if one.process.exitcode == 0 and self.store.record(one.cell) is not None:
                self.seconds[one.cell.kind].append(time.monotonic() - one.began)
            else:
                self._fail(one.cell, f"{_ending(one.process.exitcode)}: {last_words(self.store.log(one.cell))}")
        return len(ended)

    def _pass_over(self, waiting: list[Cell]) -> int:
        """Drop cells that have nothing to do, or whose need has failed; how many."""
        dropped = 0
        for cell in list(waiting):
            if self.store.is_empty(cell):
                waiting.remove(cell)
                dropped += 1
            elif cell.needs is not None and cell.needs.key in self.failed:
                waiting.remove(cell)
                self._fail(cell, f"needs {cell.needs.key}, which failed", told=False)
                dropped += 1
        return dropped

    def _fail(self, cell: Cell, reason: str, *, told: bool = True) -> None:
        self.failed[cell.key] = reason
        if told:
            self.store.fail(cell, reason)
            tqdm.write(f"failed: {cell.key}: {reason}", file=sys.stderr)

    def _state(self, waiting: list[Cell], running: list[_Running]) -> str:
        left = sum(self._expected(cell) for cell in waiting)
        now = time.monotonic()
        left += sum(max(self._expected(one.cell) - (now - one.began), 0) for one in running)
        failures = f", {len(self.failed)} failed" if self.failed else ""
        return f"about {_span(left / self.jobs)} left{failures}; now {', '.join(one.cell.key for one in running)}"

    def _expected(self, cell: Cell) -> float:
        known = self.seconds[cell.kind]
        return sum(known) / len(known) if known else _GUESS_S[cell.kind]

    def _stop(self, running: list[_Running]) -> None:
        """End what is running, as Ctrl-C would; what does not end in time is killed."""
        for one in running:
            one.process.terminate()
        until = time.monotonic() + _PATIENCE_S
        for one in running:
            one.process.join(max(until - time.monotonic(), 0))
            if one.process.exitcode is None:
                one.process.kill()


_BAR = "{desc}: {n_fmt}/{total_fmt} cells |{bar}| {elapsed}{postfix}"


def default_jobs() -> int:
    """One cell per core that this process may use."""
    return len(os.sched_getaffinity(0))


def _ending(code: int | None) -> str:
    return f"killed by signal {-code}" if code is not None and code < 0 else f"exit code {code}"


def _span(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
