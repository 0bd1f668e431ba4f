"""Reading and writing the PNG files of a rollout."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from avp_habitat.errors import RolloutError
from avp_habitat.png import GREY_16, RGB_8, encode_png

DEPTH_UNIT_M = 0.001
_MAX_STORED_DEPTH = np.iinfo(np.uint16).max


def encode_depth(depth: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Planar depth in metres, any shape, to whole millimetres; 0 stays "nothing", 65.535 m is the greatest."""
    return np.clip(np.rint(depth / DEPTH_UNIT_M), 0, _MAX_STORED_DEPTH).astype(np.uint16)


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
