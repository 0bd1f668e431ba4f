"""The thread that tells MLflow what a journal holds, and keeps trying while MLflow does not answer."""

import logging
import threading
import time
from collections.abc import Callable

from avp_habitat.tracking.delivery import Delivery
from avp_habitat.tracking.journal import Journal
from avp_habitat.tracking.stores import StoreUnreachableError, first_line, shown, unreachable

INTERVAL_S = 5.0
"""Time between two calls while a run lasts; each costs the training tens of milliseconds of Python."""
_RETRY_S = (1.0, 15.0)
_ASKED_AGAIN, _FAILED_AGAIN = 2, 8
_THREAD = "avp-mlflow"
_log = logging.getLogger(__name__)


class Sender:
    """Sends one journal's entries until it is stopped."""

    def __init__(
        self,
        journal: Journal,
        address: str,
        open_delivery: Callable[[], Delivery],
        *,
        uncertain: bool,
        interval_s: float = INTERVAL_S,
    ) -> None:
        """Describe the work.

        Args:
            journal: to empty.
            address: of the store, for messages and to see whether a server answers at all.
            open_delivery: makes the run when it does not exist yet; may fail and is then tried again.
            uncertain: whether the first entries may have been sent by an earlier process.
            interval_s: between two calls.
        """
        self._journal = journal
        self._address = address
        self._open_delivery = open_delivery
        self._delivery: Delivery | None = None
        self._uncertain = uncertain
        self._interval_s = interval_s
        self._hurry = threading.Event()
        self._stopped = threading.Event()
        self._idle = threading.Event()
        self._unanswered = self._failures = 0
        self.problem: str | None = None
        """Why nothing arrives just now."""
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin."""
        # MLflow writes a hundred lines about each failure of a database; here one line says it once.
        logging.getLogger("mlflow.store.db.utils").addFilter(_not_ours)
        # A daemon, so that an interpreter that exits without `close` is not held up; the journal keeps the rest.
        self._thread = threading.Thread(target=self._work, name=_THREAD, daemon=True)
        self._thread.start()

    def drain(self, timeout_s: float) -> bool:
        """Send everything without waiting for the interval; whether MLflow has it.

        Args:
            timeout_s: to wait at most without any progress; a server that is gone is asked twice more instead.
        """
        if self._thread is None:
            return not self._journal
        self._hurry.set()
        try:
            return self._wait_while_it_moves(timeout_s)
        finally:
            self._hurry.clear()

    def stop(self, timeout_s: float = 5.0) -> bool:
        """End the thread; whether it ended, which a call that hangs may prevent."""
        self._stopped.set()
        self._hurry.set()
        if self._thread is None:
            return True
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _wait_while_it_moves(self, timeout_s: float) -> bool:
        until = time.monotonic() + timeout_s
        calls, asked, failed = self._calls, self._unanswered, self._failures
        while not self._journal.wait(0.2, for_entries=False):
            if self._calls > calls:
                calls = self._calls
                until = time.monotonic() + timeout_s
            gone = self._unanswered - asked >= _ASKED_AGAIN or self._failures - failed >= _FAILED_AGAIN
            if gone or time.monotonic() > until or not (self._thread and self._thread.is_alive()):
                return False
        return True

    @property
    def _calls(self) -> int:
        return 0 if self._delivery is None else self._delivery.calls

    def _work(self) -> None:
        pause = _RETRY_S[0]
        while not self._stopped.is_set():
            if not self._journal.wait(0.2, for_entries=True):
                continue
            try:
                self._send_some()
            except Exception as error:
                self._uncertain = True
                self._failures += 1
                self._unanswered += isinstance(error, StoreUnreachableError)
                self._failed(first_line(error))
                self._rest(pause)
                pause = min(2 * pause, _RETRY_S[1])
                continue
            self._worked()
            pause = _RETRY_S[0]
            self._hurry.wait(self._interval_s)

    def _rest(self, pause: float) -> None:
        """Wait before trying again; somebody who starts to wait for us ends it, and then makes it short."""
        if self._hurry.is_set():
            self._stopped.wait(min(pause, 0.5))
        else:
            self._hurry.wait(pause)

    def _send_some(self) -> None:
        if (problem := unreachable(self._address)) is not None:
            raise StoreUnreachableError(problem)
        if self._delivery is None:
            self._delivery = self._open_delivery()
        batch = self._journal.read()
        if batch is None:
            return
        self._delivery.send(batch.entries, uncertain=self._uncertain)
        self._journal.acknowledge(batch)
        self._uncertain = False
        self._delivery.forget_files(batch.entries)

    def _failed(self, reason: str) -> None:
        if self.problem is None:
            _log.warning(
                "MLflow at %s does not take the run's points now (%s); they are kept%s and sent when it does",
                shown(self._address),
                reason,
                "" if self._journal.folder is None else f" in {self._journal.folder}",
            )
        self.problem = reason

    def _worked(self) -> None:
        if self.problem is not None:
            _log.warning("MLflow at %s takes the run's points again", shown(self._address))
        self.problem = None


def _not_ours(record: logging.LogRecord) -> bool:
    return record.threadName != _THREAD
