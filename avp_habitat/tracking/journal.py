"""What a run still has to tell MLflow, kept on disk until MLflow has it.

A journal is a folder: `run.json` (which run, where), `journal.jsonl` (one entry per line), `sent` (how much of it
MLflow has), `files/` (artifacts), and `lock`, held by the process that writes. Every entry is one `write` to the
system, so a process that is killed loses none; losing the machine may lose the last ones. Entries that the disk does
not take wait in memory until it does.
"""

import fcntl
import json
import os
import shutil
import threading
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

from avp_habitat.files import atomic_file
from avp_habitat.tracking.names import OFFLINE
from avp_habitat.tracking.stores import TrackingError

SPOOL_VARIABLE = "AVP_MLFLOW_SPOOL"
VERSION = 1
_HEADER, _ENTRIES, _SENT, _LOCK = "run.json", "journal.jsonl", "sent", "lock"
_CHUNK, _COMPACT = 1 << 20, 4 << 20
# A POSIX lock goes when its process closes any descriptor of the file, so nobody here may open one of our own again.
_ours: set[Path] = set()


def spool_folder() -> Path:
    """Where journals lie: `AVP_MLFLOW_SPOOL`, else `runs/mlflow-spool` in the current folder."""
    return Path(os.environ.get(SPOOL_VARIABLE) or "runs/mlflow-spool").absolute()


def headers(spool: Path) -> dict[Path, dict[str, Any]]:
    """The headers of all journals of a folder, in use or left."""
    return {path: header for path in sorted(spool.glob("*")) if (header := Journal.peek(path)) is not None}


def journal_of(run_id: str) -> Path | None:
    """The folder of the journal of a run, in use or left; None when there is none."""
    found = headers(spool_folder()).items()
    return next((path for path, one in found if run_id in (one["run_id"], f"{OFFLINE}{one['key']}")), None)


class Journal:
    """The journal of one run; one thread may append while another one reads."""

    def __init__(self, folder: Path, header: Mapping[str, Any]) -> None:
        """Use `create` or `adopt`."""
        self.folder, self.header = folder, dict(header)
        self._lock = threading.Condition()
        self._waiting: deque[dict[str, Any]] = deque()
        self._descriptors: list[int] = []
        self._file = self._mark = -1
        self._size = self._sent = self._read_to = self._read_waiting = 0
        self.problem: str | None = None
        """Why the disk takes nothing; None while it does."""

    @classmethod
    def create(cls, header: Mapping[str, Any]) -> "Journal":
        """A new journal in the spool folder.

        Raises:
            TrackingError: the disk takes none.
        """
        journal = cls(spool_folder() / header["key"], header)
        try:
            journal.folder.mkdir(parents=True, mode=0o700)
            journal._open()
            journal._write_header()
        except OSError as error:
            journal.remove()
            problem = f"cannot be written: {error.strerror or error}; MLflow's points are kept there"
            raise TrackingError(f"{journal.folder}: {problem}, name another folder in {SPOOL_VARIABLE}") from None
        return journal

    @classmethod
    def peek(cls, folder: Path) -> dict[str, Any] | None:
        """The header of a folder's journal, in use or not; None when it is none that we can read."""
        try:
            header = json.loads((folder / _HEADER).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return header if isinstance(header, dict) and header.get("version") == VERSION else None

    @classmethod
    def adopt(cls, folder: Path) -> "Journal | None":
        """The journal that an earlier process left; None when it is in use, or is none that we can read."""
        folder = folder.absolute()
        if folder in _ours or cls.peek(folder) is None:
            return None
        journal = cls(folder, {})
        with suppress(OSError):
            journal._open()
            # Its process may have finished it, and removed it, until we had the lock.
            if (header := cls.peek(folder)) is not None:
                journal.header = header
                return journal
        journal.release()
        return None

    def update(self, changes: Mapping[str, Any]) -> None:
        """Change the header; a disk that does not take it has the earlier one, with which nothing is lost either."""
        with self._lock, suppress(OSError):
            self.header |= changes
            self._write_header()

    def last_written_ms(self) -> int:
        """When the last entry was written, milliseconds since 1970."""
        return int(os.fstat(self._file).st_mtime * 1000)

    def append(self, entry: Mapping[str, Any]) -> None:
        """Add an entry; one that the disk does not take waits in memory, before all later ones."""
        with self._lock:
            self._waiting.append(dict(entry))
            # Those that were waiting before may be on their way to MLflow; only `read` may move them.
            if len(self._waiting) == 1:
                self._write_waiting()
            self._lock.notify_all()

    def read(self) -> list[dict[str, Any]]:
        """The oldest entries that were not acknowledged; empty when there are none."""
        with self._lock:
            self._write_waiting()
            if self._sent == self._size:
                self._read_to, self._read_waiting = self._sent, len(self._waiting)
                return list(self._waiting)
            with (self.folder / _ENTRIES).open("rb") as file:
                file.seek(self._sent)
                data = b"".join(file.readlines(_CHUNK))[: self._size - self._sent]
            self._read_to, self._read_waiting = self._sent + len(data), 0
            entries = []
            for line in data.splitlines():
                with suppress(ValueError):  # Losing the machine may leave a damaged one.
                    entries.append(json.loads(line))
            return entries

    def acknowledge(self) -> None:
        """Note that MLflow has what `read` gave last."""
        with self._lock:
            for _ in range(self._read_waiting):
                self._waiting.popleft()
            self._sent, self._read_waiting = self._read_to, 0
            if self._sent == self._size > _COMPACT:
                os.ftruncate(self._file, 0)
                self._sent = self._read_to = self._size = 0
            self._mark_sent()
            self._lock.notify_all()

    @property
    def pending(self) -> bool:
        """Whether something was not acknowledged."""
        return self._sent < self._size or bool(self._waiting)

    def wait(self, timeout_s: float, *, pending: bool) -> bool:
        """Wait until there are entries, or until there are none; whether that came true in time."""
        with self._lock:
            return self._lock.wait_for(lambda: self.pending == pending, timeout_s)

    def new_file(self, name: str) -> Path:
        """Where to write a file that an entry will name; an `OSError` where the disk does not take it."""
        home = self.folder / "files" / uuid4().hex
        home.mkdir(parents=True)
        return home / name

    def remove(self) -> None:
        """Remove the journal, of which MLflow has everything."""
        # First of all, so that nobody adopts it as soon as the lock is free.
        with suppress(OSError):
            (self.folder / _HEADER).unlink()
        self.release()
        shutil.rmtree(self.folder, ignore_errors=True)
        with suppress(OSError):
            self.folder.parent.rmdir()  # when it was the last one

    def release(self) -> None:
        """Leave the journal to the next process."""
        while self._descriptors:
            os.close(self._descriptors.pop())
        _ours.discard(self.folder)

    def _open(self) -> None:
        fcntl.lockf(self._descriptor(_LOCK), fcntl.LOCK_EX | fcntl.LOCK_NB)
        _ours.add(self.folder)
        self._file, self._mark = self._descriptor(_ENTRIES), self._descriptor(_SENT)
        # An incomplete last line, which only losing the machine leaves, is overwritten.
        self._size = (self.folder / _ENTRIES).read_bytes().rfind(b"\n") + 1
        sent = os.pread(self._mark, 32, 0).strip()
        self._sent = int(sent) if sent.isdigit() and int(sent) <= self._size else 0
        self._mark_sent()

    def _descriptor(self, name: str) -> int:
        self._descriptors.append(os.open(self.folder / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
        return self._descriptors[-1]

    def _write_header(self) -> None:
        with atomic_file(self.folder / _HEADER) as partial:
            partial.write_text(json.dumps(self.header, indent=1) + "\n", encoding="utf-8")

    def _write_waiting(self) -> None:
        while self._waiting:
            line = json.dumps(self._waiting[0], separators=(",", ":")).encode() + b"\n"
            try:
                if os.pwrite(self._file, line, self._size) < len(line):
                    raise OSError(None, "the disk is full")
            except OSError as error:
                self.problem = f"{self.folder}: {error.strerror or error}"
                return
            self.problem = None
            self._size += len(line)
            self._waiting.popleft()

    def _mark_sent(self) -> None:
        # Always the same bytes in place, which needs no space on a full disk.
        with suppress(OSError):
            os.pwrite(self._mark, f"{self._sent:020d}\n".encode(), 0)
