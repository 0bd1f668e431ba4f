"""Reading and writing the PNG files of a rollout."""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray
from PIL import Image

from avp_habitat.errors import RolloutError
from avp_habitat.rollout.png import GREY_16, LAST_CHUNK, RGB_8, SIGNATURE, PngKind

DEPTH_UNIT_M = 0.001
_MAX_STORED_DEPTH = np.iinfo(np.uint16).max

_FILTER_UP = 2
_LEVEL = 1


def encode_png(pixels: NDArray[np.unsignedinteger], kind: PngKind) -> bytes:
    """A picture as a PNG file, in a tenth of the time that Pillow takes, with Python's interpreter free meanwhile.

    Every row is stored as its difference to the row above (filter "up"), so that nothing is tried out. ISA-L's deflate
    takes a quarter of the time of zlib's fastest setting on rendered pictures, for smaller files; its higher levels
    gain little.

    Args:
        pixels: `(height, width)` or `(height, width, channels)`, as `kind` says.
        kind: of the file.
    """
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels, f">u{kind.bits // 8}").view(np.uint8).reshape(height, -1)
    lines = np.empty((height, 1 + rows.shape[1]), np.uint8)
    lines[:, 0] = _FILTER_UP
    lines[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=lines[1:, 1:])
    header = struct.pack(">IIBBBBB", width, height, kind.bits, kind.colour_type, 0, 0, 0)
    data = isal_zlib.compress(lines.data, _LEVEL)
    return b"".join((SIGNATURE, _chunk(b"IHDR", header), _chunk(b"IDAT", data), LAST_CHUNK))


def _chunk(name: bytes, data: bytes) -> bytes:
    return b"".join((struct.pack(">I", len(data)), name, data, struct.pack(">I", zlib.crc32(data, zlib.crc32(name)))))


def encode_depth(depth: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Planar depth in metres, any shape, to whole millimetres; 0 is "nothing", and so is what is beyond 65.535 m."""
    millimetres = np.rint(depth / DEPTH_UNIT_M)
    return np.where(millimetres <= _MAX_STORED_DEPTH, millimetres, 0).astype(np.uint16)


def write_rgb(path: Path, rgb: NDArray[np.uint8]) -> None:
    """Write `(height, width, 3)` uint8 as PNG."""
    path.write_bytes(encode_png(rgb, RGB_8))


def write_depth(path: Path, depth: NDArray[np.floating]) -> None:
    """Write `(height, width)` planar depth in metres as 16-bit PNG in millimetres."""
    path.write_bytes(encode_png(encode_depth(depth), GREY_16))


def write_numbers(path: Path, numbers: NDArray[np.uint16]) -> None:
    """Write `(height, width)` whole numbers as 16-bit grey PNG."""
    path.write_bytes(encode_png(numbers, GREY_16))


def read_numbers(path: Path) -> NDArray[np.uint16]:
    """Read a 16-bit grey PNG as `(height, width)` whole numbers.

    Raises:
        RolloutError: the picture cannot be decoded; likewise in the other functions that read.
    """
    return _decoded(path).astype(np.uint16)


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Read a PNG as `(height, width, 3)` uint8."""
    return _decoded(path, "RGB")


def read_depth(path: Path) -> NDArray[np.float32]:
    """Read a depth PNG as `(height, width)` float32 metres, 0.0 where there is none."""
    return _decoded(path).astype(np.float32) * np.float32(DEPTH_UNIT_M)


def _decoded(path: Path, mode: str | None = None) -> NDArray[Any]:
    try:
        with Image.open(path, formats=["PNG"]) as image:
            return np.asarray(image if mode is None else image.convert(mode))
    except Exception as error:  # Pillow raises a dozen kinds for damaged files
        reason = str(error) or type(error).__name__
        raise RolloutError(f"{path}: expected a readable PNG, could not decode it: {reason}") from None
