"""A folder of results that exists only when it is whole."""

import os
import shutil
import tempfile
from pathlib import Path
from types import TracebackType

from avp_habitat.errors import AVPError, UsageError


def check_writable(path: Path, *, failure: type[AVPError] = AVPError) -> None:
    """Refuse a result's path before long work; what is made to find out is removed again.

    Args:
        path: of a new file or folder, as `--out` gave it.
        failure: what is raised.
    """
    above = next(folder for folder in path.absolute().parents if folder.exists())
    try:
        with tempfile.TemporaryDirectory(prefix=".avp-", dir=above):
            pass
    except OSError as error:
        raise failure(f"--out {path}: cannot write there: {above}: {error.strerror or error}") from None


class NewFolder:
    """A context that makes a temporary folder, renamed to its final name by `publish`.

    Leaving the context without `publish` (an error, Ctrl-C) removes the temporary folder.
    """

    def __init__(self, folder: str | Path, *, failure: type[AVPError] = AVPError) -> None:
        """Reserve a folder.

        Args:
            folder: the final name; must not exist.
            failure: what is raised where nothing can be written.

        Raises:
            UsageError: the folder exists.
        """
        self.folder = Path(folder)
        self._failure = failure
        self._temporary = self.folder.parent / f".{self.folder.name}.partial-{os.getpid()}"
        if self.folder.exists() or self.folder.is_symlink():
            raise UsageError(f"--out {self.folder}: exists already; choose another name or remove it")

    def __enter__(self) -> "NewFolder":
        """Make the temporary folder."""
        try:
            self._temporary.mkdir(parents=True)
        except OSError as error:
            raise self._unwritable(error) from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove what was not published; report a full or failing disk as such."""
        shutil.rmtree(self._temporary, ignore_errors=True)
        if isinstance(error, OSError):
            raise self._unwritable(error) from error

    def path(self, name: str) -> Path:
        """Where to write a file or folder of it now."""
        return self._temporary / name

    def publish(self) -> Path:
        """Give the folder its final name.

        Raises:
            UsageError: a folder of that name has appeared meanwhile.
        """
        try:
            self._temporary.rename(self.folder)
        except OSError:
            if self.folder.exists():
                raise UsageError(
                    f"--out {self.folder}: another program made it meanwhile; nothing was replaced"
                ) from None
            raise
        return self.folder

    def _unwritable(self, error: OSError) -> AVPError:
        return self._failure(f"--out {self.folder}: cannot write there: {error.strerror or error}")
