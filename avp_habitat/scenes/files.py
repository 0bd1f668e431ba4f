"""The files that a scene consists of: confined to its folder and remembered for its digest."""

import hashlib
import io
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SceneError

SUFFIXES = (".glb", ".gltf", ".ply", ".obj")
"""Of the meshes that can be read."""
# What walking through a file's content raises where a part is missing, of another type or out of range.
_MALFORMED = (ArithmeticError, AttributeError, LookupError, MemoryError, OSError, RecursionError, TypeError)
_MALFORMED += (ValueError, struct.error)


class SceneFiles:
    """Reads a scene's file and the files it refers to, none of which may lie outside the scene's folder.

    What counts is the path as it is written: links may lead anywhere, as they do in the stores of Hugging Face, DVC and
    git-annex.
    """

    def __init__(self, path: Path) -> None:
        """Read the scene's own file; SceneError where it cannot be read, or has no byte."""
        self.path = path
        self._folder = Path(os.path.abspath(path.parent))
        self._referenced: dict[str, bytes] = {}
        self.main = _read(path)
        if not self.main:
            raise SceneError(f"{path}: the file is empty")

    def read(self, uri: str) -> bytes:
        """Content of the file at a relative path, percent-encoded or not; SceneError where it is missing or outside."""
        name = unquote(uri).replace("\\", "/")
        target = Path(os.path.normpath(self._folder / name))
        if not target.is_relative_to(self._folder):
            raise SceneError(f"{self.path}: refers to {uri!r}, which lies outside the folder of the scene")
        if name not in self._referenced:
            self._referenced[name] = _read(target, f" (referred to by {self.path.name})")
        return self._referenced[name]

    def digest(self) -> str:
        """Hexadecimal SHA-256 of the scene's file followed by the files read so far, in order of their names."""
        content = hashlib.sha256(self.main)
        for name in sorted(self._referenced):
            content.update(self._referenced[name])
        return content.hexdigest()

    @contextmanager
    def expected(self, what: str) -> Iterator[None]:
        """Name the file, and what it should be, in a SceneError for whatever damaged content raises."""
        try:
            yield
        except _MALFORMED as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise SceneError(f"{self.path}: expected {what}, but it is damaged: {reason}") from error


def _read(path: Path, owner: str = "") -> bytes:
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:
        reason = broken_link(path) or f"cannot be read: {getattr(error, 'strerror', error)}"
        raise SceneError(f"{path}{owner}: {reason}") from error


def broken_link(path: Path) -> str | None:
    """What is wrong with a link that leads nowhere, as where a store's content was not fetched; None for others."""
    if not os.path.islink(path) or path.exists():
        return None
    return f"is a link to {os.readlink(path)}, where there is no file; fetch it (dvc pull, git annex get, say)"


def decode_picture(content: bytes, name: str, mode: str = "RGB") -> NDArray[np.uint8]:
    """Pixels, `(height, width, 3)` uint8 as stored (sRGB), of a PNG, JPEG or other picture that Pillow reads.

    With the mode `RGBA` alpha is a fourth value, except of greys of 16 bits, which have none. SceneError, which begins
    with `name`, where the bytes are no picture.
    """
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content)) as image:
            if image.mode.startswith("I"):
                # Pillow clips 16-bit greys to 255 when it converts them, instead of scaling them.
                grey = (np.asarray(image).astype(np.uint32) >> 8).astype(np.uint8)
                return np.repeat(grey[..., None], 3, axis=2)
            return np.ascontiguousarray(image.convert(mode))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise SceneError(f"{name}: the picture cannot be decoded: {error}") from error
