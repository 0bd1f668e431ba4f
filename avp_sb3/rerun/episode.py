"""An episode as a Rerun recording shows it: scene, floor, path, views, pictures and figures by time."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from PIL import Image

from avp_habitat.poses import Intrinsics
from avp_habitat.rollout import images
from avp_habitat.rollout.images import GREY_16

if TYPE_CHECKING:
    from avp_habitat.navigation.area import NavigableArea
    from avp_habitat.task.trajectory import Trajectory

_UNSEEN_COLOUR, _SEEN_COLOUR = 0xAEB4C0FF, 0x35B779FF
_PATH_COLOUR, _VIEW_COLOUR, _AGENT_COLOUR = (178, 34, 52), (228, 120, 51, 120), (40, 40, 44)
_PLOT_COLOURS = [0x35B779FF, 0x8C7AE6FF, 0x95A5A6FF, 0xE15759FF, 0x4E79A7FF]
_PLOT_COLOURS += [0xF28E2BFF, 0x76B7B2FF, 0xEDC948FF, 0xB07AA1FF]
_CELL_CHANGES = 200_000
_PYRAMID_M = 0.15
_PATH_LIFT_M = 0.02
_JPEG_QUALITY = 80


@dataclass(frozen=True)
class EncodedView:
    """A picture and its depth, compressed."""

    rgb: bytes
    """JPEG file."""
    depth: bytes
    """16-bit PNG file, planar depth in millimetres, 0 = none."""


@dataclass(frozen=True)
class RecordedEpisode:
    """What a recording shows of t steps."""

    camera_to_world: NDArray[np.floating]
    """`(t, 4, 4)` sensor poses, habitat axes, metres."""
    path: NDArray[np.floating]
    """`(p, 3)` the way on the floor, metres, world frame."""
    intrinsics: Intrinsics
    """Of the pictures."""
    views: Mapping[int, EncodedView]
    """Pictures by step, from 0."""
    plots: Mapping[str, NDArray[np.number]]
    """`(t,)` figures by name."""
    cells: NDArray[np.floating] = field(default_factory=lambda: np.empty((0, 3)))
    """`(m, 3)` floor points of the navigable cells, metres; none when unknown."""
    first_seen: NDArray[np.integer] = field(default_factory=lambda: np.empty(0, dtype=np.int16))
    """`(m,)` step (from 1) whose view first observed each cell; 0 for never."""
    cell_m: float = 0.1
    """Side of a cell in metres."""


def episode_of(
    trajectory: "Trajectory", area: "NavigableArea | None", intrinsics: Intrinsics, views: Mapping[int, EncodedView]
) -> RecordedEpisode:
    """The episode of an environment; without its area no floor is shown."""
    parts = {f"reward/{name}": values for name, values in trajectory.reward_parts.items()}
    floor: dict[str, Any] = {}
    if area is not None:
        floor = {"cells": np.asarray(area.centres), "first_seen": trajectory.first_seen, "cell_m": area.cell_m}
    return RecordedEpisode(
        camera_to_world=trajectory.camera_to_world,
        path=np.concatenate([trajectory.start[None], trajectory.position]),
        intrinsics=intrinsics,
        views=views,
        plots={"coverage": trajectory.coverage, "action": trajectory.action, "reward/sum": trajectory.reward, **parts},
        **floor,
    )


def encode_view(rgb: NDArray[np.uint8], depth: NDArray[np.floating]) -> EncodedView:
    """Compress a `(h, w, 3)` picture, and its `(h, w)` planar depth in metres."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, format="JPEG", quality=_JPEG_QUALITY)
    return EncodedView(buffer.getvalue(), images.encode_png(images.encode_depth(depth), GREY_16))


def spread_indices(count: int, at_most: int) -> list[int]:
    """At most `at_most` of the indices 0 … count - 1, evenly spread, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, at_most)).round().astype(int)).tolist() if count else []


def log_episode(
    recording: rr.RecordingStream,
    root: str,
    episode: RecordedEpisode,
    *,
    times: Mapping[str, int],
    first_step: int = 0,
    with_scene: bool = True,
) -> None:
    """Add an episode to a recording, below the entity path `root`.

    `times` are the numbers that further time lines have throughout; on the time line `step` it begins at `first_step`.
    `with_scene` adds what holds at all times (axes, cells, camera, looks); once per root is enough.
    """
    steps = len(episode.camera_to_world)
    if not steps:
        return
    if with_scene:
        _log_scene(recording, root, episode)
    world = f"{root}/world"
    start, columns = {**times, "step": first_step}, _time_columns(range(first_step, first_step + steps), times)
    lifted = np.asarray(episode.path) + np.array([0, _PATH_LIFT_M, 0])
    log_at(recording, f"{world}/path", rr.LineStrips3D([lifted], colors=[_PATH_COLOUR], radii=[0.015]), start)
    views = rr.LineStrips3D(_pyramids(episode), colors=[_VIEW_COLOUR], radii=[0.003])
    log_at(recording, f"{world}/views", views, start)
    recording.send_columns(f"{world}/agent", columns, _transforms(episode.camera_to_world))
    for name, values in episode.plots.items():
        scalars = rr.Scalars.columns(scalars=np.asarray(values, dtype=np.float64))
        recording.send_columns(_plot_path(root, name), columns, scalars)
    if len(episode.cells):
        changes, colours = _floor_changes(episode)
        at = _time_columns([first_step + step for step in changes], times)
        recording.send_columns(f"{world}/floor", at, colours)
    if episode.views:
        at = _time_columns([first_step + step for step in sorted(episode.views)], times)
        _send_views(recording, f"{world}/camera", episode, at)


def log_at(recording: rr.RecordingStream, path: str, value: Any, times: Mapping[str, int]) -> None:
    """Add a value at one place on several time lines."""
    for name, time in times.items():
        recording.set_time(name, sequence=time)
    recording.log(path, value)
    recording.reset_time()


def _time_columns(steps: Sequence[int], times: Mapping[str, int]) -> list[rr.TimeColumn]:
    """The time line `step`, and others that have the same value at all of these steps."""
    lines = {"step": steps} | {name: [time] * len(steps) for name, time in times.items()}
    return [rr.TimeColumn(name, sequence=values) for name, values in lines.items()]


def metric_path(root: str, name: str) -> str:
    """The entity of an episode's figure; `return_NAME` is shown as `return/NAME`."""
    group = "return/" if name.startswith("return_") else ""
    return f"{root}/metrics/{group}{rr.escape_entity_path_part(name.removeprefix('return_'))}"


def _plot_path(root: str, name: str) -> str:
    """The entity of a step's figure, whose name may have signs that Rerun would not take as they are."""
    return "/".join([root, "plots", *map(rr.escape_entity_path_part, name.split("/"))])


def _log_scene(recording: rr.RecordingStream, root: str, episode: RecordedEpisode) -> None:
    """What holds at all times."""
    world = f"{root}/world"
    recording.log(world, rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
    recording.log(f"{world}/agent", _pinhole(episode.intrinsics, colour=_AGENT_COLOUR), static=True)
    if episode.views:
        recording.log(f"{world}/camera", _pinhole(episode.intrinsics), static=True)
    if len(episode.cells):
        recording.log(f"{world}/floor", rr.Points3D(episode.cells, radii=[0.45 * episode.cell_m]), static=True)
    for index, name in enumerate(episode.plots):
        colour = _PLOT_COLOURS[index % len(_PLOT_COLOURS)]
        dots = rr.SeriesPoints(colors=[colour], marker_sizes=[2])
        looks = dots if name == "action" else rr.SeriesLines(colors=[colour])
        recording.log(_plot_path(root, name), looks, static=True)


def _floor_changes(episode: RecordedEpisode) -> tuple[list[int], rr.ComponentColumnList]:
    """The cells' colours at each step (from 0) that observed new ones; at fewer steps on large floors."""
    cells, seen = len(episode.cells), np.asarray(episode.first_seen)
    changes = [0, *sorted({int(step) - 1 for step in seen[seen > 0]} - {0})]
    changes = [changes[index] for index in spread_indices(len(changes), max(2, _CELL_CHANGES // cells))]
    observed = np.stack([(seen > 0) & (seen <= step + 1) for step in changes])
    colours = np.where(observed, np.uint32(_SEEN_COLOUR), np.uint32(_UNSEEN_COLOUR))
    return changes, rr.Points3D.columns(colors=colours.ravel()).partition([cells] * len(changes))


def _send_views(recording: rr.RecordingStream, path: str, episode: RecordedEpisode, times: list[rr.TimeColumn]) -> None:
    """The pictures, and where their camera stood."""
    steps = sorted(episode.views)
    views = [episode.views[step] for step in steps]
    recording.send_columns(path, times, _transforms(episode.camera_to_world[steps]))
    colour = rr.EncodedImage.columns(blob=[view.rgb for view in views], media_type=["image/jpeg"] * len(views))
    recording.send_columns(f"{path}/rgb", times, colour)
    depth = rr.EncodedDepthImage.columns(
        blob=[view.depth for view in views],
        media_type=["image/png"] * len(views),
        meter=[1 / images.DEPTH_UNIT_M] * len(views),
    )
    recording.send_columns(f"{path}/depth", times, depth)


def _transforms(poses: NDArray[np.floating]) -> rr.ComponentColumnList:
    """`(n, 4, 4)` poses, one per time."""
    return rr.Transform3D.columns(translation=poses[:, :3, 3], mat3x3=poses[:, :3, :3])


def _pinhole(intrinsics: Intrinsics, colour: tuple[int, int, int] | None = None) -> rr.Pinhole:
    """The camera with habitat axes: x right, y up, looking along -z."""
    return rr.Pinhole(
        image_from_camera=intrinsics.matrix,
        resolution=[intrinsics.width, intrinsics.height],
        camera_xyz=rr.ViewCoordinates.RUB,
        image_plane_distance=2 * _PYRAMID_M,
        color=colour,
    )


def _pyramids(episode: RecordedEpisode) -> NDArray[np.floating]:
    """`(t, 11, 3)` one line strip per viewpoint: the image's border and its edges to the camera centre."""
    camera = episode.intrinsics
    left, right = -camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = camera.cy / camera.fy, -(camera.height - camera.cy) / camera.fy
    a, b, c, d, o = [left, top, -1], [right, top, -1], [right, bottom, -1], [left, bottom, -1], [0, 0, 0]
    strip = _PYRAMID_M * np.array([o, a, b, o, c, d, o, a, d, c, b])
    poses = episode.camera_to_world
    return np.einsum("nij,sj->nsi", poses[:, :3, :3], strip) + poses[:, None, :3, 3]
