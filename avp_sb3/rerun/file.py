"""A Rerun recording in a file that always ends with a whole message, whatever happens to the disk or the process."""

import fcntl
import os
import struct
import termios
import threading
import time
from contextlib import suppress
from pathlib import Path
from uuid import uuid4

import rerun as rr
import rerun.blueprint as rrb

from avp_habitat.errors import AVPError, UsageError
from avp_sb3.rerun.layout import APPLICATION

_FILE_HEADER, _MESSAGE_HEADER, _END_OF_MESSAGES = 12, struct.Struct("<QQ"), 0
_PIPE_BYTES, _FLUSH_S = 1 << 20, 5.0
_CONTENTS_BYTES = 160


class RecordingError(AVPError):
    """A recording that cannot be written."""


class RecordingFile:
    """Writes a recording through a pipe, message by message.

    Rerun's own file sink waits for ever when the process ends after a failed write (a full disk), and a file that ends
    within a message cannot be read at all. Here a failed write ends the file before the broken message, is kept in
    `fault`, and what is logged afterwards is dropped.
    """

    def __init__(self, path: Path, blueprint: rrb.Blueprint) -> None:
        """Make the file.

        Args:
            path: must not exist yet; its folder must.
            blueprint: how a viewer lays the recording out.

        Raises:
            OSError: the file exists or cannot be made.
        """
        self.path = path
        self._written = self._messages = 0
        self.fault: OSError | None = None
        # Rerun's default is one id per process, under which a viewer would merge the recordings of two trainings.
        self.recording_id = str(uuid4())
        self._file = path.open("xb", buffering=0)
        self._pending = bytearray()
        self._reading, writing = os.pipe()
        self._thread = threading.Thread(target=self._pump, name="rerun file", daemon=True)
        self._thread.start()
        self.recording = rr.RecordingStream(APPLICATION, recording_id=self.recording_id)
        self.recording.save(f"/dev/fd/{writing}", default_blueprint=blueprint)
        os.close(writing)

    @property
    def size(self) -> int:
        """About what the file would have if it were finished now, with its table of contents, bytes."""
        return self._written + _CONTENTS_BYTES * self._messages

    def flush(self) -> None:
        """Let what was logged reach the file; a disk that takes longer than a few seconds is not waited for."""
        until = time.monotonic() + _FLUSH_S
        with suppress(RuntimeError):
            self.recording.flush(timeout_sec=_FLUSH_S)
        while self._in_pipe() and time.monotonic() < until:
            time.sleep(0.001)

    def close(self) -> None:
        """Finish the file, after which there is no `recording`; a second call does nothing."""
        if self._file.closed:
            return
        self.recording.disconnect()
        # Rerun frees it now, not while the interpreter is being taken down and its threads can wait for ever.
        del self.recording
        self._thread.join()
        self._file.close()

    def _in_pipe(self) -> int:
        """Bytes that were sent and not yet taken."""
        (count,) = struct.unpack("i", fcntl.ioctl(self._reading, termios.FIONREAD, bytes(4)))
        return count

    def _pump(self) -> None:
        header = _FILE_HEADER
        with open(self._reading, "rb", buffering=0) as pipe:
            while part := pipe.read(_PIPE_BYTES):
                if self.fault is not None:
                    continue
                self._pending += part
                if header and len(self._pending) >= header:
                    self._write(header)
                    header = 0
                if not header:
                    count, length = _whole_messages(self._pending)
                    self._messages += count
                    self._write(length)
        self._write(len(self._pending))

    def _write(self, count: int) -> None:
        """Move the first bytes of what is pending to the file."""
        if self.fault is not None or not count:
            return
        try:
            rest = memoryview(bytes(self._pending[:count]))
            while rest:
                rest = rest[self._file.write(rest) :]
            self._written += count
        except OSError as error:
            self.fault = error
            os.ftruncate(self._file.fileno(), self._written)
        del self._pending[:count]


def new_recording_file(path: Path, blueprint: rrb.Blueprint) -> RecordingFile:
    """A recording in a file that did not exist, in a folder that is made if need be.

    Raises:
        UsageError: the file exists.
        RecordingError: it cannot be made.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() or path.is_symlink():
            raise UsageError(f"{path}: exists already; choose another name or remove it")
        return RecordingFile(path, blueprint)
    except OSError as error:
        raise RecordingError(f"{path}: cannot write the recording there: {error.strerror or error}") from None


def _whole_messages(data: bytearray) -> tuple[int, int]:
    """How many messages have arrived completely, and their bytes; the footer after the last one is left."""
    count = at = 0
    while at + _MESSAGE_HEADER.size <= len(data):
        kind, length = _MESSAGE_HEADER.unpack_from(data, at)
        after = at + _MESSAGE_HEADER.size + length
        if kind == _END_OF_MESSAGES or after > len(data):
            break
        count, at = count + 1, after
    return count, at
