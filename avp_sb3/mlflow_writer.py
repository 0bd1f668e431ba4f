"""An output format of Stable-Baselines3's logger that writes to an MLflow run."""

import re
import time
import warnings
from collections import deque
from numbers import Real
from typing import Any

from mlflow import MlflowClient
from mlflow.entities import Metric, RunTag
from mlflow.exceptions import MlflowException
from stable_baselines3.common.logger import KVWriter

FORMAT = "mlflow"
"""The name by which `logger.record(..., exclude="mlflow")` keeps a value away from MLflow."""
_UNSAFE = re.compile(r"[^\w.\- /]")


def safe_name(name: str) -> str:
    """A name that MLflow takes for metrics, parameters and tags on every system.

    Characters other than letters, digits, `_ . -`, space and `/` become `_`; empty and dotted path parts, which
    MLflow would resolve like a file path, go.
    """
    parts = (part for part in _UNSAFE.sub("_", name).split("/") if part not in ("", ".", ".."))
    return "/".join(parts)[:250].rstrip("/") or "_"


class MLflowWriter(KVWriter):
    """Sends what the logger dumps to a run, in the background; a failing server costs a warning, not the training."""

    def __init__(self, client: MlflowClient, run_id: str) -> None:
        """Write to a run.

        Args:
            client: of the tracking server that holds the run.
            run_id: the run; it stays open.
        """
        self._client = client
        self._run_id = run_id
        self._pending: deque[Any] = deque()
        self._warned: set[str] = set()

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Queue numbers as metrics at `step` (environment steps) and texts as tags; other kinds are named once."""
        now = int(time.time() * 1000)
        metrics, tags = [], []
        for key, value in key_values.items():
            if FORMAT in (key_excluded.get(key) or ()):
                continue
            if isinstance(value, str):
                tags.append(RunTag(safe_name(key), value[:5000]))
            elif (number := _number(value)) is not None:
                metrics.append(Metric(safe_name(key), number, now, step))
            else:
                self._warn_once(key, f"{key}: MLflow takes numbers and texts here, not {type(value).__name__}")
        if metrics or tags:
            self._send(metrics, tags)

    def flush(self) -> None:
        """Wait until everything queued is stored."""
        while self._pending:
            self._settle(self._pending.popleft())

    def close(self) -> None:
        """Flush."""
        self.flush()

    def _send(self, metrics: list[Metric], tags: list[RunTag]) -> None:
        while self._pending and all(future.done() for future in self._pending[0]._operation_futures):
            self._settle(self._pending.popleft())
        operation = self._client.log_batch(self._run_id, metrics=metrics, tags=tags, synchronous=False)
        if operation is not None:
            self._pending.append(operation)

    def _settle(self, operation: Any) -> None:
        try:
            operation.wait()
        except MlflowException as error:
            self._warn_once("", f"MLflow run {self._run_id}: some metrics were not stored: {error}")

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
