"""A file as a value of Stable-Baselines3's logger, for the formats that can keep one."""

from dataclasses import dataclass
from pathlib import Path

NOT_FOR = ("stdout", "log", "json", "csv", "tensorboard")
"""Formats that cannot hold a file: `logger.record(name, LoggedFile(path), exclude=NOT_FOR)`."""


@dataclass(frozen=True)
class LoggedFile:
    """A file to keep with the run; MLflow copies it when the logger is dumped."""

    path: Path
    """Where it lies."""
    name: str
    """How the artifact is called, `/` for folders: an artifact of the same name is replaced."""
