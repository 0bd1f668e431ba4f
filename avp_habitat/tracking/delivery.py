"""The thread that tells MLflow what a journal holds, each entry once, and keeps trying while MLflow does not answer.

MLflow's databases take a point that they have already for the same point; its folder stores and the servers in front of
them do not. After a call of which nobody knows whether it worked, points that the run has are therefore left out.
"""

import json
import logging
import math
import shutil
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from avp_habitat.tracking.experiments import create_run
from avp_habitat.tracking.journal import Journal
from avp_habitat.tracking.names import CHANGED_TAG, MAX_TAG
from avp_habitat.tracking.stores import StoreUnreachableError, connect, first_line, shown, unreachable

if TYPE_CHECKING:
    from mlflow import MlflowClient

INTERVAL_S = 5.0
"""Time between two calls while a run lasts; each costs the training tens of milliseconds of Python."""
_RETRY_S = (1.0, 15.0)
_ASKED_AGAIN, _FAILED_AGAIN = 2, 8
_PER_CALL = {"metrics": 900, "params": 100, "tags": 100}
_PERMANENT = (
    "BAD_REQUEST ENDPOINT_NOT_FOUND INVALID_PARAMETER_VALUE INVALID_STATE MALFORMED_REQUEST NOT_IMPLEMENTED "
    "PERMISSION_DENIED RESOURCE_ALREADY_EXISTS RESOURCE_DOES_NOT_EXIST"
)
"""MLflow's errors that trying again does not cure."""
_THREAD = "avp-mlflow"
_log = logging.getLogger(__name__)


class Sender:
    """Sends one journal's entries until it is stopped."""

    def __init__(
        self,
        journal: Journal,
        client: "MlflowClient | None" = None,
        *,
        uncertain: bool = False,
        interval_s: float = INTERVAL_S,
    ) -> None:
        """Begin to send what is in `journal`, each `interval_s`; `uncertain`: an earlier process may have sent some.

        A client of the store is made when something is to be sent, where none is given.
        """
        self._journal = journal
        self._client: Any = client
        self._run_id: str | None = None
        self._uncertain = uncertain
        self._interval_s = interval_s
        self._hurry = threading.Event()
        self._stopped = threading.Event()
        self._answers = self._unanswered = self._failures = 0
        self._told: set[str] = set()
        self.problem: str | None = None
        """Why nothing arrives just now."""
        # MLflow writes a hundred lines about each failure of a database; here one line says it once.
        logging.getLogger("mlflow.store.db.utils").addFilter(_is_not_ours)
        # A daemon, so that an interpreter that exits without `stop` is not held up; the journal keeps the rest.
        self._thread = threading.Thread(target=self._work, name=_THREAD, daemon=True)
        self._thread.start()

    def warn_once(self, key: str, text: str) -> None:
        """Log a warning that is the first one of its key."""
        if key not in self._told:
            self._told.add(key)
            _log.warning(text)

    def drain(self, timeout_s: float) -> bool:
        """Send everything without waiting for the interval; whether MLflow has it.

        It waits at most so long without any progress; a server that is gone is asked twice more instead.
        """
        unanswered, failures = self._unanswered + _ASKED_AGAIN, self._failures + _FAILED_AGAIN
        answers, until = self._answers, time.monotonic() + timeout_s
        self._hurry.set()
        try:
            while not self._journal.wait(0.2, pending=False):
                if self._answers > answers:
                    answers, until = self._answers, time.monotonic() + timeout_s
                gone = self._unanswered >= unanswered or self._failures >= failures
                if gone or time.monotonic() > until or not self._thread.is_alive():
                    return False
            return True
        finally:
            self._hurry.clear()

    def stop(self, timeout_s: float = 5.0) -> bool:
        """End the thread; whether it ended, which a call that hangs may prevent."""
        self._stopped.set()
        self._hurry.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _work(self) -> None:
        pause = _RETRY_S[0]
        while not self._stopped.is_set():
            if not self._journal.wait(0.2, pending=True):
                continue
            try:
                self._send_some()
            except Exception as error:
                self._failed(error)
                # Somebody who starts to wait for us ends the pause, and makes it short.
                if self._hurry.is_set():
                    self._stopped.wait(min(pause, 0.5))
                else:
                    self._hurry.wait(pause)
                pause = min(2 * pause, _RETRY_S[1])
                continue
            if self.problem is not None:
                _log.warning("MLflow at %s takes the run's points again", shown(self._journal.header["address"]))
            self.problem, pause = None, _RETRY_S[0]
            self._hurry.wait(self._interval_s)

    def _failed(self, error: Exception) -> None:
        self._uncertain = True
        self._failures += 1
        self._unanswered += isinstance(error, StoreUnreachableError)
        if self.problem is None:
            text = "MLflow at %s does not take the run's points now (%s); they are kept in %s and sent when it does"
            _log.warning(text, shown(self._journal.header["address"]), first_line(error), self._journal.folder)
        self.problem = first_line(error)

    def _send_some(self) -> None:
        if (problem := unreachable(self._journal.header["address"])) is not None:
            raise StoreUnreachableError(problem)
        if self._run_id is None:
            self._run_id = self._open_run()
        entries = self._journal.read()
        self._send(entries)
        self._journal.acknowledge()
        self._uncertain = False
        for entry in entries:
            if "file" in entry:
                shutil.rmtree(self._file_of(entry).parent, ignore_errors=True)

    def _open_run(self) -> str:
        """Connect; make the run, or open it again, as the journal's header asks."""
        header = self._journal.header
        if self._client is None:
            self._client = connect(header["address"], make=header["run_id"] is None)
        if header["run_id"] is None:
            self._journal.update({"run_id": create_run(self._client, header)})
        elif header.get("continue"):
            self._client.update_run(header["run_id"], status="RUNNING")
        return str(header["run_id"])

    def _send(self, entries: Sequence[dict[str, Any]]) -> None:
        """Tell MLflow; any error is one that may pass."""
        self._send_values(entries)
        # Of files that replace each other the last one is enough. A run ends after everything else.
        files = {entry["path"]: entry for entry in entries if "file" in entry}
        for entry in files.values():
            self._call(entry, partial(self._send_file, entry))
        for entry in entries:
            if "end" in entry:
                how = (self._run_id, entry["end"], entry["at"])
                self._call(entry, partial(self._client.set_terminated, *how))

    def _send_values(self, entries: Sequence[Mapping[str, Any]]) -> None:
        from mlflow.entities import Metric, Param, RunTag

        points = [point for entry in entries for point in entry.get("metrics", ())]
        params: dict[str, str] = {}
        tags: dict[str, str] = {}
        for entry in entries:
            params |= entry.get("params", {})
            tags |= entry.get("tags", {})
        if params:
            # A parameter that has another value already, which MLflow would refuse, is told as a tag.
            known = self._client.get_run(self._run_id).data.params
            changed = {name: [known[name], value] for name, value in params.items() if known.get(name, value) != value}
            tags |= {CHANGED_TAG: json.dumps(changed)[:MAX_TAG]} if changed else {}
            params = {name: value for name, value in params.items() if name not in known}
        metrics = self._missing(points) if self._uncertain else points
        kinds: dict[str, tuple[type, list[Any]]] = {
            "metrics": (Metric, metrics),
            "params": (Param, list(params.items())),
            "tags": (RunTag, list(tags.items())),
        }
        for kind, (entity, items) in kinds.items():
            for start in range(0, len(items), _PER_CALL[kind]):
                chunk = items[start : start + _PER_CALL[kind]]
                entry = {kind: chunk if kind == "metrics" else dict(chunk)}
                batch = {kind: [entity(*item) for item in chunk]}
                self._call(entry, partial(self._client.log_batch, self._run_id, **batch))

    def _missing(self, points: Sequence[Sequence[Any]]) -> list[Sequence[Any]]:
        """Those of the points that the run does not have."""
        known: set[tuple[Any, ...]] = set()
        for key in {key for key, *_ in points}:
            history = self._client.get_metric_history(self._run_id, key)
            known |= {_identity(point.key, point.value, point.timestamp, point.step) for point in history}
            self._answers += 1
        return list({_identity(*point): point for point in points if _identity(*point) not in known}.values())

    def _send_file(self, entry: Mapping[str, Any]) -> None:
        """An artifact; no file is there when it was sent and the process killed before it could say so."""
        folder = PurePosixPath(entry["path"]).parent.as_posix()
        if (source := self._file_of(entry)).is_file():
            self._client.log_artifact(self._run_id, str(source), None if folder == "." else folder)

    def _call(self, entry: Mapping[str, Any], call: Callable[[], object]) -> None:
        """Call MLflow; an entry that it refuses for good is kept as rejected."""
        from mlflow.exceptions import MlflowException

        try:
            call()
        except MlflowException as error:
            if error.error_code not in _PERMANENT.split():
                raise
            reason = first_line(error)
            self._journal.reject(entry, reason)
            self.warn_once(reason, f"MLflow run {self._run_id} refuses some metrics or files: {reason}")
        self._answers += 1

    def _file_of(self, entry: Mapping[str, Any]) -> Path:
        return self._journal.folder / entry["file"]


def _is_not_ours(record: logging.LogRecord) -> bool:
    return record.threadName != _THREAD


def _identity(key: str, value: float, timestamp: int, step: int) -> tuple[Any, ...]:
    """What makes a point the same point; MLflow's databases keep infinity as the largest number."""
    largest = sys.float_info.max
    return key, timestamp, step, None if math.isnan(value) else max(min(value, largest), -largest)
