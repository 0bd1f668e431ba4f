"""An experiment's folder: its configuration, what is done and what failed."""

import fcntl
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_experiment.cells import TRAIN, Cell
from avp_experiment.configuration import Configuration
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.files import atomic_file

FORMAT = 1
CONFIGURATION = "experiment.json"
DONE, FAILED, LOG = "cell.json", "failed.json", "log.txt"


@dataclass(frozen=True)
class Folder:
    """What is done, what failed and what is left."""

    root: Path

    def record(self, cell: Cell) -> dict[str, Any] | None:
        """`seconds`, `commit`, `finished` and `facts` of a finished cell; None when it is not done."""
        return _read(cell.folder(self.root) / DONE)

    def failure(self, cell: Cell) -> str | None:
        """Why a cell failed when it was last tried; None when it did not."""
        found = _read(cell.folder(self.root) / FAILED)
        return None if found is None else str(found.get("reason"))

    def log(self, cell: Cell) -> Path:
        """What the cell's command printed."""
        return cell.folder(self.root) / LOG

    def is_done(self, cell: Cell) -> bool:
        """Whether a cell is finished, or has nothing to do."""
        return self.record(cell) is not None or self.is_empty(cell)

    def is_empty(self, cell: Cell) -> bool:
        """Whether a rollout is so short that its first frames are all of it, which another cell reconstructs."""
        if cell.frames is None or cell.needs is None:
            return False
        about = self.record(cell.needs)
        return about is not None and about["facts"]["metrics"]["views"] <= cell.frames

    def prepare(self, cell: Cell) -> tuple[str, ...]:
        """Clear what an interrupted command left, unless it can go on with that; the command line to run."""
        folder, out = cell.folder(self.root), cell.output(self.root)
        folder.mkdir(parents=True, exist_ok=True)
        # What a failure left may be its cause.
        if cell.kind == TRAIN and out.exists() and not (folder / FAILED).exists():
            return (*cell.words, "--resume", str(out))
        for path in folder.iterdir():
            if path.name != LOG:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        return cell.words

    def finish(self, cell: Cell, about: dict[str, Any]) -> None:
        """Remember that a cell is done; the last thing that happens to it."""
        write_json(cell.folder(self.root) / DONE, {"command": cell.command, **about}, indent=1)

    def fail(self, cell: Cell, reason: str) -> None:
        """Remember why a cell failed."""
        write_json(cell.folder(self.root) / FAILED, {"command": cell.command, "reason": reason}, indent=1)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep a second program out of the folder.

        Raises:
            UsageError: another one is at work there.
        """
        with (self.root / ".lock").open("a") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UsageError(f"out: another program is working on {self.root}; wait for it, or stop it") from None
            yield


def open_folder(configuration: Configuration, root: Path) -> Folder:
    """Write the configuration into the experiment's folder, or hold it against the one that is there.

    Raises:
        UsageError: the folder holds something else, or an experiment of another configuration.
        AVPError: nothing can be written there.
    """
    path, wanted = root / CONFIGURATION, configuration.as_json()
    if path.exists():
        known = _read(path) or {}
        if (version := known.pop("format", None)) != FORMAT:
            raise AVPError(f"{path}: expected an experiment's configuration of format {FORMAT}, found {version!r}")
        # Methods and starts may be added.
        names = sorted({*wanted, *known} - {"starts"})
        if different := [name for name in names if wanted.get(name) != known.get(name)]:
            told = [f"{name} {known.get(name)} there, {wanted.get(name)} asked for" for name in different]
            raise UsageError(f"out: {root} holds an experiment of another configuration: {'; '.join(told)}")
        return Folder(root)
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise UsageError(f"out: {root} is no experiment's folder: expected {CONFIGURATION}, or a new or empty folder")
    try:
        fixed = {name: value for name, value in wanted.items() if name != "starts"}
        write_json(path, {"format": FORMAT, **fixed}, indent=1)
    except OSError as error:
        raise AVPError(f"out: {root}: cannot write there: {error.strerror}") from None
    return Folder(root)


def write_json(path: Path, content: dict[str, Any], **style: Any) -> None:
    """Write a JSON file, whole or not at all."""
    with atomic_file(path) as partial:
        partial.write_text(json.dumps(content, allow_nan=False, **style) + "\n", encoding="utf-8")


def _read(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None
