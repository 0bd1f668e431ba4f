"""`python -m avp_habitat.tracking.deliver`: send MLflow what it could not be sent while a program ran."""

import logging
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from avp_habitat import command
from avp_habitat.errors import UsageError
from avp_habitat.tracking.journal import Journal, headers, spool_folder
from avp_habitat.tracking.run import TrackedRun
from avp_habitat.tracking.stores import TrackingError, absolute, shown

# Somebody waits for the command, and a server that has just been started takes long over its first answers.
_PATIENCE_S = 120.0
_log = logging.getLogger(__name__)


def left_journals(spool: Path) -> Iterator[Journal]:
    """The journals that no living process holds; each is to be closed before the next is taken."""
    return filter(None, map(Journal.adopt, headers(spool)))


def finish(journal: Journal, *, timeout_s: float = 30.0) -> tuple[bool, str]:
    """Send what a left journal holds and close its run, if need be as KILLED; whether that worked, and a line on it."""
    header, last_ms = journal.header, journal.last_written_ms()
    killed = header["ended"] is None
    run = TrackedRun(journal, None, uncertain=True, interval_s=0.0)
    delivered = run.close("KILLED" if killed else None, at_ms=last_ms, timeout_s=timeout_s)
    how = f"{header['ended']}{', its program was killed' if killed and header['owned'] else ''}"
    return delivered, f"run {run.run_id} at {shown(run.address)}: {'sent' if delivered else 'NOT sent'} ({how})"


def recover(*, timeout_s: float = 30.0) -> Iterator[str]:
    """Finish all journals that killed processes left in the spool folder; a line on each."""
    for journal in left_journals(spool_folder()):
        ended, made = journal.header["ended"] is not None, journal.header["run_id"] is not None
        if journal.pending or (made and not ended):
            yield finish(journal, timeout_s=timeout_s)[1]
        else:
            journal.remove()


def recover_in_background() -> threading.Thread:
    """`recover` without making anybody wait for a slow server; a warning names each run."""

    def work() -> None:
        with suppress(OSError):
            for line in recover(timeout_s=10.0):
                _log.warning("MLflow: what an earlier program left, %s", line)

    thread = threading.Thread(target=work, name="avp-mlflow-recovery", daemon=True)
    thread.start()
    return thread


@dataclass(frozen=True)
class Deliver:
    """Send MLflow the points and files of runs that it could not be sent while they lasted.

    Runs whose program was killed are closed. Each point arrives once, however often this is run.
    """

    spool: Path | None = None
    """Where they wait (omitted: AVP_MLFLOW_SPOOL, else runs/mlflow-spool)."""
    mlflow: str | None = None
    """Send them to this address instead of where they were meant for."""
    list: bool = False
    """Only say what waits."""


def main(options: Deliver) -> None:
    """Deliver; an error when something stays."""
    spool = (options.spool or spool_folder()).absolute()
    if options.spool is not None and not spool.is_dir():
        raise UsageError(f"--spool {options.spool}: no such folder")
    waiting = headers(spool)
    if not waiting:
        print(f"{spool}: nothing waits")
    elif options.list:
        for folder, header in waiting.items():
            print(f"{folder.name}  run {header['run_id'] or '(none yet)'}  for {shown(header['address'])}")
    else:
        _deliver(spool, len(waiting), options.mlflow)


def _deliver(spool: Path, count: int, address: str | None) -> None:
    done = []
    for journal in command.progress(left_journals(spool), total=count, unit="run", desc="sending"):
        if address is not None:
            journal.header["address"] = absolute(address)
        done.append(finish(journal, timeout_s=_PATIENCE_S))
    for _, line in done:
        print(line)
    if busy := count - len(done):
        print(f"{busy} of {count} belong to programs that still run")
    if failed := sum(not delivered for delivered, _ in done):
        raise TrackingError(f"{failed} of {count} runs could not be sent; they stay in {spool}")


if __name__ == "__main__":
    sys.exit(command.run(main))
