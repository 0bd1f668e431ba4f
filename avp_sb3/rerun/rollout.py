"""Rollouts as one Rerun recording, with every fault of them found before anything is written."""

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

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
from avp_sb3.rerun.episode import RecordedEpisode, encode_view, log_at, log_episode, metric_path, spread_indices
from avp_sb3.rerun.layout import rollout_blueprint
from avp_sb3.rerun.room import Cloud, log_room, room_points

_PICTURES, _MOST_PICTURES = 100, 400
_LONGEST_PX = 640
_FLUSH_S = 60
# Of the rollouts' curves in one plot; they can be told apart by the colour-blind too.
_COLOURS = ((0, 114, 178), (230, 159, 0), (0, 158, 115), (213, 94, 0), (204, 121, 167), (86, 180, 233))


@dataclass(frozen=True)
class RolloutContents:
    """What a recording shows of a rollout besides its `rollout.json`."""

    episode: RecordedEpisode
    """Its steps and pictures."""
    room: Cloud
    """Out of the pictures."""
    map: bytes | None
    """`trajectory.png`; None where the rollout was written without it."""


def read_contents(rollout: Rollout, *, pictures: int = _PICTURES) -> RolloutContents:
    """Read the tables of a rollout, and the pictures (subsampled to 640 pixels) of some views, spread over it.

    Raises:
        RolloutError: a file is missing or unreadable, or `steps.csv` is not one row of finite numbers per frame.
    """
    plots, feet = read_steps(rollout.folder / "steps.csv", len(rollout.frames))
    width, height = rollout.intrinsics.width, rollout.intrinsics.height
    stride = min(-(-max(width, height) // _LONGEST_PX), width, height)
    # An incomplete block at the border is dropped.
    focal_and_centre = {name: getattr(rollout.intrinsics, name) / stride for name in ("fx", "fy", "cx", "cy")}
    camera = Intrinsics(width=width // stride, height=height // stride, **focal_and_centre)
    chosen = spread_indices(len(rollout.frames), pictures)
    views = {}

    def frames() -> Iterator[tuple[NDArray[np.uint8], NDArray[np.floating]]]:
        for step in chosen:
            rgb, depth = _read_view(rollout.frames[step], camera, stride)
            views[step] = encode_view(rgb, depth)
            yield rgb, depth

    poses = np.array([view.camera_to_world for view in rollout.frames]).reshape(-1, 4, 4)
    room = room_points(frames(), camera, poses[chosen])
    picture = rollout.folder / "trajectory.png"
    if drawn := picture.exists():
        images.read_rgb(picture)
    episode = RecordedEpisode(poses, feet, camera, views, plots)
    return RolloutContents(episode, room, picture.read_bytes() if drawn else None)


def read_steps(path: Path, frames: int) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.float64]]:
    """Read a `steps.csv`, which must have `frames` rows.

    Returns:
        `(t,)` figures of the steps, named as those of a training's episodes, and `(t, 3)` where the agent stood after
        each step, metres, world frame.

    Raises:
        RolloutError: the table is missing, unreadable, ragged, has another number of rows, lacks a column, or holds an
            action that no agent has or something else that is no finite number.
    """
    columns = _read_columns(path, frames)
    names = {"action": "action", "coverage": "coverage", "reward/sum": "reward"}
    names |= {f"reward/{name.removeprefix('reward_')}": name for name in columns if name.startswith("reward_")}
    plots = {plot: _numbers(path, columns, name) for plot, name in names.items()}
    return plots, np.stack([_numbers(path, columns, name) for name in ("x_m", "y_m", "z_m")], axis=-1)


def _read_columns(path: Path, frames: int) -> dict[str, list[str]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            names, *rows = list(csv.reader(file)) or [[]]
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
    is_action = name == "action"
    expected = f"actions out of {', '.join(ACTION_NAMES)}" if is_action else "finite numbers"
    values = np.full(len(columns[name]), np.nan)
    for row, word in enumerate(columns[name]):
        with suppress(ValueError):
            values[row] = ACTION_NAMES.index(word) if is_action else float(word)
        if not np.isfinite(values[row]):
            raise RolloutError(f"{path}: expected {expected} in column {name!r}, found {word!r} in row {row + 1}")
    return values


def _read_view(view: View, camera: Intrinsics, stride: int) -> tuple[NDArray[np.uint8], NDArray[np.floating]]:
    """Picture and depth in metres."""
    height, width = camera.height * stride, camera.width * stride
    rgb = np.asarray(Image.fromarray(images.read_rgb(view.image)[:height, :width]).reduce(stride))
    # Depth is picked, not averaged: a mean of two surfaces is none.
    depth = images.read_depth(view.depth)[stride // 2 : height : stride, stride // 2 : width : stride]
    return rgb, np.ascontiguousarray(depth)


def _about(rollout: Rollout) -> str:
    """The figures as a table, and what `rollout.json` says of where the rollout comes from."""
    facts = {name: value for name, value in rollout.meta.items() if name not in ("metrics", "pose_convention")}
    lines = [f"# {rollout.folder.resolve().name}", "", "| metric | value |", "|---|---|"]
    lines += [f"| {name} | {value:.6g} |" for name, value in rollout.meta.get("metrics", {}).items()]
    return "\n".join([*lines, "", "```json", json.dumps(facts, indent=2, ensure_ascii=False), "```", ""])


def log_rollouts(
    recording: rr.RecordingStream,
    rollouts: Sequence[Rollout],
    *,
    prefix: str = "",
    always_named: bool = False,
    with_layout: bool = True,
    progress: bool = False,
) -> None:
    """Add rollouts to a recording, after all of them have been read; `with_layout` also gives it its name and layout.

    Below the entity path `prefix` several rollouts (or one that is `always_named`) lie under their folders' names,
    sharing at most 400 pictures; one has at most 100.

    Raises:
        RolloutError: a rollout is damaged; nothing has been added.
    """
    names = [rollout.folder.resolve().name for rollout in rollouts]
    earlier = [names[:index].count(name) for index, name in enumerate(names)]
    names = [f"{name}-{count + 1}" if count else name for name, count in zip(names, earlier, strict=True)]
    above = f"/{prefix.strip('/')}".rstrip("/")
    roots = [f"{above}/{rr.escape_entity_path_part(name)}" for name in names]
    if len(rollouts) == 1 and not always_named:
        roots = [above]
    pictures = max(1, min(_PICTURES, _MOST_PICTURES // len(rollouts)))
    bar = progress_bar(rollouts, unit="rollout", desc="reading", disable=not progress)
    contents = [read_contents(rollout, pictures=pictures) for rollout in bar]
    if with_layout:
        with_map = any(each.map is not None for each in contents)
        # A default that arrives after the first data is too late: the viewer has made up a layout of its own by then.
        layout = rollout_blueprint(dict(zip(roots, names, strict=True)), with_map=with_map)
        recording.send_blueprint(layout, make_active=True, make_default=True)
        recording.send_recording_name(", ".join(names))
    for index, (root, rollout, each) in enumerate(zip(roots, rollouts, contents, strict=True)):
        _log_rollout(recording, root, rollout, each)
        if len(roots) > 1:
            curve = rr.SeriesLines(names=[names[index]], colors=[_COLOURS[index % len(_COLOURS)]])
            recording.log(f"{root}/plots/coverage", curve, static=True)


def _log_rollout(recording: rr.RecordingStream, root: str, rollout: Rollout, contents: RolloutContents) -> None:
    times = {"episode": 0, "env_step": 0}
    log_episode(recording, root, contents.episode, times=times)
    log_room(recording, f"{root}/world/room", contents.room)
    if contents.map is not None:
        recording.log(f"{root}/map", rr.EncodedImage(contents=contents.map, media_type="image/png"), static=True)
    about = rr.TextDocument(_about(rollout), media_type=rr.MediaType.MARKDOWN)
    recording.log(f"{root}/about", about, static=True)
    times["step"] = max(len(rollout.frames) - 1, 0)
    for name, value in rollout.meta.get("metrics", {}).items():
        log_at(recording, metric_path(root, name), rr.Scalars(value), times)


def write_rollout_recording(folders: Sequence[str | Path], target: str | Path, *, progress: bool = False) -> Path:
    """Write one `.rrd` file with each rollout under its folder's name; the file appears when it is whole.

    Raises:
        UsageError: the target exists, or no folder is given.
        RolloutError: a rollout is damaged, or the target cannot be written.
    """
    if not folders:
        raise UsageError("expected at least one rollout folder, got none")
    check_new(Path(target))
    recording = rr.RecordingStream(APPLICATION)
    rollouts = [read_rollout(folder) for folder in folders]
    log_rollouts(recording, rollouts, always_named=True, progress=progress)
    with atomic_file(target, replace=False, failure=RolloutError) as partial:
        partial.write_bytes(recording.binary_stream().read(flush_timeout_sec=_FLUSH_S) or b"")
    return Path(target)
