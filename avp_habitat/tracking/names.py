"""Runs as the store knows them: found, made once, opened again."""

import os
import re
from typing import TYPE_CHECKING

from avp_habitat.tracking.stores import StoreUnreachableError, connect

if TYPE_CHECKING:
    from mlflow import MlflowClient
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from avp_habitat.tracking.experiments import experiment_id
from avp_habitat.tracking.stores import TrackingError, shown

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run


_BRACKETS, _UNSAFE = re.compile(r"[()\[\]{}]"), re.compile(r"[^\w.\- /]")
_MAX_NAME = 250


def safe_name(name: str) -> str:
    """A name that MLflow takes on every system and with every store.

    Brackets go, characters other than letters, digits, `_ . -`, space and `/` become `_`; empty and dotted path
    parts, which MLflow would resolve like a file path, go.
    """
    parts = (part.strip() for part in _UNSAFE.sub("_", _BRACKETS.sub("", name)).split("/"))
    return "/".join(part for part in parts if part not in ("", ".", ".."))[:_MAX_NAME].rstrip("/ ") or "_"


class Names:
    """The safe names of one run: each name has its own, also when two differ only in what MLflow refuses."""

    def __init__(self) -> None:
        """Begin without any."""
        self._safe: dict[str, str] = {}
        self._taken: set[str] = set()

    def __getitem__(self, name: str) -> str:
        """The safe name."""
        if name not in self._safe:
            self._safe[name] = self._free(safe_name(name))
            self._taken.add(self._safe[name])
        return self._safe[name]

    @property
    def changed(self) -> dict[str, str]:
        """Safe names by the names that MLflow refuses."""
        return {name: safe for name, safe in self._safe.items() if name != safe}

    def _free(self, name: str) -> str:
        candidate, count = name, 1
        while candidate in self._taken:
            count += 1
            candidate = f"{name[: _MAX_NAME - 4]} {count}"
        return candidate


OFFLINE_VARIABLE = "AVP_MLFLOW_OFFLINE"


def wants_offline(offline: bool | None) -> bool:
    """Whether to go on without the server: as said, else as the variable `AVP_MLFLOW_OFFLINE` says."""
    return os.environ.get(OFFLINE_VARIABLE, "") not in ("", "0") if offline is None else offline


def open_store(address: str, *, offline: bool | None = None, option: str | None = None) -> "MlflowClient | None":
    """A client of the store; None when it does not answer and we are told to go on without it.

    Args:
        address: of the store.
        offline: whether to go on without it; None as `AVP_MLFLOW_OFFLINE` says.
        option: how the caller's users say so, for the error's text, beside that variable.

    Raises:
        TrackingError: the store cannot be used.
    """
    try:
        return connect(address)
    except StoreUnreachableError as error:
        if wants_offline(offline):
            return None
        ways = ", or ".join(way for way in (option, f"{OFFLINE_VARIABLE}=1") if way)
        raise StoreUnreachableError(f"{error}; to go on without it and send everything later: {ways}") from None


OFFLINE = "offline-"
"""How the ids of runs begin that MLflow does not know yet; the key of their journal follows."""
KEY_TAG, PARENT_TAG = "avp.key", "mlflow.parentRunId"


def find_run(client: "MlflowClient", run_id: str | None) -> "Run | None":
    """The run of an id, also of one that was given offline; None when the store has none that is not deleted."""
    from mlflow.exceptions import MlflowException

    if not run_id:
        return None
    if run_id.startswith(OFFLINE):
        return _of_key(client, run_id.removeprefix(OFFLINE))
    try:
        run = client.get_run(run_id)
    except MlflowException as error:
        if error.error_code in ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE"):
            return None
        raise
    return run if run.info.lifecycle_stage == "active" else None


def existing_run(client: "MlflowClient", run_id: str) -> "Run":
    """The run of an id.

    Raises:
        TrackingError: there is none.
    """
    run = find_run(client, run_id)
    if run is None:
        raise TrackingError(f"MLflow run {run_id}: expected a run at {shown(client.tracking_uri)}, found none")
    return run


def create(client: "MlflowClient", header: Mapping[str, Any]) -> str:
    """The id of a journal's run, which is made when the store has none for its key.

    Args:
        client: of the store.
        header: of the journal: `key`, `experiment`, `experiment_id`, `name`, `tags`, `parent` and `started_ms`.
    """
    earlier = _of_key(client, header["key"]) if header.get("creating") else None
    if earlier is not None:
        return earlier.info.run_id
    identity, _ = experiment_id(client, header["experiment"], header.get("experiment_id"))
    tags = {**header["tags"], KEY_TAG: header["key"]}
    parent = find_run(client, header.get("parent"))
    # MLflow nests runs within one experiment only.
    if parent is not None and parent.info.experiment_id == identity:
        tags[PARENT_TAG] = parent.info.run_id
    run = client.create_run(identity, start_time=header["started_ms"], tags=tags, run_name=header["name"])
    return run.info.run_id


def reopen(client: "MlflowClient", run_id: str) -> None:
    """Make a run that ended go on."""
    client.update_run(run_id, status="RUNNING")


def _of_key(client: "MlflowClient", key: str) -> "Run | None":
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    found = client.search_runs(experiments, f"tags.`{KEY_TAG}` = '{key}'", max_results=1)
    return found[0] if found else None
