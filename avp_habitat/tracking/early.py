"""A store looked at before long work begins, so that a mistyped one is told at once; or gone without, when told to."""

import os
from typing import TYPE_CHECKING

from avp_habitat.tracking.addresses import StoreUnreachableError, connect

if TYPE_CHECKING:
    from mlflow import MlflowClient

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
