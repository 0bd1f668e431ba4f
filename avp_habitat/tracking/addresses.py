"""Where MLflow keeps runs: the address that an option means, and a client of a store that answers."""

import hashlib
import logging
import os
import re
import socket
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from avp_habitat.errors import AVPError
from avp_habitat.tracking import database
from avp_habitat.tracking.locks import alone

if TYPE_CHECKING:
    from mlflow import MlflowClient

DEFAULT_ADDRESS = "sqlite:///mlflow.db"
_PROBE_S = 5.0


class TrackingError(AVPError):
    """An MLflow store that cannot be used, or does not take what it is given."""


class StoreUnreachableError(TrackingError):
    """An MLflow store that may be there another time."""


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
        StoreUnreachableError: the store cannot be reached now.
        TrackingError: MLflow is not installed, or does not know such addresses.
    """
    file = database.file_of(address)
    if (problem := unreachable(address)) is not None:
        raise StoreUnreachableError(_unusable(address, problem))
    if file is not None and (problem := database.fault_of(file)) is not None:
        elsewhere = "name another place, such as MLFLOW_TRACKING_URI=sqlite:////tmp/mlflow.db"
        raise StoreUnreachableError(f"MLflow at {shown(address)} cannot be used: {problem}; {elsewhere}")
    # A new database otherwise announces that it is made and each of its fifty migrations.
    for name in ("alembic", "mlflow.store.db.utils"):
        logging.getLogger(name).setLevel(logging.WARNING)
    try:
        from mlflow import MlflowClient

        with _one_at_a_time(file):
            if file is not None and not file.exists():
                database.make(file)
            client = MlflowClient(address)
            client.search_experiments(max_results=1)
    except ImportError as error:
        raise TrackingError(f"MLflow is asked for but not installed ({error}): pip install mlflow") from None
    except Exception as error:
        reason = _misunderstood(address, file, error)
        if reason is not None:
            raise TrackingError(_unusable(address, reason)) from None
        raise StoreUnreachableError(_unusable(address, first_line(error))) from None
    return client


def absolute(address: str) -> str:
    """An address that means the same in every folder."""
    file = database.file_of(address)
    if file is not None:
        options = address.partition("?")[1:]
        return f"{database.address_of(file)}{''.join(options)}"
    return address if urlsplit(address).scheme else str(Path(address).absolute())


def is_missing(address: str) -> bool:
    """Whether an address names a database file that does not exist, which MLflow would make."""
    file = database.file_of(address)
    return file is not None and not file.exists()


def unreachable(address: str) -> str | None:
    """Why the server of an address does not answer; None when it does, or when the address names no server.

    MLflow itself tries again for minutes before it says so.
    """
    parts = urlsplit(address)
    if parts.scheme not in ("http", "https"):
        return None
    try:
        port = parts.port or (443 if parts.scheme == "https" else 80)
        with socket.create_connection((parts.hostname or "", port), timeout=_PROBE_S):
            return None
    except (OSError, ValueError) as error:
        return f"no server answers there ({getattr(error, 'strerror', None) or error})"


def first_line(error: BaseException) -> str:
    """An error's text without its tail of hints and stack frames."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.strerror}: {error.filename!r}"
    text = str(error).strip()
    # What a database says stands somewhere in SQLAlchemy's text: (sqlite3.OperationalError) database or disk is full
    of_database = re.search(r"^\((?:\w+\.)+\w+\) (.+)$", text, re.MULTILINE)
    return of_database[1] if of_database else text.partition("\n")[0] or repr(error)


def _misunderstood(address: str, file: Path | None, error: Exception) -> str | None:
    """What is wrong with an address that can never work; None for another error."""
    line = first_line(error)
    if file is not None and re.search("already exists|duplicate column", line):
        return database.half_made(file)
    if "MLFLOW_ALLOW_FILE_STORE" in line:
        return "MLflow 3 keeps runs in a folder only when the variable MLFLOW_ALLOW_FILE_STORE=true is set"
    if "unsupported URI" in line:
        known = line.partition("[")[2].partition("]")[0]
        return f"unknown scheme {urlsplit(address).scheme!r}; MLflow knows {known}"
    return None


def _one_at_a_time(file: Path | None) -> AbstractContextManager[None]:
    """Keeps other programs from making the same database at the same time."""
    return nullcontext() if file is None else alone(f"mlflow-{hashlib.sha256(os.fsencode(file)).hexdigest()[:16]}")


def _unusable(address: str, problem: str) -> str:
    return (
        f"MLflow at {shown(address)} cannot be used: {problem}; expected an address such as {DEFAULT_ADDRESS} or "
        "http://127.0.0.1:5000, or off"
    )
