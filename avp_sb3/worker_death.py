"""What became of a worker process, in words, and how worker processes are ended."""

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

from avp_habitat.errors import SimulatorError

GRACE_S = 5.0
"""How long a worker may take to end by itself, seconds."""
GONE = (EOFError, BrokenPipeError, ConnectionResetError)
"""What a pipe raises when the process at its other end has ended."""
_HINTS = {
    "SIGKILL": "by somebody, or by the system for want of memory",
    "SIGSEGV": "a crash inside the simulator",
    "SIGABRT": "a crash inside the simulator",
}


def how_it_ended(process: BaseProcess) -> str:
    """The end of a process whose pipe is broken, as a phrase: by which signal, or with which exit code."""
    process.join(GRACE_S)
    code = process.exitcode
    if code is None:
        return "does not answer any more"
    if code >= 0:
        return f"ended with exit code {code}; what it said last stands above"
    name = signal.Signals(-code).name if -code in signal.valid_signals() else f"signal {-code}"
    hint = _HINTS.get(name)
    return f"was killed by {name}{f' ({hint})' if hint else ''}"


def end_processes(processes: Sequence[BaseProcess], pipes: Sequence[Connection]) -> None:
    """Close the pipes, by which a worker learns that it is not needed, and end who has not ended after a while."""
    for pipe in pipes:
        pipe.close()
    _join(processes)
    for stop in ("terminate", "kill"):
        late = [process for process in processes if process.is_alive()]
        for process in late:
            getattr(process, stop)()
        _join(late)


def _join(processes: Sequence[BaseProcess]) -> None:
    until = time.monotonic() + GRACE_S
    for process in processes:
        process.join(max(0.0, until - time.monotonic()))


@contextmanager
def named_deaths(
    processes: Sequence[BaseProcess], name: Callable[[int], str], end: Callable[[], None], *, hint: str = ""
) -> Iterator[None]:
    """Within the block, a broken pipe becomes an error that names the worker; the others are ended, too.

    Args:
        processes: the workers.
        name: of a worker by its number, for the error's text.
        end: ends them all.
        hint: at the end of the error's text.

    Raises:
        SimulatorError: a worker has ended.
    """
    try:
        yield
    except GONE:
        dead = _first_dead(processes)
        how = "a worker does not answer any more" if dead is None else how_it_ended(processes[dead])
        with suppress(OSError):
            end()
        who = "" if dead is None else f"{name(dead)} "
        raise SimulatorError(f"{who}{how}; the other workers were ended{hint}") from None


def _first_dead(processes: Sequence[BaseProcess]) -> int | None:
    """The number of a worker that has ended; it may take a moment until the system tells."""
    until = time.monotonic() + GRACE_S
    while time.monotonic() < until:
        for number, process in enumerate(processes):
            if not process.is_alive():
                return number
        time.sleep(0.01)
    return None
