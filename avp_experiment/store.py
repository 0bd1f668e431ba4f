"""What is done, what failed and what is left of an experiment, as files in its folder."""

import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_experiment.cells import COLLECT, RECONSTRUCT, Cell
from avp_habitat.errors import UsageError

DONE, FAILED, LOG = "cell.json", "failed.json", "log.txt"


@dataclass(frozen=True)
class Store:
    """An experiment's folder."""

    root: Path

    def record(self, cell: Cell) -> dict[str, Any] | None:
        """What is known of a finished cell: `seconds`, `commit`, `finished`; None when it is not done."""
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
        if cell.kind != RECONSTRUCT or cell.frames is None or cell.needs is None:
            return False
        about = self.record(cell.needs)
        return about is not None and about["facts"]["metrics"]["views"] <= cell.frames

    def prepare(self, cell: Cell) -> tuple[str, ...]:
        """Clear what an interrupted command left, unless it can go on with that; the command line to run."""
        folder, out = cell.folder(self.root), cell.output(self.root)
        folder.mkdir(parents=True, exist_ok=True)
        # What a failure left may be its cause.
        if cell.resumes and out.exists() and not (folder / FAILED).exists():
            return (*cell.words, "--resume", str(out))
        for path in folder.iterdir():
            if path.name != LOG:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        return cell.words

    def finish(self, cell: Cell, about: dict[str, Any]) -> None:
        """Remember that a cell is done; the last thing that happens to it."""
        _write(cell.folder(self.root) / DONE, {"command": cell.command, **about})

    def fail(self, cell: Cell, reason: str) -> None:
        """Remember why a cell failed."""
        _write(cell.folder(self.root) / FAILED, {"command": cell.command, "reason": reason})

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


def bytes_needed(cells: list[Cell], *, width: int, height: int, budget: int, heldout: int) -> int:
    """About how much disk cells take that are still to be done.

    Measured: a picture with its depth takes up to 3.5 bytes per pixel, a reconstruction or training some megabytes.

    Args:
        cells: still to be done.
        width: of the pictures in pixels.
        height: of the pictures in pixels.
        budget: most views of a rollout.
        heldout: number of held-out views.
    """
    rollout = 7 * width * height * (budget + heldout) // 2
    # A reconstruction's checkpoint and logs lie there while it runs.
    size = {COLLECT: rollout, RECONSTRUCT: 1 << 20}
    running = 2 * (100 << 20)
    return sum(size.get(cell.kind, 8 << 20) for cell in cells) + (running if cells else 0)


def _read(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _write(path: Path, content: dict[str, Any]) -> None:
    temporary = path.with_suffix(".part")
    with temporary.open("w", encoding="utf-8") as file:
        json.dump(content, file, indent=1)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
