"""Rollouts as one Rerun recording, with every fault of them found before anything is written."""

import csv
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from PIL import Image

from avp_habitat.command import progress as progress_bar
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.files import atomic_file, check_new
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout import images
from avp_habitat.rollout.format import Rollout, View, read_rollout
from avp_habitat.task.settings import ACTION_NAMES
from avp_sb3.rerun import APPLICATION
from avp_sb3.rerun.episode import (
    EncodedView,
    Episode,
    Time,
    encode_jpeg,
    encode_view,
    log_at,
    log_episode,
    metric_path,
    spread_indices,
)
from avp_sb3.rerun.layout import rollout_blueprint
from avp_sb3.rerun.room import Cloud, log_room, room_points

_PICTURES, _MOST_PICTURES = 100, 400
_LONGEST_PX = 640
_FLUSH_S = 60
# Of the rollouts' curves in one plot; they can be told apart by the colour-blind too.
_COLOURS = ((0, 114, 178), (230, 159, 0), (0, 158, 115), (213, 94, 0), (204, 121, 167), (86, 180, 233))


@dataclass(frozen=True)
class RolloutContents:
    """What a recording shows of a rollout."""

    episode: Episode
    """Its steps and pictures."""
    room: Cloud
    """Out of the pictures."""
    map: bytes | None
    """`trajectory.png`; None where the rollout was written without it."""
    metrics: dict[str, float] = field(default_factory=dict)
    """The figures of `rollout.json`."""
    about: str = ""
    """Markdown: where the rollout comes from and its figures."""


def read_contents(
    rollout: Rollout, *, pictures: int = _PICTURES, progress: Callable[[], Any] = lambda: None
) -> RolloutContents:
    """Read the tables and pictures of a rollout.

    Args:
        rollout: as read by `avp_habitat.rollout.format.read_rollout`.
        pictures: so many views at most are shown with pictures, spread over the rollout. Larger ones than 640 pixels
            are subsampled.
        progress: called after each picture.

    Raises:
        RolloutError: a file is missing or unreadable, or `steps.csv` is not one row of finite numbers per frame.
    """
    plots, feet = read_steps(rollout.folder / "steps.csv", len(rollout.frames))
    width, height = rollout.intrinsics.width, rollout.intrinsics.height
    stride = min(-(-max(width, height) // _LONGEST_PX), width, height)
    camera = _subsampled(rollout.intrinsics, stride)
    chosen = spread_indices(len(rollout.frames), pictures)
    views: dict[int, EncodedView] = {}

    def frames() -> Iterator[tuple[NDArray[np.uint8], NDArray[np.floating]]]:
        for step in chosen:
            rgb, depth, views[step] = _read_view(rollout.frames[step], camera, stride)
            yield rgb, depth
            progress()

    poses = np.array([view.camera_to_world for view in rollout.frames]).reshape(-1, 4, 4)
    room = room_points(frames(), camera, poses[chosen])
    picture, metrics = rollout.folder / "trajectory.png", rollout.meta.get("metrics", {})
    if drawn := picture.exists():
        images.read_rgb(picture)
    episode = Episode(poses, feet, camera, views, plots)
    return RolloutContents(episode, room, picture.read_bytes() if drawn else None, metrics, _about(rollout, metrics))


def read_steps(path: Path, frames: int) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.float64]]:
    """Read a `steps.csv`.

    Args:
        path: of the file.
        frames: how many rows it must have.

    Returns:
        `(t,)` figures of the steps, named as those of a training's episodes, and `(t, 3)` where the agent stood after
        each step, metres, world frame.

    Raises:
        RolloutError: the table is missing, unreadable, ragged, has another number of rows, lacks a column, or holds an
            action that no agent has or something else that is no finite number.
    """
    columns = _read_columns(path, frames)
    if unknown := sorted(set(columns.get("action", [])) - set(ACTION_NAMES)):
        expected = ", ".join(ACTION_NAMES)
        raise RolloutError(f"{path}: expected actions out of {expected}, found {', '.join(map(repr, unknown))}")
    if "action" in columns:
        columns["action"] = [str(ACTION_NAMES.index(word)) for word in columns["action"]]
    names = {"action": "action", "coverage": "coverage", "reward/sum": "reward"}
    names |= {f"reward/{name.removeprefix('reward_')}": name for name in columns if name.startswith("reward_")}
    plots = {plot: _numbers(path, columns, name) for plot, name in names.items()}
    return plots, np.stack([_numbers(path, columns, name) for name in ("x_m", "y_m", "z_m")], axis=-1)


def _read_columns(path: Path, frames: int) -> dict[str, list[str]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            names, *rows = list(csv.reader(file)) or [[]]
    except FileNotFoundError:
        raise RolloutError(f"{path}: expected a table of steps, found no such file") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RolloutError(f"{path}: expected a table of steps, could not read it: {error}") from None
    for number, row in enumerate(rows, start=1):
        if len(row) != len(names):
            raise RolloutError(f"{path}: expected {len(names)} columns, found {len(row)} in row {number}")
    if len(rows) != frames:
        raise RolloutError(f"{path}: expected one row per frame ({frames}), found {len(rows)}")
    return {name: [row[index] for row in rows] for index, name in enumerate(names)}


def _numbers(path: Path, columns: Mapping[str, list[str]], name: str) -> NDArray[np.float64]:
    if name not in columns:
        raise RolloutError(f"{path}: expected a column {name!r}, found {', '.join(columns) or 'none'}")
    try:
        values = np.array([float(word) for word in columns[name]])
    except ValueError as error:
        raise RolloutError(f"{path}: expected numbers in column {name!r}: {error}") from None
    for row in np.flatnonzero(~np.isfinite(values))[:1]:
        found = f"{columns[name][row]} in row {row + 1}"
        raise RolloutError(f"{path}: expected finite numbers in column {name!r}, found {found}")
    return values


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
    focal_and_centre = {name: getattr(camera, name) / stride for name in ("fx", "fy", "cx", "cy")}
    return Intrinsics(width=camera.width // stride, height=camera.height // stride, **focal_and_centre)


def _about(rollout: Rollout, metrics: Mapping[str, float]) -> str:
    """Tables of the metrics and of all else in `rollout.json` that says where the rollout comes from."""
    facts = {name: _plain(value) for name, value in rollout.meta.items() if name not in ("metrics", "pose_convention")}
    lines = [f"# {_cell(rollout.folder.resolve().name)}", "", "| metric | value |", "|---|---|"]
    lines += [f"| {_cell(name)} | {value:.6g} |" for name, value in metrics.items()]
    lines += ["", "| rollout.json | |", "|---|---|"]
    lines += [f"| {_cell(name)} | {_cell(value)} |" for name, value in facts.items()]
    return "\n".join(lines) + "\n"


def _plain(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_plain(entry)}" for name, entry in value.items())
    return value if isinstance(value, str) else json.dumps(value)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def log_rollouts(
    recording: rr.RecordingStream,
    rollouts: Sequence[Rollout],
    *,
    prefix: str = "",
    times: Mapping[str, Time] | None = None,
    always_named: bool = False,
    with_layout: bool = True,
    progress: Callable[[], Any] = lambda: None,
) -> None:
    """Add rollouts to a recording, after all of them have been read.

    Args:
        recording: where to.
        rollouts: as read by `avp_habitat.rollout.format.read_rollout`. Several lie under their folders' names, sharing
            at most 400 pictures; one has at most 100.
        prefix: entity path above them.
        times: further time lines, each with the one value that it has for all of the rollouts.
        always_named: one rollout lies under its folder's name too.
        with_layout: give the recording its name and layout.
        progress: called after each picture.

    Raises:
        RolloutError: a rollout is damaged; nothing has been added.
    """
    names = _unique_names([rollout.folder.resolve().name for rollout in rollouts])
    above = f"/{prefix.strip('/')}".rstrip("/")
    roots = [f"{above}/{rr.escape_entity_path_part(name)}" for name in names]
    if len(rollouts) == 1 and not always_named:
        roots = [above]
    pictures = _pictures_of_each(rollouts)
    contents = [read_contents(rollout, pictures=pictures, progress=progress) for rollout in rollouts]
    if with_layout:
        with_map = any(each.map is not None for each in contents)
        # A default that arrives after the first data is too late: the viewer has made up a layout of its own by then.
        layout = rollout_blueprint(dict(zip(roots, names, strict=True)), with_map=with_map)
        recording.send_blueprint(layout, make_active=True, make_default=True)
        recording.send_recording_name(", ".join(names))
    for index, (root, name, each) in enumerate(zip(roots, names, contents, strict=True)):
        _log_rollout(recording, root, each, {"episode": 0, "env_step": 0, **(times or {})})
        if len(roots) > 1:
            curve = rr.SeriesLines(names=[name], colors=[_COLOURS[index % len(_COLOURS)]])
            recording.log(f"{root}/plots/coverage", curve, static=True)


def _log_rollout(
    recording: rr.RecordingStream, root: str, contents: RolloutContents, times: Mapping[str, Time]
) -> None:
    log_episode(recording, root, contents.episode, times=times)
    log_room(recording, f"{root}/world/room", contents.room)
    if contents.map is not None:
        recording.log(f"{root}/map", rr.EncodedImage(contents=contents.map, media_type="image/png"), static=True)
    about = rr.TextDocument(contents.about, media_type=rr.MediaType.MARKDOWN)
    recording.log(f"{root}/about", about, static=True)
    last = max(len(contents.episode.camera_to_world) - 1, 0)
    for name, value in contents.metrics.items():
        log_at(recording, metric_path(root, name), rr.Scalars(value), {"step": last, **times})


def write_rollout_recording(folders: Sequence[str | Path], target: str | Path, *, progress: bool = False) -> Path:
    """Write one `.rrd` file with each rollout under its folder's name; the file appears when it is whole.

    Args:
        folders: rollout folders.
        target: the file to make.
        progress: show a progress bar.

    Raises:
        UsageError: the target exists, or no folder is given.
        RolloutError: a rollout is damaged, or the target cannot be written.
    """
    if not folders:
        raise UsageError("expected at least one rollout folder, got none")
    check_new(Path(target))
    rollouts = [read_rollout(folder) for folder in folders]
    recording = rr.RecordingStream(APPLICATION)
    stream = recording.binary_stream()
    total = sum(min(len(rollout.frames), _pictures_of_each(rollouts)) for rollout in rollouts)
    with progress_bar(total=total, unit="picture", desc=f"recording {target}", disable=not progress) as bar:
        log_rollouts(recording, rollouts, always_named=True, progress=bar.update)
    with atomic_file(target, replace=False, failure=RolloutError) as partial:
        partial.write_bytes(stream.read(flush_timeout_sec=_FLUSH_S) or b"")
    return Path(target)


def _pictures_of_each(rollouts: Sequence[Rollout]) -> int:
    return max(1, min(_PICTURES, _MOST_PICTURES // len(rollouts)))


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
