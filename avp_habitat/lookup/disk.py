"""Finished tiles of tables on disk, so that a scene's rays are cast once and not once per training."""

import os
import tempfile
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ENVIRONMENT = "AVP_CACHE"
"""Environment variable that names the folder of the cache; empty keeps nothing on disk."""


def cache_folder() -> Path | None:
    """Where tables are kept: `$AVP_CACHE`, else `avp` in the user's cache folder.

    Returns:
        None when `$AVP_CACHE` is empty, or the user has no home, as in some containers.
    """
    chosen = os.environ.get(ENVIRONMENT)
    if chosen is not None:
        return Path(chosen) if chosen else None
    caches = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return caches / "avp" if caches.is_absolute() else None


class TileFiles:
    """The files of one scene's tables: an unsound one is made anew, one that cannot be written costs a warning."""

    def __init__(self, name: str) -> None:
        """Use the folder `name` of the cache."""
        folder = cache_folder()
        self._folder = None if folder is None else folder / "tables" / name

    def read(
        self, tile: tuple[int, int], points: NDArray[np.integer], like: Mapping[str, NDArray]
    ) -> dict[str, NDArray] | None:
        """A tile's tables by name, or None where there is no sound file for these `(k, 2)` points and shapes."""
        if self._folder is None:
            return None
        try:
            with np.load(self._path(self._folder, tile)) as file:
                found, columns = file["points"], {name: file[name] for name in like}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None
        sound = np.array_equal(found, points) and all(
            (column.dtype, column.shape) == (like[name].dtype, (len(points), *like[name].shape[1:]))
            for name, column in columns.items()
        )
        return columns if sound else None

    def write(self, tile: tuple[int, int], points: NDArray[np.integer], columns: Mapping[str, NDArray]) -> None:
        """Keep a tile; a full or read-only disk costs a warning."""
        if self._folder is None:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            # Another process may write the same tile: each writes its own file, and the last rename wins.
            with tempfile.NamedTemporaryFile(dir=self._folder, suffix=".part", delete=False) as file:
                try:
                    arrays: dict[str, Any] = {"points": points, **columns}
                    np.savez(file, **arrays)
                    file.close()
                    os.replace(file.name, self._path(self._folder, tile))
                except BaseException:
                    os.unlink(file.name)
                    raise
        except OSError as error:
            warnings.warn(f"{self._folder}: tables are not kept: {error}", stacklevel=2)
            self._folder = None

    @staticmethod
    def _path(folder: Path, tile: tuple[int, int]) -> Path:
        return folder / f"tile_{tile[0]}_{tile[1]}.npz"
