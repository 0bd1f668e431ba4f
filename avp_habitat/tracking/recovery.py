"""Runs whose process is gone: what they still had to say is sent, and they are closed."""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from avp_habitat.tracking.addresses import shown
from avp_habitat.tracking.journal import Journal
from avp_habitat.tracking.run import TrackedRun

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Recovered:
    """What became of one journal."""

    run_id: str
    """MLflow's, or the one given offline."""
    address: str
    """Of its store."""
    folder: Path
    """The journal's."""
    status: str
    """The run's, when it is known."""
    delivered: bool
    """Whether MLflow has everything; the journal is gone then."""
    killed: bool
    """Whether the run was left open by a process that was killed, and is now closed."""


def left_journals(spool: Path) -> Iterator[Journal]:
    """The journals that no living process holds; each is to be closed before the next is taken."""
    for folder in sorted(path for path in spool.glob("*") if path.is_dir()):
        journal = Journal.adopt(folder)
        if journal is not None:
            yield journal


def finish(journal: Journal, *, again: bool = False, timeout_s: float = 30.0) -> Recovered:
    """Send what a journal holds and close its run, as KILLED when its process did not.

    Args:
        journal: nobody's.
        again: try also what MLflow refused.
        timeout_s: to wait for a store at most without any progress.
    """
    header, folder = journal.header, journal.folder
    assert folder is not None
    if again:
        journal.restore_rejected()
    killed = header["ended"] is None
    last_ms = journal.last_written_ms()
    run = TrackedRun(journal, None, uncertain=True, interval_s=0.0)
    close = partial(run.close, "KILLED", at_ms=last_ms) if killed else run.leave
    delivered = close(timeout_s=timeout_s)
    return Recovered(run.run_id, run.address, folder, header["ended"], delivered, killed and header["owned"])


def recover(spool: Path, *, timeout_s: float = 30.0, on_each: Callable[[Recovered], object] = lambda _: None) -> None:
    """Finish all journals that killed processes left in a folder."""
    for journal in left_journals(spool):
        ended, made = journal.header["ended"] is not None, journal.header["run_id"] is not None
        if not journal and (ended or not made):
            # MLflow has what it takes; what it refused waits for somebody who looks at it.
            if journal.has_rejected:
                journal.release()
            else:
                journal.remove()
            continue
        on_each(finish(journal, timeout_s=timeout_s))


def recover_in_background(spool: Path) -> threading.Thread:
    """`recover` without making anybody wait for a slow server; a warning names each run."""

    def work() -> None:
        with suppress(OSError):
            recover(spool, timeout_s=10.0, on_each=_tell)

    thread = threading.Thread(target=work, name="avp-mlflow-recovery", daemon=True)
    thread.start()
    return thread


def _tell(result: Recovered) -> None:
    what = "closed as KILLED" if result.killed else "completed"
    state = what if result.delivered else "still not sent"
    _log.warning("MLflow run %s of an earlier program, at %s: %s", result.run_id, shown(result.address), state)
