"""Runs as the store knows them: found, made once, opened again."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from avp_habitat.tracking.addresses import TrackingError, shown
from avp_habitat.tracking.experiments import experiment_id

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

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
