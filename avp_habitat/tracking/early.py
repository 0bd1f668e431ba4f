"""A store looked at before long work begins, so that what is mistyped is told at once."""

from typing import TYPE_CHECKING

from avp_habitat.tracking.addresses import StoreUnreachableError, connect
from avp_habitat.tracking.opening import OFFLINE_VARIABLE, wants_offline

if TYPE_CHECKING:
    from mlflow import MlflowClient


def open_store(address: str) -> "MlflowClient | None":
    """A client of the store; None when it does not answer and `AVP_MLFLOW_OFFLINE` says to go on without it.

    Raises:
        TrackingError: the store cannot be used.
    """
    try:
        return connect(address)
    except StoreUnreachableError as error:
        if wants_offline(None):
            return None
        raise StoreUnreachableError(
            f"{error}; to go on without it and send everything later: {OFFLINE_VARIABLE}=1"
        ) from None
