"""A rollout folder read for a Rerun recording, with every fault found before anything is written."""

import csv
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from avp_habitat.errors import RolloutError
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout import images
from avp_habitat.rollout.format import Rollout, View
from avp_habitat.task.settings import ACTION_NAMES
from avp_sb3.rerun.episode import EncodedView, Episode, encode_jpeg, encode_view, spread_indices
from avp_sb3.rerun.room import room_points


class Steps:
    """The rows of a `steps.csv`."""

    def __init__(self, path: Path, frames: int) -> None:
        """Read a table.

        Args:
            path: of the file.
            frames: how many rows it must have.

        Raises:
            RolloutError: it is missing, unreadable, ragged, or has another number of rows.
        """
        self.path = path
        try:
            with path.open(newline="", encoding="utf-8") as file:
                lines = list(csv.reader(file))
        except FileNotFoundError:
            raise RolloutError(f"{path}: expected a table of steps, found no such file") from None
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise RolloutError(f"{path}: expected a table of steps, could not read it: {error}") from None
        self.names, self.rows = (lines[0], lines[1:]) if lines else ([], [])
        for number, row in enumerate(self.rows, start=1):
            if len(row) != len(self.names):
                raise RolloutError(f"{path}: expected {len(self.names)} columns, found {len(row)} in row {number}")
        if len(self.rows) != frames:
            raise RolloutError(f"{path}: expected one row per frame ({frames}), found {len(self.rows)}")

    def numbers(self, name: str) -> NDArray[np.float64]:
        """`(t,)` a column.

        Raises:
            RolloutError: there is no such column, or something in it is no finite number.
        """
        words = self._column(name)
        try:
            values = np.array([float(word) for word in words])
        except ValueError as error:
            raise RolloutError(f"{self.path}: expected numbers in column {name!r}: {error}") from None
        if bad := np.flatnonzero(~np.isfinite(values)).tolist():
            raise RolloutError(
                f"{self.path}: expected finite numbers in column {name!r}, found {words[bad[0]]} in row {bad[0] + 1}"
            )
        return values

    def actions(self) -> NDArray[np.float64]:
        """`(t,)` the actions' numbers.

        Raises:
            RolloutError: there is an action that no agent has.
        """
        words = self._column("action")
        if unknown := sorted({repr(word) for word in words if word not in ACTION_NAMES}):
            expected = ", ".join(ACTION_NAMES)
            raise RolloutError(f"{self.path}: expected actions out of {expected}, found {', '.join(unknown)}")
        return np.array([float(ACTION_NAMES.index(word)) for word in words])

    def plots(self) -> dict[str, NDArray[np.float64]]:
        """`(t,)` the figures of the steps, named as those of a training's episodes.

        Raises:
            RolloutError: a column is missing or wrong.
        """
        parts = {f"reward/{name.removeprefix('reward_')}": name for name in self.names if name.startswith("reward_")}
        columns = {"coverage": "coverage", "reward/sum": "reward", **parts}
        return {"action": self.actions()} | {plot: self.numbers(name) for plot, name in columns.items()}

    def feet(self) -> NDArray[np.float64]:
        """`(t, 3)` where the agent stood after each step, metres, world frame.

        Raises:
            RolloutError: a column is missing or wrong.
        """
        return np.stack([self.numbers(name) for name in ("x_m", "y_m", "z_m")], axis=-1)

    def _column(self, name: str) -> list[str]:
        if self.names.count(name) != 1:
            found = ", ".join(self.names) or "none"
            raise RolloutError(f"{self.path}: expected a column {name!r}, found {found}")
        index = self.names.index(name)
        return [row[index] for row in self.rows]


PICTURES = 100
"""Of a rollout, at most."""
_LONGEST_PX = 640
_MAP_FILE = "trajectory.png"
Progress = Callable[[], Any]


@dataclass(frozen=True)
class RolloutContents:
    """What a recording shows of a rollout."""

    episode: Episode
    """Its steps and pictures."""
    room: tuple[NDArray[np.float32], NDArray[np.uint8]]
    """`(p, 3)` points in metres, world frame, and `(p, 3)` colours, out of the pictures."""
    map: bytes | None
    """`trajectory.png`; None where the rollout was written without it."""
    metrics: dict[str, float] = field(default_factory=dict)
    """The figures of `rollout.json`."""
    about: str = ""
    """Markdown: where the rollout comes from and its figures."""


def pictured(rollout: Rollout, at_most: int = PICTURES) -> list[int]:
    """The steps whose pictures a recording shows: all, or so many spread over the rollout."""
    return spread_indices(len(rollout.frames), at_most)


def read_contents(rollout: Rollout, *, pictures: int = PICTURES, progress: Progress = lambda: None) -> RolloutContents:
    """Read the tables and pictures of a rollout.

    The floor's cells are not in a rollout folder; its top-down map shows them instead.

    Args:
        rollout: as read by `avp_habitat.rollout.format.read_rollout`.
        pictures: so many views at most are shown with pictures, spread over the rollout. Larger ones than 640 pixels
            are subsampled.
        progress: called after each picture.

    Raises:
        RolloutError: a file is missing or unreadable, `steps.csv` is not one row of finite
            numbers per frame, or the metrics are no finite numbers.
    """
    steps = Steps(rollout.folder / "steps.csv", len(rollout.frames))
    plots, feet, metrics = steps.plots(), steps.feet(), rollout.meta.get("metrics", {})
    width, height = rollout.intrinsics.width, rollout.intrinsics.height
    stride = min(-(-max(width, height) // _LONGEST_PX), width, height)
    camera = _subsampled(rollout.intrinsics, stride)
    chosen = pictured(rollout, pictures)
    views: dict[int, EncodedView] = {}

    def frames() -> Iterator[tuple[NDArray[np.uint8], NDArray[np.floating]]]:
        for step in chosen:
            rgb, depth, views[step] = _read_view(rollout.frames[step], camera, stride)
            yield rgb, depth
            progress()

    poses = np.array([view.camera_to_world for view in rollout.frames]).reshape(-1, 4, 4)
    room = room_points(frames(), camera, poses[chosen])
    episode = Episode(poses, feet, camera, views, plots)
    return RolloutContents(episode, room, _read_map(rollout), metrics, _about(rollout, metrics))


def _read_view(view: View, camera: Intrinsics, stride: int) -> tuple[NDArray, NDArray, EncodedView]:
    """Picture, depth in metres, and both compressed."""
    rgb, depth = images.read_rgb(view.image), images.read_depth(view.depth)
    if stride == 1:
        return rgb, depth, EncodedView(encode_jpeg(rgb), view.depth.read_bytes())
    height, width = camera.height * stride, camera.width * stride
    rgb = np.asarray(Image.fromarray(rgb[:height, :width]).reduce(stride))
    # Depth is picked, not averaged: a mean of two surfaces is none.
    depth = np.ascontiguousarray(depth[stride // 2 : height : stride, stride // 2 : width : stride])
    return rgb, depth, encode_view(rgb, depth)


def _subsampled(camera: Intrinsics, stride: int) -> Intrinsics:
    """The camera of pictures of which every n-th pixel is kept; an incomplete block at the border is dropped."""
    if stride == 1:
        return camera
    return Intrinsics(
        width=camera.width // stride,
        height=camera.height // stride,
        fx=camera.fx / stride,
        fy=camera.fy / stride,
        cx=camera.cx / stride,
        cy=camera.cy / stride,
    )


def _read_map(rollout: Rollout) -> bytes | None:
    path = rollout.folder / _MAP_FILE
    if not path.exists():
        return None
    images.read_rgb(path)
    return path.read_bytes()


def _about(rollout: Rollout, metrics: dict[str, float]) -> str:
    """Tables of the metrics and of all else in `rollout.json` that says where the rollout comes from."""
    facts = {name: value for name, value in rollout.meta.items() if name not in ("metrics", "pose_convention")}
    lines = [f"# {_cell(rollout.folder.resolve().name)}", "", "| metric | value |", "|---|---|"]
    lines += [f"| {_cell(name)} | {value:.6g} |" for name, value in metrics.items()]
    lines += ["", "| rollout.json | |", "|---|---|"]
    lines += [f"| {_cell(name)} | {_cell(_plain(value))} |" for name, value in facts.items()]
    return "\n".join(lines) + "\n"


def _plain(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_plain(entry)}" for name, entry in value.items())
    return value if isinstance(value, str) else json.dumps(value)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
