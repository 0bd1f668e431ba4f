"""Asking a question of a program of its own: what is asked may crash, hang or import half of PyTorch."""

import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import dataclass
from typing import Any

_SILENT = {"PYTHONWARNINGS": "ignore", "MAGNUM_LOG": "quiet", "HABITAT_SIM_LOG": "quiet", "TF_CPP_MIN_LOG_LEVEL": "3"}
_running: set["subprocess.Popen[str]"] = set()
_lock = threading.Lock()


@dataclass(frozen=True)
class Answer:
    """What a program said, or how it ended without a word."""

    value: Any
    """The JSON value on the last line of its output; None when it failed."""
    failure: str | None
    """How it failed, in one line; None when it did not."""


def ask(command: list[str], *, time_limit_s: float, question: Any = None) -> Answer:
    """Run a program that prints one JSON value as its last line.

    Args:
        command: its arguments, after those of this Python.
        time_limit_s: it is ended after this long, and that is the answer.
        question: JSON value for its standard input.
    """
    process = subprocess.Popen(
        [sys.executable, *command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env={**os.environ, **_SILENT},
    )
    with _lock:
        _running.add(process)
    try:
        said, complaints = process.communicate(json.dumps(question), timeout=time_limit_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return Answer(None, f"gave no answer within {time_limit_s:.0f} s")
    finally:
        with _lock:
            _running.discard(process)
    return _answer(process.returncode, said, complaints)


def stop_all() -> None:
    """End the programs that are still being asked."""
    with _lock:
        for process in _running:
            process.kill()


def _answer(code: int, said: str, complaints: str) -> Answer:
    last = _last_line(complaints)
    if code < 0:
        return Answer(None, f"crashed with {signal.Signals(-code).name}{f' ({last})' if last else ''}")
    if code > 0:
        return Answer(None, last or f"ended with exit code {code}")
    try:
        return Answer(json.loads(_last_line(said)), None)
    except ValueError:
        return Answer(None, f"said {_last_line(said)!r} instead of JSON")


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else ""
