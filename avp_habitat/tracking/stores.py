"""Where MLflow keeps runs: the address that an option means, and a client of a store that answers."""

import hashlib
import logging
import os
import re
import shlex
import socket
import sqlite3
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from avp_habitat.errors import AVPError
from avp_habitat.tracking.journal import alone

if TYPE_CHECKING:
    from mlflow import MlflowClient


DELIVER = "python -m avp_habitat.tracking.deliver"


def how_to_look(address: str) -> str:
    """The server's page, or the command that opens one.

    Args:
        address: of the store; its password is not repeated.
    """
    if urlsplit(address).scheme in ("http", "https"):
        return shown(address)
    return f"mlflow ui --backend-store-uri {shlex.quote(shown(address))}"


def about_run(run_id: str, address: str, *, delivered: bool = True) -> str:
    """Two lines on a run.

    Args:
        run_id: MLflow's, or one given offline.
        address: of its store.
        delivered: whether MLflow has all of it.
    """
    lines = [f"MLflow:   run {run_id}"]
    if not delivered:
        lines.append(f"send:     {DELIVER}  (MLflow does not have all of the run yet)")
    else:
        lines.append(f"compare:  {how_to_look(address)}")
    return "\n".join(lines)


SQLITE = "sqlite:///"
_MAGIC = b"SQLite format 3\0"


def file_of(address: str) -> Path | None:
    """The database file that an address names; None for other stores and for a database in memory."""
    name = _decoded(address) if "%" in address else address.removeprefix(SQLITE).partition("?")[0]
    in_file = address.startswith(SQLITE) and name not in ("", ":memory:") and not name.startswith("file:")
    return Path(name).absolute() if in_file else None


def sqlite_address(path: Path) -> str:
    """What names a database file for MLflow, whatever characters its path has."""
    if not set("%?#") & set(str(path)):
        return f"{SQLITE}{path}"
    from sqlalchemy.engine import URL

    return URL.create("sqlite", database=str(path)).render_as_string()


def _decoded(address: str) -> str:
    """The path in an address; newer versions of SQLAlchemy read `%20` as a space there."""
    if not address.startswith(SQLITE):
        return ""
    from sqlalchemy.engine import make_url

    return make_url(address).database or ""


def fault_of(path: Path) -> str | None:
    """Why MLflow could not use a file, existing or not; None when it can. MLflow itself tries ten times for that."""
    if path.is_dir():
        return "it is a folder"
    # A file that cannot be read is named below.
    with suppress(OSError), path.open("rb") as file:
        if file.read(len(_MAGIC)) not in (b"", _MAGIC):
            return "it is no SQLite database"
    folder = next(parent for parent in path.parents if parent.exists())
    if not folder.is_dir():
        return f"{folder} is no folder"
    unwritable = [place for place in (path, folder) if place.exists() and not os.access(place, os.W_OK)]
    return f"{unwritable[0]} cannot be written" if unwritable else None


def make(path: Path) -> None:
    """Make a new database, which appears when it has all tables: MLflow cannot go on with one that is half-made.

    To be called by one program of this machine at a time.

    Args:
        path: of the file; one that appears meanwhile stays as it is.

    Raises:
        OSError: the folder takes nothing.
    """
    from mlflow.store.db import utils

    path.parent.mkdir(parents=True, exist_ok=True)
    # One name for each machine that shares the folder, so that what a killed program left is found and made anew.
    part = path.with_name(f".{path.name}.{socket.gethostname()}-{os.getuid()}.part")
    _remove(part)
    engine = utils.create_sqlalchemy_engine(sqlite_address(part))
    try:
        utils._initialize_tables(engine)
        engine.dispose()
        _publish(part, path)
    finally:
        engine.dispose()
        _remove(part)


def half_made(path: Path) -> str:
    """What to do with a database that another program was killed in the middle of making."""
    with closing(sqlite3.connect(path)) as database:
        try:
            (runs,) = database.execute("SELECT COUNT(*) FROM runs").fetchone()
        except sqlite3.Error:
            runs = 0
    what = "a program was killed while it made the database"
    if runs:
        return f"{what} anew; it holds {runs} runs, so put back a copy that you have, or move it away"
    return f"{what}, which holds no run: remove {path} and start again"


def _publish(part: Path, path: Path) -> None:
    try:
        os.link(part, path)
    except FileExistsError:
        pass
    except OSError:
        # A file system without hard links.
        part.rename(path)


def _remove(part: Path) -> None:
    for suffix in ("", "-journal", "-wal", "-shm"):
        part.with_name(part.name + suffix).unlink(missing_ok=True)


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
    file = file_of(address)
    if (problem := unreachable(address)) is not None:
        raise StoreUnreachableError(_unusable(address, problem))
    if file is not None and (problem := fault_of(file)) is not None:
        elsewhere = "name another place, such as MLFLOW_TRACKING_URI=sqlite:////tmp/mlflow.db"
        raise StoreUnreachableError(f"MLflow at {shown(address)} cannot be used: {problem}; {elsewhere}")
    # A new database otherwise announces that it is made and each of its fifty migrations.
    for name in ("alembic", "mlflow.store.db.utils"):
        logging.getLogger(name).setLevel(logging.WARNING)
    try:
        from mlflow import MlflowClient

        with _one_at_a_time(file):
            if file is not None and not file.exists():
                make(file)
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
    file = file_of(address)
    if file is not None:
        options = address.partition("?")[1:]
        return f"{sqlite_address(file)}{''.join(options)}"
    return address if urlsplit(address).scheme else str(Path(address).absolute())


def is_missing(address: str) -> bool:
    """Whether an address names a database file that does not exist, which MLflow would make."""
    file = file_of(address)
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
        return half_made(file)
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
