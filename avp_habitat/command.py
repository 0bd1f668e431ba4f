"""How far long work has come: a bar on a terminal, a line now and then in a file, a pipe or a notebook."""

import os
import signal
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from tqdm import tqdm

from avp_habitat.errors import AVPError

INTERRUPTED = 130


def _interrupt(signum: int, _frame: object) -> None:
    raise KeyboardInterrupt(signal.Signals(signum).name)


def run(main: Callable[[Sequence[str]], None], argv: Sequence[str] | None = None) -> int:
    """Run a command and turn its outcome into an exit code.

    Args:
        main: takes the arguments (without the program's name).
        argv: the arguments; the process's own when omitted.

    Returns:
        0, or 1 (failure), 2 (usage), 130 (interrupted). A SIGTERM ends the command like Ctrl-C, so that
        temporary folders are removed.
    """
    previous = signal.signal(signal.SIGTERM, _interrupt)
    try:
        main(sys.argv[1:] if argv is None else argv)
    except AVPError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        # The reader of our output (a pager, `head`) left; Python would complain again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt as interrupt:
        print(f"interrupted{f': {interrupt}' if str(interrupt) else ''}", file=sys.stderr)
        return INTERRUPTED
    finally:
        signal.signal(signal.SIGTERM, previous)
    return 0


SECONDS = 10.0
"""Between two lines where there is no terminal."""
_LINE = (
    "{desc}: {percentage:.0f} %, {n_fmt} of {total_fmt} {unit}s, {elapsed} gone, {remaining} left, {rate_fmt}{postfix}"
)


class _Lines:
    """The error stream for a bar that would otherwise write over its own line."""

    def __init__(self) -> None:
        self._said = ""

    def write(self, text: str) -> None:
        said = text.strip("\r\n ")
        # At its end a bar may tell the same twice, with another rate.
        if (news := said.partition(" gone")[0]) and news != self._said:
            self._said = news
            print(said, file=sys.stderr, flush=True)

    def flush(self) -> None:
        """Lines are flushed as they are written."""


def progress(work: Iterable[Any] | None = None, **options: Any) -> tqdm:
    """Tqdm's bar; without a terminal it prints a line at the start, every ten seconds and at the end.

    Args:
        work: to go through; None to call `update`.
        **options: tqdm's, `desc` and `unit` at least; `total` where `work` has no length.
    """
    if sys.stderr.isatty():
        return tqdm(work, **options)
    # At position 0 no bar moves the cursor because of other bars.
    options |= {"file": _Lines(), "position": 0, "bar_format": _LINE}
    return tqdm(work, mininterval=SECONDS, maxinterval=SECONDS, **options)
