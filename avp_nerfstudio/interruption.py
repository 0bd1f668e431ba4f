"""Ctrl-C and SIGTERM as a wish that a loop grants between two of its rounds."""

import os
import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_GRANTED = b"\nstopping after this iteration; Ctrl-C again to stop at once\n"


class Interruption:
    """A context in which the first signal is remembered and the second, or one that comes in vain, interrupts."""

    def __init__(self, idle: Callable[[], bool]) -> None:
        """Remember how to tell that nobody will look: `idle` says so."""
        self.requested = False
        self._idle = idle
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "Interruption":
        """Take the signals over; only the main thread can, elsewhere nothing happens."""
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._note) for number in _SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        """Give the signals back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous = {}

    def grant(self) -> None:
        """End the loop if that was asked for.

        Raises:
            KeyboardInterrupt: it was.
        """
        if self.requested:
            raise KeyboardInterrupt

    def ignore(self) -> None:
        """From now on nothing interrupts: something is being brought to its end."""
        for number in self._previous:
            signal.signal(number, signal.SIG_IGN)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.requested or self._idle():
            raise KeyboardInterrupt
        self.requested = True
        # print() may be what the signal has interrupted.
        os.write(2, _GRANTED)
