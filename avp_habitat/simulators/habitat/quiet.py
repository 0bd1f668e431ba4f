"""Leaves lines out of what libraries write to stderr."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_TIME_LIMIT_S = 1.0
# A process of its own: what Habitat-Sim says last has to be seen when it ends this one.
_FILTER = """
import signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
words = [word.encode() for word in sys.argv[1:]]
for line in sys.stdin.buffer:
    if not any(word in line for word in words):
        sys.stdout.buffer.write(line)
        sys.stdout.buffer.flush()
"""


@contextmanager
def quiet_stderr(*words: str) -> Iterator[None]:
    """Within the block, lines that hold one of these words are left out of stderr, also those that C++ writes."""
    sys.stderr.flush()
    kept = os.dup(2)
    line = [sys.executable, "-I", "-S", "-c", _FILTER, *words]
    try:
        passing = subprocess.Popen(line, stdin=subprocess.PIPE, stdout=kept)
    except OSError:  # Then there are some lines more.
        os.close(kept)
        yield
        return
    assert passing.stdin is not None
    os.dup2(passing.stdin.fileno(), 2)
    passing.stdin.close()
    try:
        yield
    finally:
        sys.stderr.flush()
        os.dup2(kept, 2)
        os.close(kept)
        # A program that another thread has started meanwhile writes there too, and may go on for long.
        with suppress(subprocess.TimeoutExpired):
            passing.wait(_TIME_LIMIT_S)
