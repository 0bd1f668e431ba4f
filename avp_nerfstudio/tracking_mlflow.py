"""A reconstruction as an MLflow run: opened or continued, filled while it lasts, closed with the right status."""

import logging
import os
import re
import time
import warnings
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from avp_habitat.errors import AVPError
from avp_nerfstudio.tracking_facts import Facts, safe_name

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Metric, Run

Status = Literal["FINISHED", "FAILED", "KILLED"]

RUN_FILE = "mlflow_run_id.txt"
DEFAULT_ADDRESS = "sqlite:///mlflow.db"
DEFAULT_EXPERIMENT = "avp"
_PARENT = "mlflow.parentRunId"
_INTERVAL_S = 5.0
_MAX_METRICS, _MAX_PARAMS = 1000, 100


class TrackingError(AVPError):
    """An MLflow store that does not take what it is given."""


def address_of(option: str, *, default: str | None) -> str | None:
    """The MLflow address that an option means.

    Args:
        option: an address, `auto` for `MLFLOW_TRACKING_URI`, or `off`.
        default: of `auto` where that variable is not set.

    Returns:
        None for no tracking.
    """
    if option == "off":
        return None
    return os.environ.get("MLFLOW_TRACKING_URI") or default if option == "auto" else option


def shown(address: str) -> str:
    """An address without the user's name and password."""
    return re.sub(r"//[^/@]*@", "//", address)


def connect(address: str) -> "MlflowClient":
    """A client of a store that answers.

    Raises:
        TrackingError: MLflow is not installed, or the store cannot be reached.
    """
    # A new database otherwise announces that it is made and each of its fifty migrations.
    for name in ("alembic", "mlflow.store.db.utils"):
        logging.getLogger(name).setLevel(logging.WARNING)
    try:
        from mlflow import MlflowClient

        client = MlflowClient(address)
        client.search_experiments(max_results=1)
    except ImportError as error:
        raise TrackingError(f"MLflow is asked for but not installed ({error}): pip install mlflow") from None
    except Exception as error:
        line = str(error).strip().partition("\n")[0]
        raise TrackingError(
            f"MLflow at {shown(address)} cannot be used: {line}; expected an address such as {DEFAULT_ADDRESS}, or off"
        ) from None
    return client


def open_run(
    client: "MlflowClient", facts: Facts, *, folder: Path, experiment: str | None = None, again: bool = False
) -> "TrackedRun":
    """The run of a training: a new one, or `again` that which its folder remembers, if the store has it.

    A new run lies in the experiment of the policy's run, as its child, when the store has that and no experiment is
    named: MLflow nests runs within one experiment only.

    Args:
        client: of the store.
        facts: of the training.
        folder: of the training, where the run's id is remembered.
        experiment: MLflow's, made when it does not exist; `avp` when neither named nor given by the policy's run.
        again: whether the training's earlier run is wanted.

    Raises:
        TrackingError: the store refuses.
    """
    try:
        earlier = _remembered(client, folder) if again else None
        run = earlier or _new(client, facts, experiment)
        _log_facts(client, run, facts)
    except Exception as error:
        raise TrackingError(f"MLflow at {shown(client.tracking_uri)} did not take the run: {error}") from error
    try:
        (folder / RUN_FILE).write_text(run.info.run_id + "\n", encoding="ascii")
    except OSError as error:
        warnings.warn(
            f"{folder / RUN_FILE}: a later log will make a new run, because this failed: {error}", stacklevel=2
        )
    return TrackedRun(client, run.info.run_id, continued=earlier is not None)


def remembered_id(folder: Path) -> str | None:
    """The run id that a training's folder remembers."""
    try:
        return (folder / RUN_FILE).read_text(encoding="ascii").strip() or None
    except (OSError, UnicodeDecodeError):
        return None


class TrackedRun:
    """An open run; metrics go there in the background, and a failing store costs a warning, not the training."""

    def __init__(self, client: "MlflowClient", run_id: str, *, continued: bool) -> None:
        """A run that is `continued` keeps the status it has."""
        self.client = client
        self.run_id = run_id
        self.continued = continued
        self._metrics: list[Metric] = []
        self._sent_at = time.monotonic()
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="avp-mlflow")
        self._pending: list[Future[Any]] = []

    def scalar(self, name: str, value: float, step: int, *, timestamp: float | None = None) -> None:
        """Queue a metric; `timestamp` is in seconds since 1970, now when omitted."""
        from mlflow.entities import Metric

        self._metrics.append(Metric(safe_name(name), value, int(1000 * (timestamp or time.time())), step))
        if len(self._metrics) >= _MAX_METRICS or time.monotonic() - self._sent_at > _INTERVAL_S:
            self._send()

    def files(self, paths: Iterable[Path], folder: str | None = None) -> None:
        """Store files as artifacts.

        Raises:
            TrackingError: the store refuses.
        """
        for path in paths:
            try:
                self.client.log_artifact(self.run_id, os.fspath(path), folder)
            except Exception as error:
                raise TrackingError(f"MLflow run {self.run_id} did not take {path}: {error}") from error

    def close(self, status: Status, *, files: Iterable[Path] = ()) -> None:
        """Store what is queued, and files as artifacts, and close the run; a store that fails now is a warning."""
        try:
            self.files(files)
            self._send()
            self._pool.shutdown(wait=True)
            for future in self._pending:
                future.result()
        except Exception as error:
            warnings.warn(f"MLflow run {self.run_id}: not everything was stored: {error}", stacklevel=2)
        if not self.continued:
            try:
                self.client.set_terminated(self.run_id, status)
            except Exception as error:
                warnings.warn(f"MLflow run {self.run_id} could not be closed: {error}", stacklevel=2)

    def _send(self) -> None:
        self._sent_at = time.monotonic()
        metrics, self._metrics = self._metrics, []
        if metrics:
            self._pending.append(self._pool.submit(self.client.log_batch, self.run_id, metrics=metrics))


def _remembered(client: "MlflowClient", folder: Path) -> "Run | None":
    run = _find(client, remembered_id(folder))
    return run if run is not None and run.info.lifecycle_stage == "active" else None


def _find(client: "MlflowClient", run_id: str | None) -> "Run | None":
    from mlflow.exceptions import MlflowException

    if not run_id:
        return None
    try:
        return client.get_run(run_id)
    except MlflowException:
        return None


def _new(client: "MlflowClient", facts: Facts, experiment: str | None) -> "Run":
    from mlflow.tracking.context.registry import resolve_tags

    policy = _find(client, facts.policy_run)
    if experiment is None and policy is not None:
        identity = policy.info.experiment_id
    else:
        identity = _experiment_id(client, experiment or DEFAULT_EXPERIMENT)
    nested = policy is not None and policy.info.experiment_id == identity
    parent: dict[str, Any] = {_PARENT: facts.policy_run} if nested else {}
    return client.create_run(identity, run_name=facts.name, tags=resolve_tags() | facts.tags | parent)


def _experiment_id(client: "MlflowClient", name: str) -> str:
    found = client.get_experiment_by_name(name)
    return found.experiment_id if found else client.create_experiment(name)


def _log_facts(client: "MlflowClient", run: "Run", facts: Facts) -> None:
    """The settings and figures that the run does not have yet: MLflow refuses to change a setting."""
    from mlflow.entities import Metric, Param

    now = int(1000 * time.time())
    metrics = [Metric(key, value, now, 0) for key, value in facts.metrics.items() if key not in run.data.metrics]
    client.log_batch(run.info.run_id, metrics=metrics)

    params = [Param(key, value) for key, value in facts.params.items() if key not in run.data.params]
    for start in range(0, len(params), _MAX_PARAMS):
        client.log_batch(run.info.run_id, params=params[start : start + _MAX_PARAMS])
