"""Experiments of a store and the runs in them: found, made once, opened again."""

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from avp_habitat.tracking.names import KEY_TAG, OFFLINE, PARENT_TAG
from avp_habitat.tracking.stores import TrackingError, shown
from avp_habitat.tracking.view import prepare_experiment

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Experiment, Run

DEFAULT_EXPERIMENT = "avp"
NAME_VARIABLE, ID_VARIABLE = "MLFLOW_EXPERIMENT_NAME", "MLFLOW_EXPERIMENT_ID"
DEFAULT_HELP = f"{NAME_VARIABLE} or {ID_VARIABLE}, else {DEFAULT_EXPERIMENT}"
_NOT_THERE = ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE")


def chosen_experiment(option: str | None) -> tuple[str | None, str | None]:
    """The name, or else the id, of the experiment that runs go to: the option, else what MLflow's variables say."""
    if option:
        return option, None
    identity = os.environ.get(ID_VARIABLE)
    # `mlflow run` sets the id of MLflow's `Default`, 0, where nobody chose an experiment.
    if identity and identity != "0":
        return None, identity
    return os.environ.get(NAME_VARIABLE) or DEFAULT_EXPERIMENT, None


def find_experiment(client: "MlflowClient", name: str | None, identity: str | None = None) -> "Experiment | None":
    """The experiment of a name or an id; None when there is none of that name.

    Raises:
        TrackingError: it is deleted, or there is none of that id.
        MlflowException: the store does not answer.
    """
    from mlflow.exceptions import MlflowException

    store = shown(client.tracking_uri)
    try:
        found = client.get_experiment_by_name(name) if name is not None else client.get_experiment(str(identity))
    except MlflowException as error:
        if name is not None or error.error_code not in _NOT_THERE:
            raise
        raise TrackingError(f"{ID_VARIABLE}={identity}: MLflow at {store} has no such experiment") from None
    if found is not None and found.lifecycle_stage != "active":
        restore = f"MLFLOW_TRACKING_URI={store} mlflow experiments restore --experiment-id {found.experiment_id}"
        raise TrackingError(f"MLflow experiment {found.name!r} at {store} is deleted; bring it back with: {restore}")
    return found


def experiment_id(client: "MlflowClient", name: str | None, identity: str | None = None) -> str:
    """As `find_experiment`, the id; of a name that is not there the experiment is made, with its views."""
    from mlflow.exceptions import MlflowException

    if (found := find_experiment(client, name, identity)) is not None:
        return found.experiment_id
    try:
        made = client.create_experiment(str(name))
    except MlflowException:
        # Another process may have been faster.
        if (found := find_experiment(client, name)) is None:
            raise
        return found.experiment_id
    prepare_experiment(client, made)
    return made


def find_run(client: "MlflowClient", run_id: str | None) -> "Run | None":
    """The run of an id, also of one that was given offline; None when the store has none that is not deleted."""
    from mlflow.exceptions import MlflowException

    if not run_id:
        return None
    if run_id.startswith(OFFLINE):
        return next(iter(search_tags(client, {KEY_TAG: run_id.removeprefix(OFFLINE)})), None)
    try:
        run = client.get_run(run_id)
    except MlflowException as error:
        if error.error_code in _NOT_THERE:
            return None
        raise
    return run if run.info.lifecycle_stage == "active" else None


def existing_run(client: "MlflowClient", run_id: str) -> "Run":
    """As `find_run`, but a run that is not there is a `TrackingError`."""
    if (run := find_run(client, run_id)) is None:
        raise TrackingError(f"MLflow run {run_id}: expected a run at {shown(client.tracking_uri)}, found none")
    return run


def search_tags(client: "MlflowClient", tags: Mapping[str, str], home: str | None = None) -> "list[Run]":
    """The runs that have these tags, of the experiment of the id `home`, else of all."""
    homes = [home] if home else [experiment.experiment_id for experiment in client.search_experiments()]
    return list(client.search_runs(homes, " AND ".join(f"tags.`{name}` = '{tags[name]}'" for name in tags)))


def create_run(client: "MlflowClient", header: Mapping[str, Any]) -> str:
    """The id of the run of a journal with this header, which is made when the store has none for its key."""
    if (earlier := find_run(client, f"{OFFLINE}{header['key']}")) is not None:
        return earlier.info.run_id
    identity = experiment_id(client, header["experiment"], header.get("experiment_id"))
    tags = {**header["tags"], KEY_TAG: header["key"]}
    parent = find_run(client, header.get("parent"))
    # MLflow nests runs within one experiment only.
    if parent is not None and parent.info.experiment_id == identity:
        tags[PARENT_TAG] = parent.info.run_id
    run = client.create_run(identity, start_time=header["started_ms"], tags=tags, run_name=header["name"])
    return run.info.run_id
