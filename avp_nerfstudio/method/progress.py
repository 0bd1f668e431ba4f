"""How far a training is: a bar with rate and time left on a terminal, a line now and then in a log."""

import sys
import time
from collections.abc import Mapping
from typing import Any

from tqdm import tqdm

_LINE_EVERY_S = 30.0


class TrainingProgress:
    """The bar of one training."""

    def __init__(self, total: int) -> None:
        """Begin a training of `total` iterations."""
        self._terminal = sys.stderr.isatty()
        self._bar = tqdm(
            total=total,
            desc="training",
            unit="it",
            dynamic_ncols=True,
            disable=not self._terminal,
            mininterval=0.5,
            smoothing=0.05,
        )
        self._total, self._done = total, 0
        self._started = self._shown_at = time.monotonic()

    def update(self, values: Mapping[str, Any]) -> None:
        """One iteration more; `values` (numbers or tensors of one element) are read only when they are shown."""
        self._done += 1
        if self._terminal:
            if self._bar.update():
                self._bar.set_postfix_str(_words(values), refresh=False)
            return
        now = time.monotonic()
        if now - self._shown_at >= _LINE_EVERY_S:
            self._shown_at = now
            self._line(_words(values))

    def close(self) -> None:
        """Leave the last state on the screen."""
        self._bar.close()
        if not self._terminal and self._done:
            self._line("")

    def _line(self, words: str) -> None:
        elapsed = time.monotonic() - self._started
        text = tqdm.format_meter(self._done, self._total, elapsed, prefix="training", unit="it", postfix=words, ncols=0)
        print(text, file=sys.stderr, flush=True)


def _words(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {float(value):.4g}" for name, value in values.items())
