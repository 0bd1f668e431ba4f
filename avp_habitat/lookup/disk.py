"""Finished tiles of tables on disk, so that a scene's rays are cast once and not once per training."""

import hashlib
import io
import os
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ENVIRONMENT = "AVP_CACHE"
"""Environment variable that names the folder of the cache; empty keeps nothing on disk."""

_DIGEST_BYTES = 32


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
    """The files of one scene's tables: an unsound one is made anew, one that cannot be written costs a warning.

    Each is an `.npz` with the SHA-256 behind it of what it should be (scene, tile, points, columns) and what it holds.
    """

    def __init__(self, name: str) -> None:
        """Use the folder `name` of the cache."""
        self._name = name
        folder = cache_folder()
        self._folder = None if folder is None else folder / "tables" / name

    def read(
        self, tile: tuple[int, int], points: NDArray[np.integer], like: Mapping[str, NDArray]
    ) -> dict[str, NDArray] | None:
        """A tile's tables by name, or None where there is no sound file for these `(k, 2)` points and columns."""
        if self._folder is None:
            return None
        try:
            data = self._path(self._folder, tile).read_bytes()
        except OSError:
            return None
        content, digest = data[:-_DIGEST_BYTES], data[-_DIGEST_BYTES:]
        if digest != self._digest(tile, points, like, content):
            return None
        with np.load(io.BytesIO(content)) as file:
            return {name: file[name] for name in like}

    def write(self, tile: tuple[int, int], points: NDArray[np.integer], columns: Mapping[str, NDArray]) -> None:
        """Keep a tile; a full or read-only disk costs a warning."""
        if self._folder is None:
            return
        buffer = io.BytesIO()
        arrays: dict[str, Any] = dict(columns)
        np.savez(buffer, **arrays)
        content = buffer.getvalue()
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            # Another process may write the same tile: each writes its own file, and the last rename wins.
            with tempfile.NamedTemporaryFile(dir=self._folder, suffix=".part", delete=False) as file:
                try:
                    file.write(content + self._digest(tile, points, columns, content))
                    file.close()
                    os.replace(file.name, self._path(self._folder, tile))
                except BaseException:
                    os.unlink(file.name)
                    raise
        except OSError as error:
            warnings.warn(f"{self._folder}: tables are not kept: {error}", stacklevel=2)
            self._folder = None

    def _digest(
        self, tile: tuple[int, int], points: NDArray[np.integer], columns: Mapping[str, NDArray], content: bytes
    ) -> bytes:
        layout = [(name, column.dtype.str, column.shape[1:]) for name, column in columns.items()]
        return hashlib.sha256(f"{self._name} {tile} {layout}".encode() + points.tobytes() + content).digest()

    @staticmethod
    def _path(folder: Path, tile: tuple[int, int]) -> Path:
        return folder / f"tile_{tile[0]}_{tile[1]}.npz"
