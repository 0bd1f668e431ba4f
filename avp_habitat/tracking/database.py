"""MLflow's database in one file: looked at before MLflow tries for minutes, and made whole or not at all."""

import os
import socket
import sqlite3
from contextlib import closing, suppress
from pathlib import Path

SQLITE = "sqlite:///"
_MAGIC = b"SQLite format 3\0"


def file_of(address: str) -> Path | None:
    """The database file that an address names; None for other stores and for a database in memory."""
    name = _decoded(address) if "%" in address else address.removeprefix(SQLITE).partition("?")[0]
    in_file = address.startswith(SQLITE) and name not in ("", ":memory:") and not name.startswith("file:")
    return Path(name).absolute() if in_file else None


def address_of(path: Path) -> str:
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
    engine = utils.create_sqlalchemy_engine(address_of(part))
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
