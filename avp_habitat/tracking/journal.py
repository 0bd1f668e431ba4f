"""What a run still has to tell MLflow, kept on disk until MLflow has it.

A journal is a folder: `run.json` (which run, where), `journal.jsonl` (one entry per line), `sent` (how much of it
MLflow has), `files/` (artifacts), `rejected.jsonl` (what MLflow refuses), and `lock`, held by the process that
writes. Every entry is one `write` to the system, so a process that is killed loses none; losing the machine may lose
the last ones. Where the disk takes nothing, entries wait in memory instead.
"""

import fcntl
import json
import os
import shutil
import tempfile
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4


@contextmanager
def alone(name: str) -> Iterator[None]:
    """Wait until no other program of this user is within a block of the same name."""
    with (Path(tempfile.gettempdir()) / f"avp-{os.getuid()}-{name}.lock").open("w") as file:
        with suppress(OSError):  # A file system without locks.
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


Entry = Mapping[str, Any]

DEFAULT_SPOOL = Path("runs") / "mlflow-spool"
SPOOL_VARIABLE = "AVP_MLFLOW_SPOOL"
VERSION = 1
_HEADER, _ENTRIES, _SENT, _LOCK, _REJECTED, _FILES = (
    "run.json",
    "journal.jsonl",
    "sent",
    "lock",
    "rejected.jsonl",
    "files",
)
_KEYS = {"key", "address", "run_id", "owned", "ended", "started_ms"}
_CHUNK = 1 << 20
_COMPACT = 4 << 20
# A POSIX lock goes when its process closes any descriptor of the file, so nobody here may open one of our own again.
_ours: set[Path] = set()


def spool_folder() -> Path:
    """Where journals lie: `AVP_MLFLOW_SPOOL`, else `runs/mlflow-spool` in the current folder."""
    return Path(os.environ.get(SPOOL_VARIABLE) or DEFAULT_SPOOL).absolute()


@dataclass(frozen=True)
class Batch:
    """Entries that MLflow does not have yet."""

    entries: list[dict[str, Any]]
    """The oldest first."""
    end: int | None
    """Where they end in the file, bytes; None for entries that wait in memory."""


class Journal:
    """The journal of one run; one thread may append while another one reads."""

    def __init__(self, folder: Path | None, header: dict[str, Any]) -> None:
        """Use `create` or `adopt`."""
        self.folder = folder
        self.header = header
        self._lock = threading.Condition()
        self._waiting: deque[dict[str, Any]] = deque()
        self._held: list[int] = []
        self._file = self._mark = -1
        self._size = self._sent = 0
        self._temporary: tempfile.TemporaryDirectory[str] | None = None
        self.problem: str | None = None
        """Why the disk takes nothing; None while it does."""

    @classmethod
    def create(cls, spool: Path, header: Mapping[str, Any]) -> "Journal":
        """A new journal; in memory, with `problem` set, when the disk takes none."""
        key = str(header["key"])
        folder = spool / key
        journal = cls(folder, dict(header))
        try:
            folder.mkdir(parents=True, mode=0o700)
            journal._open()
            journal.save_header()
        except OSError as error:
            journal._close_files()
            shutil.rmtree(folder, ignore_errors=True)
            journal.folder, journal.problem = None, f"{folder}: {error.strerror or error}"
        return journal

    @classmethod
    def peek(cls, folder: Path) -> dict[str, Any] | None:
        """Which run a folder is the journal of, in use or not; None when it is none that we can read."""
        try:
            header = json.loads((folder / _HEADER).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        whole = isinstance(header, dict) and header.get("version") == VERSION and header.keys() >= _KEYS
        return header if whole else None

    @classmethod
    def adopt(cls, folder: Path) -> "Journal | None":
        """The journal that an earlier process left; None when it is in use, or is none that we can read."""
        folder = folder.absolute()
        if folder in _ours or cls.peek(folder) is None:
            return None
        journal = cls(folder, {})
        try:
            journal._open()
        except OSError:
            return None
        # Its process may have finished it, and removed it, until we had the lock.
        header = cls.peek(folder)
        if header is None:
            journal.release()
            return None
        journal.header = header
        return journal

    @classmethod
    def in_use(cls, folder: Path) -> bool:
        """Whether a living process holds a journal."""
        journal = cls.adopt(folder)
        if journal is not None:
            journal.release()
        return journal is None

    def last_written_ms(self) -> int:
        """When the last entry was written, milliseconds since 1970."""
        return int(os.fstat(self._file).st_mtime * 1000)

    def save_header(self) -> None:
        """Write `header` down.

        Raises:
            OSError: the disk does not take it.
        """
        if self.folder is None:
            return
        path = self.folder / _HEADER
        temporary = path.with_suffix(".new")
        temporary.write_text(json.dumps(self.header, indent=1) + "\n", encoding="utf-8")
        temporary.rename(path)

    def append(self, entry: Entry) -> None:
        """Add an entry; one that the disk does not take waits in memory, before all later ones."""
        with self._lock:
            self._waiting.append(dict(entry))
            # Those that were waiting before may be on their way to MLflow; only `read` may move them.
            if len(self._waiting) == 1:
                self._write_waiting()
            self._lock.notify_all()

    def read(self) -> Batch | None:
        """The oldest entries that were not acknowledged; None when there are none."""
        with self._lock:
            self._write_waiting()
            if self._sent < self._size:
                data = os.pread(self._file, min(_CHUNK, self._size - self._sent), self._sent)
                # A line longer than a chunk is read whole.
                while b"\n" not in data:
                    data += os.pread(self._file, _CHUNK, self._sent + len(data))
                data = data[: data.rindex(b"\n") + 1]
                return Batch([_parsed(line) for line in data.splitlines()], self._sent + len(data))
            return Batch(list(self._waiting), None) if self._waiting else None

    def acknowledge(self, batch: Batch) -> None:
        """Note that MLflow has these."""
        with self._lock:
            if batch.end is None:
                for _ in batch.entries:
                    self._waiting.popleft()
            else:
                self._sent = batch.end
                if self._sent == self._size and self._size > _COMPACT:
                    os.ftruncate(self._file, 0)
                    self._sent = self._size = 0
                self._mark_sent()
            self._lock.notify_all()

    def wait(self, timeout_s: float, *, for_entries: bool) -> bool:
        """Wait until there are entries, or until there are none; whether that came true in time."""
        with self._lock:
            return self._lock.wait_for(lambda: bool(self) == for_entries, timeout_s)

    def reject(self, entry: Entry, reason: str) -> None:
        """Keep an entry that MLflow refuses, with its reason, beside the others."""
        if self.folder is None:
            return
        with suppress(OSError), (self.folder / _REJECTED).open("a", encoding="utf-8") as file:
            file.write(json.dumps({**entry, "reason": reason}) + "\n")

    def restore_rejected(self) -> None:
        """Put refused entries back, to be tried again."""
        if self.folder is None or not self.has_rejected:
            return
        path = self.folder / _REJECTED
        for line in path.read_bytes().splitlines():
            self.append({key: value for key, value in _parsed(line).items() if key != "reason"})
        path.unlink()

    @property
    def has_rejected(self) -> bool:
        """Whether MLflow refused something."""
        return self.folder is not None and (self.folder / _REJECTED).is_file()

    @contextmanager
    def new_file(self, name: str) -> Iterator[Path]:
        """Where to write a file that an entry will name; it is removed again when writing fails.

        Raises:
            OSError: the disk does not take it.
        """
        if self.folder is None and self._temporary is None:
            self._temporary = tempfile.TemporaryDirectory(prefix="avp-mlflow-")
        home = (self.folder or Path(self._temporary.name)) / _FILES / uuid4().hex  # type: ignore[union-attr]
        home.mkdir(parents=True)
        try:
            yield home / name
        except BaseException:
            shutil.rmtree(home, ignore_errors=True)
            raise

    def remove(self) -> None:
        """Remove the journal, of which MLflow has everything."""
        if self.folder is not None:
            # First of all, so that nobody adopts it as soon as the lock is free.
            with suppress(OSError):
                (self.folder / _HEADER).unlink()
        self.release()
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)
            with suppress(OSError):
                self.folder.parent.rmdir()  # when it was the last one

    def release(self) -> None:
        """Leave the journal to the next process."""
        self._close_files()
        if self._temporary is not None:
            self._temporary.cleanup()
            self._temporary = None

    def __bool__(self) -> bool:
        """Whether something was not acknowledged."""
        return self._sent < self._size or bool(self._waiting)

    def _open(self) -> None:
        assert self.folder is not None
        lock = os.open(self.folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            raise
        _ours.add(self.folder)
        self._held.append(lock)
        self._file = os.open(self.folder / _ENTRIES, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self._mark = os.open(self.folder / _SENT, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self._held += [self._file, self._mark]
        self._size = _whole_lines(self._file)
        sent = os.pread(self._mark, 32, 0).strip()
        self._sent = int(sent) if sent.isdigit() and int(sent) <= self._size else 0
        self._mark_sent()

    def _write_waiting(self) -> None:
        while self._waiting and self.folder is not None:
            line = json.dumps(self._waiting[0], separators=(",", ":")).encode() + b"\n"
            try:
                written = os.pwrite(self._file, line, self._size)
                if written < len(line):
                    raise OSError(None, "the disk is full")
            except OSError as error:
                with suppress(OSError):
                    os.ftruncate(self._file, self._size)
                self.problem = f"{self.folder}: {error.strerror or error}"
                return
            self.problem = None
            self._size += len(line)
            self._waiting.popleft()

    def _mark_sent(self) -> None:
        # Always the same bytes in place, which needs no space on a full disk.
        with suppress(OSError):
            os.pwrite(self._mark, f"{self._sent:020d}\n".encode(), 0)

    def _close_files(self) -> None:
        for descriptor in reversed(self._held):
            os.close(descriptor)
        self._held.clear()
        self._file = self._mark = -1
        if self.folder is not None:
            _ours.discard(self.folder)


def _whole_lines(file: int) -> int:
    """The file's size after an incomplete last line, which only losing the machine leaves, is cut off."""
    size = os.fstat(file).st_size
    end = size
    while end > 0:
        start = max(0, end - _CHUNK)
        found = os.pread(file, end - start, start).rfind(b"\n")
        if found >= 0:
            end = start + found + 1
            break
        end = start
    if end != size:
        os.ftruncate(file, end)
    return end


def _parsed(line: bytes) -> dict[str, Any]:
    """An entry; `damaged` holds a line that is none."""
    try:
        entry = json.loads(line)
    except ValueError:
        entry = None
    return entry if isinstance(entry, dict) else {"damaged": line.decode(errors="replace")}
