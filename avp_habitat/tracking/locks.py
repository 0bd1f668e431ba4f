"""Work that only one program of this machine may do at a time."""

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def alone(name: str) -> Iterator[None]:
    """Wait until no other program of this user is within a block of the same name."""
    with (Path(tempfile.gettempdir()) / f"avp-{os.getuid()}-{name}.lock").open("w") as file:
        with suppress(OSError):  # A file system without locks.
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
