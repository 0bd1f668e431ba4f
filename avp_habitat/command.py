"""The frame of every command line of the suite: one-line errors, exit codes, Ctrl-C."""

import os
import signal
import sys
from collections.abc import Callable, Sequence

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
