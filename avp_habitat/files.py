"""Files and folders of results that exist only when they are whole."""

import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from avp_habitat.errors import AVPError, UsageError


def check_new(path: Path, *, option: str = "") -> None:
    """Refuse a path that exists; the message names the command's option that gave it, for example `--out`.

    Raises:
        UsageError: there is something, be it a dangling link.
    """
    if path.exists() or path.is_symlink():
        raise UsageError(f"{_named(path, option)}: exists already; choose another name or remove it")


def check_writable(path: Path, *, failure: type[AVPError] = AVPError, option: str = "--out") -> None:
    """Refuse a result's path by raising `failure` before long work; what is made to find out is removed again."""
    above = next(folder for folder in path.absolute().parents if folder.exists())
    try:
        with tempfile.TemporaryDirectory(prefix=".avp-", dir=above):
            pass
    except OSError as error:
        raise failure(f"{_named(path, option)}: cannot write there: {above}: {error.strerror or error}") from None


@contextmanager
def atomic_file(
    path: str | Path, *, replace: bool = True, failure: type[AVPError] | None = None, option: str = ""
) -> Iterator[Path]:
    """A context in which a file is written under another name; it gets its own when the context ends without an error.

    A reader, a second writer or a power cut sees the old file or the new one, never a part. Missing folders above it
    are made. The temporary name, which the context gives, is hidden, in the same folder, and ends in the same suffix.

    Args:
        path: the final name.
        replace: whether a file of that name is replaced; else it is refused, at the start and at the end.
        failure: what to raise in place of an `OSError`, also of one raised in the context; None lets those through.
        option: as for `check_new`.

    Raises:
        UsageError: the file exists and is not to be replaced.
    """
    path = Path(path)
    if not replace:
        check_new(path, option=option)
    with _partial(path, failure, option) as partial:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        if not replace:
            check_new(path, option=option)
        partial.replace(path)


@contextmanager
def atomic_folder(path: str | Path, *, failure: type[AVPError] | None = None, option: str = "") -> Iterator[Path]:
    """As `atomic_file`, for a folder, which must not exist; the temporary one is there and empty.

    An error or Ctrl-C removes what was written.

    Raises:
        UsageError: the folder exists, now or at the end.
    """
    path = Path(path)
    check_new(path, option=option)
    with _partial(path, failure, option) as partial:
        partial.mkdir(parents=True)
        yield partial
        if path.exists():
            raise UsageError(f"{_named(path, option)}: another program made it meanwhile; nothing was replaced")
        partial.rename(path)


def _named(path: Path, option: str) -> str:
    return f"{option} {path}".lstrip()


@contextmanager
def _partial(path: Path, failure: type[AVPError] | None, option: str) -> Iterator[Path]:
    """A path for a temporary file or folder, which is removed in the end."""
    # Libraries choose a file's format by its suffix, which therefore stays the last part of the name.
    partial = path.with_name(f".{path.stem}.partial-{secrets.token_hex(4)}{path.suffix}")
    try:
        yield partial
    except OSError as error:
        if failure is None:
            raise
        raise failure(f"{_named(path, option)}: cannot write there: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        with suppress(OSError):
            partial.unlink(missing_ok=True)
