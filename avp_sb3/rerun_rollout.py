"""A rollout folder read for a Rerun recording, with every fault found before anything is written."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from avp_habitat import images
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout import Rollout, View
from avp_sb3.rerun_episode import EncodedView, Episode, encode_jpeg, encode_view, spread_indices
from avp_sb3.rerun_room import room_points
from avp_sb3.rerun_steps import Steps

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
        rollout: as read by `avp_habitat.rollout.read_rollout`.
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
