"""Rollouts as Rerun recordings."""

import csv
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from avp_habitat import images
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.rollout import Rollout, read_rollout
from avp_habitat.settings import ACTION_NAMES
from avp_sb3.rerun_episode import EncodedView, Episode, encode_jpeg, log_episode
from avp_sb3.rerun_layout import open_recording

_MAP_FILE = "trajectory.png"


def record_rollout(recording: rr.RecordingStream, rollout: Rollout, root: str = "") -> None:
    """Add a rollout as episode 0, with all its pictures and its map.

    The floor's cells are not in a rollout folder; its top-down map appears as the picture `map` instead.

    Args:
        recording: where to.
        rollout: as read by `avp_habitat.rollout.read_rollout`.
        root: entity path above `world`, `plots` and `map`.

    Raises:
        RolloutError: a file of the rollout cannot be read, or `steps.csv` is not one row of numbers per frame.
    """
    rows = _read_steps(rollout)
    poses = np.array([view.camera_to_world for view in rollout.frames]).reshape(-1, 4, 4)
    try:
        views = {
            step: EncodedView(encode_jpeg(images.read_rgb(view.image)), view.depth.read_bytes())
            for step, view in enumerate(rollout.frames)
        }
    except OSError as error:
        raise RolloutError(f"{rollout.folder}: expected readable pictures: {error}") from None
    episode = Episode(poses, _feet(rows), rollout.intrinsics, views, _plots(rows))
    log_episode(recording, root, episode, number=0)
    if (rollout.folder / _MAP_FILE).is_file():
        recording.log(f"{root}/map", rr.EncodedImage(path=rollout.folder / _MAP_FILE), static=True)


def write_rollout_recording(folders: Sequence[Path], target: Path) -> Path:
    """Write one `.rrd` file with each rollout under its folder's name; the file appears when it is whole.

    Args:
        folders: rollout folders.
        target: the file to make.

    Raises:
        UsageError: the target exists, or no folder is given.
        RolloutError: a rollout is damaged, or the target cannot be written.
    """
    target = Path(target)
    if not folders:
        raise UsageError("expected at least one rollout folder, got none")
    _refuse_existing(target)
    rollouts = [read_rollout(folder) for folder in folders]
    names = _unique_names([rollout.folder.resolve().name for rollout in rollouts])
    roots = [f"/{rr.escape_entity_path_part(name)}" for name in names]
    temporary = target.parent / f".{target.name}.partial-{os.getpid()}"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        recording = open_recording(temporary, roots, with_map=True)
        try:
            for root, rollout in zip(roots, rollouts, strict=True):
                record_rollout(recording, rollout, root)
        finally:
            recording.disconnect()
        _refuse_existing(target)
        temporary.rename(target)
    except OSError as error:
        raise RolloutError(f"{target}: cannot write there: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
    return target


class _Steps:
    """The rows of `steps.csv`."""

    def __init__(self, path: Path, rows: list[dict[str, str]]) -> None:
        self.path = path
        self.rows = rows
        self.names = list(rows[0]) if rows else []

    def numbers(self, name: str) -> NDArray[np.float64]:
        """`(t,)` a column."""
        try:
            return np.array([float(row[name]) for row in self.rows])
        except KeyError:
            raise RolloutError(f"{self.path}: expected a column {name!r}, found {', '.join(self.names)}") from None
        except (TypeError, ValueError) as error:
            raise RolloutError(f"{self.path}: expected numbers in column {name!r}: {error}") from None

    def actions(self) -> NDArray[np.float64]:
        """`(t,)` the actions' numbers."""
        unknown = {row.get("action") for row in self.rows} - set(ACTION_NAMES)
        if unknown:
            found = ", ".join(sorted(map(repr, unknown)))
            raise RolloutError(f"{self.path}: expected actions out of {', '.join(ACTION_NAMES)}, found {found}")
        return np.array([float(ACTION_NAMES.index(row["action"])) for row in self.rows])


def _read_steps(rollout: Rollout) -> _Steps:
    path = rollout.folder / "steps.csv"
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RolloutError(f"{path}: expected a table of steps, could not read it: {error}") from None
    if len(rows) != len(rollout.frames):
        raise RolloutError(f"{path}: expected one row per frame ({len(rollout.frames)}), found {len(rows)}")
    return _Steps(path, rows)


def _feet(steps: _Steps) -> NDArray[np.float64]:
    """`(t, 3)` where the agent stood, metres, world frame."""
    return np.stack([steps.numbers(name) for name in ("x_m", "y_m", "z_m")], axis=-1)


def _plots(steps: _Steps) -> dict[str, NDArray[np.float64]]:
    """The figures of the steps, named as those of a training's episodes."""
    parts = {f"reward/{name.removeprefix('reward_')}": name for name in steps.names if name.startswith("reward_")}
    columns = {"coverage": "coverage", "reward/sum": "reward", **parts}
    return {"action": steps.actions()} | {plot: steps.numbers(name) for plot, name in columns.items()}


def _refuse_existing(target: Path) -> None:
    if target.exists() or target.is_symlink():
        raise UsageError(f"{target}: exists already; choose another name or remove it")


def _unique_names(names: Sequence[str]) -> list[str]:
    """Equal names numbered from the second one on."""
    unique: list[str] = []
    for name in names:
        candidate, count = name, 1
        while candidate in unique:
            count += 1
            candidate = f"{name}-{count}"
        unique.append(candidate)
    return unique
