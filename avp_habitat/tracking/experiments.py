"""MLflow's experiments: which one is meant, and its id."""

import os
import time
from typing import TYPE_CHECKING

from avp_habitat.tracking.stores import TrackingError, shown

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Experiment

DEFAULT_EXPERIMENT = "avp"
NAME_VARIABLE, ID_VARIABLE = "MLFLOW_EXPERIMENT_NAME", "MLFLOW_EXPERIMENT_ID"
DEFAULT_HELP = f"{NAME_VARIABLE} or {ID_VARIABLE}, else {DEFAULT_EXPERIMENT}"
# MLflow's `Default`; `mlflow run` sets this id where nobody chose an experiment.
_NOBODYS_CHOICE = "0"
_ATTEMPTS = 5


def meant(option: str | None) -> tuple[str | None, str | None]:
    """The name or the id of the experiment that is meant; one of them is None.

    Args:
        option: a name; when omitted, what MLflow's variables say, which `mlflow.set_experiment` sets too, else `avp`.
    """
    if option:
        return option, None
    identity = os.environ.get(ID_VARIABLE)
    if identity and identity != _NOBODYS_CHOICE:
        return None, identity
    return os.environ.get(NAME_VARIABLE) or DEFAULT_EXPERIMENT, None


def find_experiment(client: "MlflowClient", name: str | None, identity: str | None = None) -> "Experiment | None":
    """The experiment of a name or an id; None when there is none of that name.

    Raises:
        TrackingError: it is deleted, or there is none of that id.
        MlflowException: the store does not answer.
    """
    found = client.get_experiment_by_name(name) if name is not None else _of_id(client, str(identity))
    if found is not None and found.lifecycle_stage != "active":
        restore = f"mlflow experiments restore --experiment-id {found.experiment_id}"
        raise TrackingError(
            f"MLflow experiment {found.name!r} at {shown(client.tracking_uri)} is deleted; bring it back with: "
            f"MLFLOW_TRACKING_URI={shown(client.tracking_uri)} {restore}, or choose another one (option experiment, "
            f"or {NAME_VARIABLE})"
        )
    return found


def _of_id(client: "MlflowClient", identity: str) -> "Experiment":
    from mlflow.exceptions import MlflowException

    try:
        return client.get_experiment(identity)
    except MlflowException as error:
        if error.error_code not in ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE"):
            raise
    raise TrackingError(f"{ID_VARIABLE}={identity}: MLflow at {shown(client.tracking_uri)} has no such experiment")


def experiment_id(client: "MlflowClient", name: str | None, identity: str | None = None) -> tuple[str, bool]:
    """The id of an experiment, which is made, with its views, when it does not exist; whether it was made now.

    Args:
        client: of the store.
        name: of the experiment.
        identity: its id, where there is no name.

    Raises:
        TrackingError: as `find_experiment`.
        MlflowException: the store refuses.
    """
    from mlflow.exceptions import MlflowException

    from avp_habitat.tracking.view import prepare_experiment

    for attempt in range(_ATTEMPTS):
        found = find_experiment(client, name, identity)
        if found is not None:
            return found.experiment_id, False
        try:
            made = client.create_experiment(str(name))
        except MlflowException:
            # Another process may have been faster.
            if attempt == _ATTEMPTS - 1:
                raise
            time.sleep(0.1)
        else:
            prepare_experiment(client, made)
            return made, True
    raise AssertionError
