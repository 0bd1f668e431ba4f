"""The folder of a reconstruction, written so that it exists only when it is whole."""

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from avp_habitat.errors import AVPError, UsageError

SCORES = "scores.json"


class ReconstructionFolder:
    """A context that writes to a temporary folder, renamed to its final name by `publish`.

    Leaving the context without `publish` (an error, Ctrl-C) removes the temporary folder.
    """

    def __init__(self, folder: Path) -> None:
        """Reserve a folder.

        Raises:
            UsageError: it exists.
        """
        self.folder = folder
        self._temporary = folder.parent / f".{folder.name}.partial-{os.getpid()}"
        if folder.exists() or folder.is_symlink():
            raise UsageError(f"--out {folder}: exists already; choose another name or remove it")

    def __enter__(self) -> "ReconstructionFolder":
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

    def write_scores(self, scores: Mapping[str, Any]) -> None:
        """Write `scores.json`."""
        self.path(SCORES).write_text(json.dumps(scores, indent=2, allow_nan=False) + "\n", encoding="utf-8")

    def publish(self) -> None:
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

    def _unwritable(self, error: OSError) -> AVPError:
        return AVPError(f"--out {self.folder}: cannot write there: {error.strerror or error}")
