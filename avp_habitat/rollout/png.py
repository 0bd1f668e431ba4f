"""PNG files: what they begin and end with, and checking them without decoding."""

import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

from avp_habitat.errors import RolloutError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_FIRST_CHUNK = b"\x00\x00\x00\x0dIHDR"
# The last chunk is empty, so its length, type and checksum are always these bytes.
LAST_CHUNK = b"\x00\x00\x00\x00IEND\xaeB`\x82"
_HEADER_BYTES = 33
_FRAME_BYTES = 12


@dataclass(frozen=True)
class PngKind:
    """What a PNG stores in a pixel."""

    bits: int
    """Per channel."""
    colour_type: int
    """PNG's number for it: 0 grey, 2 RGB."""
    wanted: str
    """In the words of an error: expected …"""


RGB_8 = PngKind(8, 2, "an 8-bit RGB PNG")
GREY_16 = PngKind(16, 0, "a 16-bit grey PNG")


def check_png_structure(path: str, *, width: int, height: int, kind: PngKind) -> None:
    """Hold a file to being a PNG of a size and kind that has a beginning and an end; some ten microseconds.

    Two short reads find a file that is empty, cut short or something else. What lies between is not read: that is
    `check_png_contents`.

    Args:
        path: of the file.
        width: expected, in pixels.
        height: expected, in pixels.
        kind: expected.

    Raises:
        RolloutError: the file is unreadable, no whole PNG, or of another size or kind.
    """
    try:
        header, end = _ends(path)
    except OSError as error:
        raise RolloutError(f"{path}: expected {kind.wanted}, could not read it: {error.strerror}") from None
    if not header.startswith(SIGNATURE + _FIRST_CHUNK) or len(header) < _HEADER_BYTES:
        raise RolloutError(f"{path}: expected {kind.wanted}, found {'something else' if header else 'an empty file'}")
    found_width, found_height, bits, colour = struct.unpack(">IIBB", header[16:26])
    if (found_width, found_height) != (width, height):
        raise RolloutError(
            f"{path}: expected {width}x{height} pixels (rollout.json), found {found_width}x{found_height}"
        )
    if (bits, colour) != (kind.bits, kind.colour_type):
        raise RolloutError(f"{path}: expected {kind.wanted}, found {bits} bits with PNG colour type {colour}")
    if end != LAST_CHUNK:
        raise RolloutError(f"{path}: expected {kind.wanted}, found one without an end: was it cut short?")


def check_png_contents(path: Path) -> None:
    """Hold every chunk of a PNG to its checksum (CRC-32), which finds any damaged byte; about a gigabyte a second.

    Nothing is decoded. The format: https://www.w3.org/TR/png-3/#5Chunk-layout

    Args:
        path: of a file that passed `check_png_structure`.

    Raises:
        RolloutError: the file is unreadable or damaged.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RolloutError(f"{path}: expected a readable PNG, could not read it: {error.strerror}") from None
    view, start = memoryview(content), len(SIGNATURE)
    while start < len(content):
        end = start + _FRAME_BYTES + int.from_bytes(view[start : start + 4], "big")
        if end > len(content):
            raise RolloutError(f"{path}: expected a whole PNG, its part at byte {start} is longer than the file")
        if zlib.crc32(view[start + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            name = bytes(view[start + 4 : start + 8]).decode("ascii", "replace")
            raise RolloutError(
                f"{path}: expected an undamaged PNG, its part {name} at byte {start} does not match its checksum"
            )
        start = end


def _ends(path: str) -> tuple[bytes, bytes]:
    """The first 33 bytes of a file, and its last 12."""
    # Half the time that a Python file object takes, which counts among ten thousand files.
    file = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
    try:
        header = os.read(file, _HEADER_BYTES)
        os.lseek(file, max(0, os.fstat(file).st_size - len(LAST_CHUNK)), os.SEEK_SET)
        return header, os.read(file, len(LAST_CHUNK))
    finally:
        os.close(file)
