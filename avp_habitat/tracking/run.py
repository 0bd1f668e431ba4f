"""An MLflow run that is filled from a program which must not wait for MLflow, nor lose anything to it."""

import json
import logging
import math
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

from avp_habitat.errors import AVPError
from avp_habitat.tracking.delivery import Sender
from avp_habitat.tracking.experiments import chosen_experiment, create_run, existing_run, find_run
from avp_habitat.tracking.journal import VERSION, Journal, journal_of, spool_folder
from avp_habitat.tracking.names import IMAGES_TAG, MAX_PARAM, MAX_TAG, OFFLINE, RENAMED_TAG, SafeNames, safe_name
from avp_habitat.tracking.stores import DELIVER, TrackingError, absolute, connect, first_line, open_store, shown

if TYPE_CHECKING:
    import numpy as np
    from mlflow import MlflowClient
    from numpy.typing import NDArray

Status = Literal["FINISHED", "FAILED", "KILLED"]

_CLOSING_S = 30.0
_log = logging.getLogger(__name__)


class TrackedRun:
    """A run; everything it is told is on disk at once and with MLflow soon, in the background.

    Made by `start_run`, `continue_run` and `join_run`. All methods may be called from any thread, one at a time.
    """

    def __init__(self, journal: Journal, client: "MlflowClient | None", **options: Any) -> None:
        """Fill the run of a journal; options as of `Sender`."""
        self._journal, self._names = journal, SafeNames()
        self._told: set[str] = set()
        self._sender = Sender(journal, client, **options)

    @property
    def run_id(self) -> str:
        """MLflow's id; `offline-KEY` as long as MLflow does not know the run."""
        return self._journal.header["run_id"] or f"{OFFLINE}{self._journal.header['key']}"

    @property
    def address(self) -> str:
        """Of the store, as MLflow is given it; it may hold a password."""
        return self._journal.header["address"]

    def metrics(self, values: Mapping[str, float], step: int, *, timestamp_ms: int | None = None) -> None:
        """Add numbers at a step; names that MLflow refuses are changed, which the tag `avp.renamed` says."""
        at = int(time.time() * 1000) if timestamp_ms is None else timestamp_ms
        known = len(self._names)
        points = [[self._names[name], float(value), at, int(step)] for name, value in values.items()]
        if len(self._names) > known and (changed := self._names.changed):
            self.tags({RENAMED_TAG: json.dumps(changed)})
        for name, value, *_ in points:
            if not math.isfinite(value):
                self._warn_once(name, f"MLflow run {self.run_id}: {name} is {value} at step {step}")
        if points:
            self._append({"metrics": points})

    def tags(self, values: Mapping[str, str]) -> None:
        """Set tags; long texts are cut."""
        if values:
            self._append({"tags": {safe_name(name): str(value)[:MAX_TAG] for name, value in values.items()}})

    def params(self, values: Mapping[str, Any]) -> None:
        """Set parameters; one that the run has already keeps its value, which the tag `avp.changed_params` says."""
        if values:
            self._append({"params": {safe_name(name): str(value)[:MAX_PARAM] for name, value in values.items()}})

    def save(self, path: str, write: Callable[[Path], object]) -> bool:
        """Keep an artifact, in place of one of that path, that `write` writes to its file; whether the disk took it."""
        try:
            file = self._journal.new_file(PurePosixPath(path).name)
            write(file)
        except OSError as error:
            self._warn_once(path, f"MLflow run {self.run_id}: {path} cannot be kept: {error}")
            return False
        self._append({"file": str(file.relative_to(self._journal.folder)), "path": path})
        return True

    def file(self, source: Path, path: str | None = None) -> bool:
        """Keep a copy of a file as artifact `path`, its own name when omitted."""
        return self.save(path or source.name, lambda target: shutil.copyfile(source, target))

    def image(self, name: str, rgb: "NDArray[np.uint8]", step: int) -> None:
        """Keep a `(h, w, 3)` picture at a step; MLflow shows those of one name along the steps."""
        from PIL import Image

        picture = Image.fromarray(rgb)
        small = picture.copy()
        small.thumbnail((256, 256))
        # By such names MLflow's UI knows a series of pictures: MlflowClient.log_image in mlflow/tracking/client.py.
        at = f"step+{step}+timestamp+{int(time.time() * 1000)}+{uuid4()}"
        stem = f"images/{safe_name(name).replace('/', '~')}+{at}"
        self.save(f"{stem}.png", partial(picture.save, compress_level=1))
        self.save(f"{stem}+compressed.webp", partial(small.save, quality=80))
        self.tags({IMAGES_TAG: "True"})

    def flush(self, timeout_s: float = _CLOSING_S) -> bool:
        """Wait until MLflow has everything; whether it has."""
        return self._sender.drain(timeout_s)

    def close(self, status: Status | None, *, at_ms: int | None = None, timeout_s: float = _CLOSING_S) -> bool:
        """Send the rest and end the run; whether MLflow has everything. What it does not have stays on disk.

        Without a status, or of a run that is not ours, it keeps its own. `at_ms`, since 1970, is when it ended (now
        when omitted), `timeout_s` how long to wait for a store without any progress.
        """
        journal = self._journal
        try:
            if status is not None:
                journal.update({"ended": status})
                if journal.header["owned"]:
                    self._append({"end": status, "at": at_ms or int(time.time() * 1000)})
            self._sender.drain(timeout_s)
        finally:
            # A thread that hangs in a call keeps the journal until this process ends.
            stopped = self._sender.stop()
            if journal.pending:
                reason = f"did not take all of run {self.run_id} ({self._sender.problem or 'it was too slow'})"
                where = f"stay in {journal.folder}; send them with: {DELIVER}"
                _log.warning("MLflow at %s %s; its last points %s", shown(self.address), reason, where)
            if stopped and journal.pending:
                journal.release()
            elif stopped:
                journal.remove()
        return not journal.pending

    def _warn_once(self, key: str, text: str) -> None:
        if key not in self._told:
            self._told.add(key)
            _log.warning(text)

    def _append(self, entry: dict[str, Any]) -> None:
        self._journal.append(entry)
        if (problem := self._journal.problem) is not None:
            self._warn_once("disk", f"MLflow's points wait in memory, the disk takes none now: {problem}")


@dataclass(frozen=True)
class NewRun:
    """What a run is made from."""

    experiment: str | None = None
    """Made when it does not exist; None: as `experiments.chosen_experiment` says."""
    name: str | None = None
    """None: MLflow invents one, the same one after each training that was seeded alike."""
    tags: Mapping[str, str] = field(default_factory=dict)
    """Beside those of MLflow's run context."""
    parent: str | None = None
    """Id of the run below which MLflow shows this one, when both lie in one experiment."""


def start_run(address: str, new: NewRun, *, offline: bool | None = None, **options: Any) -> TrackedRun:
    """Begin a run; with `offline` although the store does not answer (None: as `AVP_MLFLOW_OFFLINE` says).

    Raises:
        TrackingError: the store cannot be reached, or refuses.
    """
    client = open_store(address, offline=offline)
    from mlflow.tracking.context.registry import resolve_tags

    experiment, experiment_id = chosen_experiment(new.experiment)
    about = {"experiment": experiment, "experiment_id": experiment_id, "name": new.name, "parent": new.parent}
    journal = Journal.create(_header(address) | about | {"tags": resolve_tags() | dict(new.tags)})
    if client is not None:
        try:
            journal.update({"run_id": create_run(client, journal.header)})
        except Exception as error:
            journal.remove()
            if isinstance(error, AVPError):
                raise
            raise TrackingError(f"MLflow at {shown(address)} did not take the run: {first_line(error)}") from error
    return TrackedRun(journal, client, **options)


def continue_run(address: str, run_id: str, *, offline: bool | None = None, **options: Any) -> TrackedRun:
    """Go on with a run of MLflow's id or of one given offline, with what its journal still holds from a killed process.

    Raises:
        TrackingError: the store cannot be reached, or has no such run, or another process is writing the run.
    """
    client = open_store(address, offline=offline)
    folder = journal_of(run_id)
    if folder is not None:
        if (journal := Journal.adopt(folder)) is None:
            raise TrackingError(f"MLflow run {run_id}: another program is writing it ({folder})")
        journal.update({"address": absolute(address), "continue": True, "ended": None})
    else:
        if client is not None:
            run_id = existing_run(client, run_id).info.run_id
        elif run_id.startswith(OFFLINE):
            raise TrackingError(f"MLflow run {run_id}: expected its journal in {spool_folder()}, found none")
        journal = Journal.create(_header(address) | {"run_id": run_id, "continue": True})
    if client is not None and journal.header["run_id"] is not None:
        client.update_run(journal.header["run_id"], status="RUNNING")
        journal.header["continue"] = False
    return TrackedRun(journal, client, uncertain=folder is not None, **options)


def may_continue(address: str, run_id: str) -> bool:
    """Whether a run was interrupted, so that going on with its model goes on with the run.

    A run that MLflow takes for running, and of which this machine has no journal, may be running elsewhere.
    """
    folder = journal_of(run_id)
    if folder is not None and (journal := Journal.adopt(folder)) is not None:
        journal.release()
        return journal.header["ended"] != "FINISHED"
    try:
        run = None if folder is not None else find_run(connect(address), run_id)
    except TrackingError:
        return False
    return run is not None and run.info.status in ("KILLED", "FAILED")


def join_run(address: str, run_id: str, **options: Any) -> TrackedRun:
    """Fill a run that somebody else has opened and will end; a `TrackingError` where there is none."""
    client = connect(address)
    about = {"run_id": existing_run(client, run_id).info.run_id, "owned": False}
    return TrackedRun(Journal.create(_header(address) | about), client, **options)


def _header(address: str) -> dict[str, Any]:
    about = {"version": VERSION, "key": uuid4().hex, "address": absolute(address)}
    return about | {"run_id": None, "owned": True, "ended": None, "started_ms": int(time.time() * 1000)}
