"""What a check found: one line with a mark."""

from dataclasses import dataclass

OK, ABSENT, BROKEN = "ok", "--", "!!"
_COLOURS = {OK: "\033[32m", ABSENT: "\033[2m", BROKEN: "\033[1;31m"}
_PLAIN = "\033[0m"
_WIDTH = 26


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's report."""

    mark: str
    """`ok`, `--` (not here and not needed) or `!!` (broken)."""
    subject: str
    """What was looked at, for example `numpy`."""
    text: str
    """What was found; where it is not `ok`, also what to do."""

    def line(self, *, colour: bool) -> str:
        """The finding as a line of text, with terminal colours or without."""
        mark = f"{_COLOURS[self.mark]}{self.mark}{_PLAIN}" if colour else self.mark
        return f"{mark}  {self.subject:<{_WIDTH}} {' '.join(self.text.split())}"
