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
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from avp_habitat.tracking.experiments import create_run
from avp_habitat.tracking.journal import Journal
from avp_habitat.tracking.names import CHANGED_TAG, MAX_TAG
from avp_habitat.tracking.stores import StoreUnreachableError, connect, first_line, shown, unreachable

INTERVAL_S = 5.0
"""Time between two calls while a run lasts; each costs the training tens of milliseconds of Python."""
_RETRY_S, _ASKED_AGAIN = (1.0, 15.0), 4
_log = logging.getLogger(__name__)


class Sender:
    """Sends one journal's entries until it is stopped."""

    def __init__(
        self, journal: Journal, client: Any, *, uncertain: bool = False, interval_s: float = INTERVAL_S
    ) -> None:
        """Begin to send what is in `journal`, each `interval_s`; `uncertain`: an earlier process may have sent some.

        Without a client of the store, one is made when something is to be sent.
        """
        self._journal, self._uncertain, self._interval_s = journal, uncertain, interval_s
        self._client, self._run_id = client, ""
        self._hurry, self._stopped = threading.Event(), threading.Event()
        self._answers = self._failures = 0
        self.problem: str | None = None
        """Why nothing arrives just now."""
        # A daemon, so that an interpreter that exits without `stop` is not held up; the journal keeps the rest.
        self._thread = threading.Thread(target=self._work, name="avp-mlflow", daemon=True)
        self._thread.start()

    def drain(self, timeout_s: float) -> bool:
        """Send everything at once; whether MLflow has it. It waits so long without progress, and for a few failures."""
        failures = self._failures + _ASKED_AGAIN
        answers, until = self._answers, time.monotonic() + timeout_s
        self._hurry.set()
        while not self._journal.wait(0.5, pending=False):
            self._hurry.set()
            if self._answers > answers:
                answers, until = self._answers, time.monotonic() + timeout_s
            if self._failures >= failures or time.monotonic() > until or not self._thread.is_alive():
                return False
        return True

    def stop(self) -> bool:
        """End the thread; whether it ended, which a call that hangs may prevent."""
        self._stopped.set()
        self._hurry.set()
        self._thread.join(5.0)
        return not self._thread.is_alive()

    def _work(self) -> None:
        retry = _RETRY_S[0]
        while not self._stopped.is_set():
            if not self._journal.wait(0.2, pending=True):
                continue
            try:
                self._send_some()
            except Exception as error:
                if self.problem is None:
                    text = "MLflow at %s does not take the run's points now (%s); they wait in %s until it does"
                    _log.warning(text, shown(self._journal.header["address"]), first_line(error), self._journal.folder)
                self.problem, self._uncertain = first_line(error), True
                self._failures += 1
                pause, retry = retry, min(2 * retry, _RETRY_S[1])
            else:
                if self.problem is not None:
                    _log.warning("MLflow at %s takes the run's points again", shown(self._journal.header["address"]))
                self.problem, pause, retry = None, self._interval_s, _RETRY_S[0]
            # Somebody who waits for us ends the pause.
            self._hurry.wait(pause)
            self._hurry.clear()

    def _send_some(self) -> None:
        if (problem := unreachable(self._journal.header["address"])) is not None:
            raise StoreUnreachableError(problem)
        if not self._run_id:
            self._run_id = self._open_run()
        entries = self._journal.read()
        self._send_values(entries)
        files = [(self._journal.folder / entry["file"], entry["path"]) for entry in entries if "file" in entry]
        # Of files that replace each other the last one is enough. A run ends after everything else.
        for path, source in {path: source for source, path in files}.items():
            self._send_file(source, path)
        for entry in entries:
            if "end" in entry:
                self._client.set_terminated(self._run_id, entry["end"], entry["at"])
        self._journal.acknowledge()
        self._uncertain = False
        for source, _ in files:
            shutil.rmtree(source.parent, ignore_errors=True)

    def _open_run(self) -> str:
        header = self._journal.header
        if self._client is None:
            self._client = connect(header["address"], make=header["run_id"] is None)
        if header["run_id"] is None:
            self._journal.update({"run_id": create_run(self._client, header)})
        elif header.get("continue"):
            self._client.update_run(header["run_id"], status="RUNNING")
        return str(header["run_id"])

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
        kinds: dict[str, tuple[Any, list[Any], int]] = {
            "metrics": (Metric, metrics, 900),
            "params": (Param, list(params.items()), 100),
            "tags": (RunTag, list(tags.items()), 100),
        }
        # MLflow takes so many at a time.
        for kind, (entity, items, most) in kinds.items():
            for start in range(0, len(items), most):
                self._send_batch(kind, [entity(*one) for one in items[start : start + most]])

    def _send_batch(self, kind: str, batch: list[Any]) -> None:
        """Send metrics, parameters or tags; one that MLflow refuses, as too long perhaps, is told and left out."""
        from mlflow.exceptions import MlflowException

        named: Any = {kind: batch}
        try:
            self._client.log_batch(self._run_id, **named)
            self._answers += 1
        except MlflowException as error:
            # MLflow says the same of a run that was deleted, and a proxy's 400 is another code: then everything stays.
            wrong = error.error_code == "INVALID_PARAMETER_VALUE"
            if not wrong or self._client.get_run(self._run_id).info.lifecycle_stage != "active":
                raise
            if len(batch) == 1:
                _log.warning("MLflow run %s refuses %s %r: %s", self._run_id, kind, batch[0].key, first_line(error))
                return
            for half in (batch[: len(batch) // 2], batch[len(batch) // 2 :]):
                self._send_batch(kind, half)

    def _send_file(self, source: Path, path: str) -> None:
        folder = PurePosixPath(path).parent.as_posix()
        # It is gone when it was sent and the process killed before it could say so.
        if source.is_file():
            self._client.log_artifact(self._run_id, str(source), None if folder == "." else folder)
            self._answers += 1

    def _missing(self, points: Sequence[Sequence[Any]]) -> list[Sequence[Any]]:
        """Those of the points that the run does not have."""
        known: set[tuple[Any, ...]] = set()
        for key in {key for key, *_ in points}:
            history = self._client.get_metric_history(self._run_id, key)
            known |= {_identity(point.key, point.value, point.timestamp, point.step) for point in history}
            self._answers += 1
        return list({_identity(*point): point for point in points if _identity(*point) not in known}.values())


def _identity(key: str, value: float, timestamp: int, step: int) -> tuple[Any, ...]:
    """What makes a point the same point; MLflow's databases keep infinity as the largest number."""
    largest = sys.float_info.max
    return key, timestamp, step, None if math.isnan(value) else max(min(value, largest), -largest)
