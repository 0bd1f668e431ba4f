"""The frame of every command line: options as a dataclass, one-line errors, exit codes, Ctrl-C, progress."""

import io
import os
import re
import signal
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import redirect_stderr
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, get_type_hints

from tqdm import tqdm

from avp_habitat.errors import AVPError, UsageError

INTERRUPTED = 130
Options = TypeVar("Options")


def parse(options: type[Options], argv: Sequence[str]) -> Options:
    """Read a command line into a dataclass: tyro makes `--flag` from the field `flag`, and `--help` from docstrings.

    A field without a default is required, `tyro.conf.Positional[Path]` has no flag, a nested dataclass gives its
    fields as they are, without a prefix. The class's docstring is the command's description. What its `__post_init__`
    refuses by "field: …" is told as "--field: …".

    Raises:
        UsageError: the words do not fit, in one line.
        SystemExit: after `--help`.
    """
    import tyro

    said = io.StringIO()
    how = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)
    try:
        with redirect_stderr(said):
            return tyro.cli(options, args=list(argv), prog=_program(), config=how)
    except SystemExit as end:
        if not end.code:
            raise
        raise UsageError(_one_line(said.getvalue())) from None
    except UsageError as error:
        name, colon, rest = str(error).partition(":")
        named = colon and name in _names(options)
        raise (UsageError(f"--{name.replace('_', '-')}:{rest}") if named else error) from None


def _program() -> str:
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return os.path.basename(sys.argv[0]) if spec is None else f"python -m {spec.name.removesuffix('.__main__')}"


def _names(options: Any) -> set[str]:
    """The fields of a dataclass and of those within it."""
    hints = get_type_hints(options)
    nested = [hints[field.name] for field in fields(options) if is_dataclass(hints[field.name])]
    return {field.name for field in fields(options)}.union(*map(_names, nested))


def _one_line(box: str) -> str:
    """What tyro says in a frame, without its title and what follows its first rule, as one line."""
    said, *more = re.split("─{8,}", re.sub("[╭╮╰╯│]", " ", box.partition("\n")[2]))
    near = re.search(r"Perhaps you meant:\s+(--[\w-]+)", more[0] if more else "")
    return " ".join(said.split()) + (f"; did you mean {near[1]}?" if near else "; --help shows all options")


def _interrupt(signum: int, _frame: object) -> None:
    raise KeyboardInterrupt(signal.Signals(signum).name)


def run(main: Callable[[Any], None], argv: Sequence[str] | None = None) -> int:
    """Run a command and turn its outcome into an exit code: 0, or 1 (failure), 2 (usage), 130 (interrupted).

    `main` takes the options that its annotation names (`parse`), or else the list of words. A SIGTERM ends the command
    like Ctrl-C, so that temporary folders are removed.
    """
    words = sys.argv[1:] if argv is None else argv
    options = next(iter(get_type_hints(main).values()), None)
    previous = signal.signal(signal.SIGTERM, _interrupt)
    try:
        main(parse(options, words) if isinstance(options, type) and is_dataclass(options) else words)
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
    """Tqdm's bar, whose options are at least `desc` and `unit`, and `total` where `work` has no length.

    Without a terminal it prints a line at the start, every ten seconds and at the end.
    """
    if sys.stderr.isatty():
        return tqdm(work, **options)
    # At position 0 no bar moves the cursor because of other bars.
    options |= {"file": _Lines(), "position": 0, "bar_format": _LINE}
    return tqdm(work, mininterval=SECONDS, maxinterval=SECONDS, **options)
