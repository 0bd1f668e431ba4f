"""The files that a scene consists of: confined to its folder and remembered for its digest."""

import errno
import hashlib
import io
import os
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SceneError

SUFFIXES = (".glb", ".gltf", ".ply", ".obj")
"""Of the meshes that can be read."""


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
        self.main = self._read(path)
        if not self.main:
            raise SceneError(f"{path}: the file is empty")

    def read(self, uri: str) -> bytes:
        """Content of a referenced file.

        Args:
            uri: relative path, percent-encoded or not.

        Raises:
            SceneError: the file is missing or lies outside the scene's folder.
        """
        name = unquote(uri).replace("\\", "/")
        target = Path(os.path.normpath(self._folder / name))
        if not target.is_relative_to(self._folder):
            raise SceneError(f"{self.path}: refers to {uri!r}, which lies outside the folder of the scene")
        if name not in self._referenced:
            self._referenced[name] = self._read(target)
        return self._referenced[name]

    def digest(self) -> str:
        """Hexadecimal SHA-256 of the scene's file followed by the files read so far, in order of their names."""
        content = hashlib.sha256(self.main)
        for name in sorted(self._referenced):
            content.update(self._referenced[name])
        return content.hexdigest()

    def _read(self, path: Path) -> bytes:
        owner = "" if path == self.path else f" (referred to by {self.path.name})"
        try:
            # A link may lead to what never ends, too.
            if path.exists() and not path.is_file():
                raise SceneError(f"{path}{owner}: expected a file, found something else (a folder, a device, …)")
            return path.read_bytes()
        except ValueError as error:
            raise SceneError(f"{self.path}: refers to {path.name!r}, which is no name of a file: {error}") from None
        except OSError as error:
            reason = f"cannot be read: {error.strerror}"
            if error.errno != errno.ENAMETOOLONG:
                reason = broken_link(path) or reason
            raise SceneError(f"{path}{owner}: {reason}") from error


def check_memory(name: str, needed: int) -> None:
    """Refuse, by a SceneError that begins with `name`, what needs more bytes than are free, before they are taken."""
    try:
        free = 1024 * int(Path("/proc/meminfo").read_text().partition("MemAvailable:")[2].split()[0])
    except (OSError, LookupError):
        free = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if needed > free:
        raise SceneError(f"{name} takes {needed / 1e9:.1f} GB of memory, of which {free / 1e9:.1f} GB are free")


def broken_link(path: Path) -> str | None:
    """What is wrong with a link that leads nowhere, as where a store's content was not fetched; None for others."""
    if not path.is_symlink() or path.exists():
        return None
    return f"is a link to {os.readlink(path)}, where there is no file; fetch it (dvc pull, git annex get, say)"


def decode_picture(content: bytes, name: str, mode: str = "RGB") -> NDArray[np.uint8]:
    """Pixels, `(height, width, 3)` uint8 as stored (sRGB), of an encoded picture; with alpha as a fourth for RGBA.

    Args:
        content: an encoded PNG, JPEG or other format that Pillow reads.
        name: what to call the picture in an error.
        mode: `RGB` or `RGBA`; greys of 16 bits, which have no alpha, have three values in both.

    Raises:
        SceneError: the bytes are no picture.
    """
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content)) as image:
            width, height = image.size
            check_memory(f"{name}: its picture of {width} x {height} pixels", 8 * width * height)
            if image.mode.startswith("I"):
                # Pillow clips 16-bit greys to 255 when it converts them, instead of scaling them.
                grey = (np.asarray(image).astype(np.uint32) >> 8).astype(np.uint8)
                return np.repeat(grey[..., None], 3, axis=2)
            return np.ascontiguousarray(image.convert(mode))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise SceneError(f"{name}: the picture cannot be decoded: {error}") from error
