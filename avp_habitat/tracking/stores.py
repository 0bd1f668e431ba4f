"""Where MLflow keeps runs: the address that an option means, and a client of a store that answers."""

import fcntl
import hashlib
import logging
import os
import re
import shlex
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from avp_habitat.errors import AVPError
from avp_habitat.files import atomic_file

if TYPE_CHECKING:
    from mlflow import MlflowClient

DEFAULT_ADDRESS = "sqlite:///mlflow.db"
DELIVER = "python -m avp_habitat.tracking.deliver"
OFFLINE_VARIABLE = "AVP_MLFLOW_OFFLINE"
ADDRESS_HELP = f"an MLflow address such as {DEFAULT_ADDRESS}; auto: MLFLOW_TRACKING_URI, or else {DEFAULT_ADDRESS}"
_SQLITE, _MAGIC = "sqlite:///", b"SQLite format 3\0"
_PROBE_S = 5.0


class TrackingError(AVPError):
    """An MLflow store that cannot be used, or does not take what it is given."""


class StoreUnreachableError(TrackingError):
    """An MLflow store that may be there another time."""


def address_of(option: str, *, default: str | None) -> str | None:
    """The address that an option means: itself, `auto` for `MLFLOW_TRACKING_URI` or else `default`; None for `off`."""
    if option == "off":
        return None
    return os.environ.get("MLFLOW_TRACKING_URI") or default if option == "auto" else option


def shown(address: str) -> str:
    """An address without the user's name and password."""
    return re.sub(r"//[^/@]*@", "//", address)


def how_to_look(address: str) -> str:
    """The page of the server at an address, or the command that opens one; without the address's password."""
    if urlsplit(address).scheme in ("http", "https"):
        return shown(address)
    return f"mlflow ui --backend-store-uri {shlex.quote(shown(address))}"


def about_run(run_id: str, address: str, *, delivered: bool = True) -> str:
    """Two lines on a run of a store: which one it is, and how to look at it, or to send what is not `delivered`."""
    send = f"send:     {DELIVER}  (MLflow does not have all of the run yet)"
    return f"MLflow:   run {run_id}\n" + (f"compare:  {how_to_look(address)}" if delivered else send)


def absolute(address: str) -> str:
    """An address that means the same in every folder."""
    if (file := file_of(address)) is not None:
        return _with_file(address, file)
    return address if urlsplit(address).scheme else str(Path(address).absolute())


def file_of(address: str) -> Path | None:
    """The database file that an address names; None for other stores and for a database in memory."""
    if not address.startswith(_SQLITE):
        return None
    from sqlalchemy.engine import make_url

    name = make_url(address).database or ":memory:"
    return None if name == ":memory:" or name.startswith("file:") else Path(name).absolute()


def _with_file(address: str, file: Path) -> str:
    from sqlalchemy.engine import make_url

    return make_url(address).set(database=str(file)).render_as_string(hide_password=False)


def is_missing(address: str) -> bool:
    """Whether an address names a database file that does not exist, which MLflow would make."""
    file = file_of(address)
    return file is not None and not file.exists()


def open_store(address: str, *, offline: bool | None = None) -> "MlflowClient | None":
    """A client of the store; None when it does not answer and `offline`, or else `AVP_MLFLOW_OFFLINE`, allows that.

    Raises:
        TrackingError: the store cannot be used.
    """
    try:
        return connect(address)
    except StoreUnreachableError as error:
        if offline or (offline is None and os.environ.get(OFFLINE_VARIABLE, "") not in ("", "0")):
            return None
        way = f"to go on without it and send everything later: {OFFLINE_VARIABLE}=1"
        raise StoreUnreachableError(f"{error}; {way}") from None


def connect(address: str, *, make: bool = True) -> "MlflowClient":
    """A client of a store that answers; `make` makes a database that is missing.

    Raises:
        StoreUnreachableError: the store cannot be reached now.
        TrackingError: MLflow is not installed, or does not know such addresses.
    """
    if (problem := unreachable(address)) is not None:
        raise StoreUnreachableError(_unusable(address, problem))
    # A new database otherwise announces each of its fifty migrations, and a failure takes a hundred lines.
    logging.getLogger("alembic").setLevel(logging.WARNING)
    logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)
    try:
        from mlflow import MlflowClient
    except ImportError as error:
        raise TrackingError(f"MLflow is asked for but not installed ({error}): pip install mlflow") from None
    try:
        if (file := file_of(address)) is not None:
            _prepare_file(address, file, make)
        client = MlflowClient(address)
        client.search_experiments(max_results=1)
    except Exception as error:
        never = getattr(error, "error_code", None) == "INVALID_PARAMETER_VALUE"
        kind = TrackingError if never else StoreUnreachableError
        raise kind(_unusable(address, shown(first_line(error)))) from None
    return client


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
    text = str(error).strip()
    # What a database says stands somewhere in SQLAlchemy's text: (sqlite3.OperationalError) database or disk is full
    of_database = re.search(r"^\((?:\w+\.)+\w+\) (.+)$", text, re.MULTILINE)
    return of_database[1] if of_database else text.partition("\n")[0] or repr(error)


@contextmanager
def locked(name: str) -> Iterator[None]:
    """Wait until no other program of this user is within a block of the same name."""
    with (Path(tempfile.gettempdir()) / f"avp-{os.getuid()}-{name}.lock").open("w") as file:
        with suppress(OSError):  # A file system without locks.
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _prepare_file(address: str, path: Path, make: bool) -> None:
    """Make a database, which appears when it has all tables; an `OSError` where MLflow would try for two minutes."""
    # Programs that start at once make one database, one after the other.
    with locked(hashlib.sha256(os.fsencode(path)).hexdigest()[:16]):
        if make and not path.exists():
            from mlflow.store.db import utils

            with atomic_file(path, replace=False, failure=TrackingError) as partial:
                partial.touch()  # SQLite would not say why it cannot.
                engine = utils.create_sqlalchemy_engine(_with_file(address, partial))
                try:
                    utils._initialize_tables(engine)
                finally:
                    engine.dispose()
    with path.open("r+b") as file:
        if file.read(len(_MAGIC)) not in (b"", _MAGIC):
            raise OSError(f"{path} is no SQLite database")


def _unusable(address: str, problem: str) -> str:
    return (
        f"MLflow at {shown(address)} cannot be used: {problem}; expected an address such as {DEFAULT_ADDRESS} or "
        "http://127.0.0.1:5000, or off"
    )
