"""How a tracked run begins: as a new one, as one that goes on, or within one that is open already."""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from avp_habitat.errors import AVPError
from avp_habitat.tracking.experiments import meant
from avp_habitat.tracking.journal import VERSION, Journal, spool_folder
from avp_habitat.tracking.names import OFFLINE, create, existing_run, find_run, open_store, reopen
from avp_habitat.tracking.run import TrackedRun
from avp_habitat.tracking.stores import TrackingError, absolute, connect, first_line, shown

if TYPE_CHECKING:
    from mlflow import MlflowClient


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


_OPTION = "offline=True"


@dataclass(frozen=True)
class NewRun:
    """What a run is made from."""

    experiment: str | None = None
    """Made when it does not exist; as `experiments.meant` says when None."""
    name: str | None = None
    """Of the run; MLflow invents one when None, the same one after each training that was seeded alike."""
    tags: Mapping[str, str] = field(default_factory=dict)
    """Beside those of MLflow's run context."""
    parent: str | None = None
    """Id of the run below which MLflow shows this one, when both lie in one experiment."""


def start_run(
    address: str, new: NewRun, *, offline: bool | None = None, spool: Path | None = None, **options: Any
) -> TrackedRun:
    """Begin a run.

    Args:
        address: of the store.
        new: what the run is made from.
        offline: True begins although the store does not answer; the run is made when it does. None: as
            `AVP_MLFLOW_OFFLINE` says.
        spool: folder of the journals; `spool_folder()` when None.
        **options: of `TrackedRun`.

    Raises:
        TrackingError: the store cannot be reached (and `offline` is not set), or refuses.
    """
    from mlflow.tracking.context.registry import resolve_tags

    client = open_store(address, offline=offline, option=_OPTION)
    experiment, experiment_id = meant(new.experiment)
    header = _header(address) | {
        "experiment": experiment,
        "experiment_id": experiment_id,
        "name": new.name,
        "tags": resolve_tags() | dict(new.tags),
        "parent": new.parent,
        "creating": True,
    }
    journal = Journal.create(spool or spool_folder(), header)
    if client is not None:
        try:
            journal.header["run_id"] = create(client, header | {"creating": False})
            journal.save_header()
        except OSError:
            pass  # The journal says itself that the disk takes nothing.
        except BaseException as error:
            journal.remove()
            if isinstance(error, AVPError) or not isinstance(error, Exception):
                raise
            raise TrackingError(f"MLflow at {shown(address)} did not take the run: {first_line(error)}") from error
    return TrackedRun(journal, client, **options)


def continue_run(
    address: str, run_id: str, *, offline: bool | None = None, spool: Path | None = None, **options: Any
) -> TrackedRun:
    """Go on with a run, with what its journal still holds when its process was killed.

    Args:
        address: of the store.
        run_id: MLflow's, or the one given offline.
        offline: as in `start_run`.
        spool: as in `start_run`.
        **options: of `TrackedRun`.

    Raises:
        TrackingError: the store cannot be reached (and `offline` is not set), or has no such run, or the run is being
            written by another process.
    """
    home = spool or spool_folder()
    client = open_store(address, offline=offline, option=_OPTION)
    journal = _left_journal(home, run_id)
    if journal is not None:
        journal.header |= {"address": absolute(address), "continue": True, "ended": None}
        return _reopened(journal, client, uncertain=True, **options)
    if client is not None:
        run_id = existing_run(client, run_id).info.run_id
    elif run_id.startswith(OFFLINE):
        raise TrackingError(f"MLflow run {run_id}: expected its journal in {home}, found none")
    journal = Journal.create(home, _header(address) | {"run_id": run_id, "continue": True})
    return _reopened(journal, client, **options)


def may_continue(address: str, run_id: str, *, spool: Path | None = None) -> bool:
    """Whether a run was interrupted, so that going on with its model goes on with the run.

    A run that MLflow takes for running, and of which this machine has no journal, may be running elsewhere.
    """
    home = spool or spool_folder()
    folder = journal_of(home, run_id)
    if folder is not None and (header := Journal.peek(folder)) is not None:
        return header["ended"] != "FINISHED" and not Journal.in_use(folder)
    try:
        run = find_run(connect(address), run_id)
    except TrackingError:
        return False
    return run is not None and run.info.status in ("KILLED", "FAILED")


def journal_of(spool: Path, run_id: str) -> Path | None:
    """The folder of the journal of a run, in use or left; None when there is none."""
    for folder in sorted(spool.glob("*")):
        header = Journal.peek(folder)
        if header is not None and run_id in (header["run_id"], f"{OFFLINE}{header['key']}"):
            return folder
    return None


def join_run(address: str, run_id: str, *, spool: Path | None = None, **options: Any) -> TrackedRun:
    """Fill a run that somebody else has opened and will end.

    Args:
        address: of the store.
        run_id: of the run.
        spool: as in `start_run`.
        **options: of `TrackedRun`.

    Raises:
        TrackingError: the store cannot be reached or has no such run.
    """
    client = connect(address)
    run_id = existing_run(client, run_id).info.run_id
    header = _header(address) | {"run_id": run_id, "owned": False}
    return TrackedRun(Journal.create(spool or spool_folder(), header), client, **options)


def _reopened(journal: Journal, client: "MlflowClient | None", **options: Any) -> TrackedRun:
    if client is not None and journal.header["run_id"] is not None:
        reopen(client, journal.header["run_id"])
        journal.header["continue"] = False
    return TrackedRun(journal, client, **options)


def _header(address: str) -> dict[str, Any]:
    return {
        "version": VERSION,
        "key": uuid4().hex,
        "address": absolute(address),
        "run_id": None,
        "owned": True,
        "ended": None,
        "started_ms": int(time.time() * 1000),
    }


def _left_journal(spool: Path, run_id: str) -> Journal | None:
    """The journal that a killed process left of this run.

    Raises:
        TrackingError: it is in use.
    """
    folder = journal_of(spool, run_id)
    if folder is None:
        return None
    journal = Journal.adopt(folder)
    if journal is None:
        raise TrackingError(f"MLflow run {run_id}: another program is writing it ({folder})")
    return journal
