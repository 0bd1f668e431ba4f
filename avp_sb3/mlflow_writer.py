"""An output format of Stable-Baselines3's logger that writes to an MLflow run."""

import re
import threading
import time
import warnings
from dataclasses import dataclass
from numbers import Real
from queue import Empty, SimpleQueue
from typing import Any

from mlflow import MlflowClient
from mlflow.entities import Metric, RunTag
from stable_baselines3.common.logger import KVWriter

FORMAT = "mlflow"
"""The name by which `logger.record(..., exclude="mlflow")` keeps a value away from MLflow."""
_UNSAFE = re.compile(r"[^\w.\- /]")
_MAX_NAME, _MAX_TAG = 250, 5000
_MAX_METRICS = 1000
"""Of one call of MLflow."""
_INTERVAL_S = 5.0
"""Time between two calls while a training runs."""


def safe_name(name: str) -> str:
    """A name that MLflow takes for metrics, parameters and tags on every system.

    Characters other than letters, digits, `_ . -`, space and `/` become `_`; empty and dotted path parts, which
    MLflow would resolve like a file path, go.
    """
    parts = (part for part in _UNSAFE.sub("_", name).split("/") if part not in ("", ".", ".."))
    return "/".join(parts)[:_MAX_NAME].rstrip("/") or "_"


@dataclass(frozen=True)
class _Batch:
    """What one dump of the logger leaves for MLflow."""

    metrics: list[Metric]
    """Numbers."""
    tags: list[RunTag]
    """Texts."""


class MLflowWriter(KVWriter):
    """Sends what the logger dumps to a run in the background; a failing server costs a warning, not the training.

    It has a thread of its own because the pool of MLflow's asynchronous logging is gone when Python's exit handlers
    run, which is when the metrics of an interrupted training have to be stored.
    """

    def __init__(self, client: MlflowClient, run_id: str) -> None:
        """Write to a run.

        Args:
            client: of the tracking server that holds the run.
            run_id: the run; it stays open.
        """
        self._client = client
        self._run_id = run_id
        self._queue: SimpleQueue[_Batch | None] = SimpleQueue()
        self._thread: threading.Thread | None = None
        self._error: Exception | None = None
        self._warned: set[str] = set()

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Queue numbers as metrics at `step` (environment steps) and texts as tags; other kinds are named once."""
        now = int(time.time() * 1000)
        batch = _Batch([], [])
        for key, value in key_values.items():
            if FORMAT in (key_excluded.get(key) or ()):
                continue
            if isinstance(value, str):
                batch.tags.append(RunTag(safe_name(key), value[:_MAX_TAG]))
            elif (number := _number(value)) is not None:
                batch.metrics.append(Metric(safe_name(key), number, now, step))
            else:
                self._warn_once(key, f"{key}: MLflow takes numbers and texts here, not {type(value).__name__}")
        if batch.metrics or batch.tags:
            self._start()
            self._queue.put(batch)

    def flush(self) -> None:
        """Wait until everything queued is stored; what could not be stored is a warning."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join()
            self._thread = None
        if self._error is not None:
            error, self._error = self._error, None
            self._warn_once("", f"MLflow run {self._run_id}: some metrics were not stored: {error}")

    def close(self) -> None:
        """Flush."""
        self.flush()

    def _start(self) -> None:
        if self._thread is None:
            # A daemon, so that an interpreter that exits without a flush is not held up.
            self._thread = threading.Thread(target=self._send_all, name="avp-mlflow", daemon=True)
            self._thread.start()

    def _send_all(self) -> None:
        last = False
        while not last:
            batch, last = self._collect()
            for start in range(0, max(len(batch.metrics), bool(batch.tags)), _MAX_METRICS):
                try:
                    metrics = batch.metrics[start : start + _MAX_METRICS]
                    self._client.log_batch(self._run_id, metrics=metrics, tags=batch.tags if start == 0 else [])
                except Exception as error:
                    self._error = error

    def _collect(self) -> tuple[_Batch, bool]:
        """All that is dumped within an interval, and whether a flush is waiting for it.

        A fast training dumps many times a second, and each call of MLflow costs tens of milliseconds of Python, which
        the training would wait for.
        """
        whole, tags = _Batch([], []), {}
        until = time.monotonic() + _INTERVAL_S
        batch = self._queue.get()
        while batch is not None:
            whole.metrics.extend(batch.metrics)
            tags |= {tag.key: tag for tag in batch.tags}
            try:
                batch = self._queue.get(timeout=max(until - time.monotonic(), 0.001))
            except Empty:
                break
        whole.tags.extend(tags.values())
        return whole, batch is None

    def _warn_once(self, key: str, text: str) -> None:
        if key not in self._warned:
            self._warned.add(key)
            warnings.warn(text, stacklevel=3)


def _number(value: Any) -> float | None:
    """A Python, numpy or one-element tensor number as float; None for anything else."""
    if isinstance(value, Real):
        return float(value)
    if getattr(value, "shape", None) == () and hasattr(value, "item"):
        return float(value.item())
    return None
