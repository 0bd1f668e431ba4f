"""The folder that a check leaves: never inside the rollout, never over files of somebody else."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.files import atomic_file
from avp_habitat.poses import Intrinsics, pixel_directions
from avp_habitat.provenance import installed_versions
from avp_habitat.rollout.format import Rollout
from avp_habitat.rollout.images import read_rgb
from avp_nerfstudio.check import Verdict
from avp_nerfstudio.check.agreement import Cameras
from avp_nerfstudio.check.geometry import Geometry

Float = NDArray[np.floating]

FORMAT = "avp-check"
REPORT, PICTURE, CLOUD, RECORDING = "check.json", "overview.png", "cloud.ply", "check.rrd"
BAD_COLOUR, GOOD_COLOUR = (255, 48, 48), (64, 160, 255)
"""Of frames that disagree, and of all others."""
_FRUSTUM_M = 0.2
_VERSIONED = ("avp-suite", "numpy", "open3d", "pycolmap", "rerun-sdk", "matplotlib")
_FRAMES, _POINTS_OF_A_FRAME = 400, 2400
_PICTURES, _PICTURE_WIDTH = 200, 320
_ABOVE_CAMERAS_M = 0.3
_MOST_POINTS = 150_000
_OUTLIERS = 0.5
_GROUND = "#f4f4f2"
_POINT = 4.0
"""Area of a point, square typographic points: so large that surfaces close and hide what lies behind them."""


class Cloud(NamedTuple):
    """Coloured points."""

    points: Float
    """`(m, 3)` metres, world frame."""
    colours: NDArray[np.uint8]
    """`(m, 3)` as photographed; those of frames that disagree are red."""


def fuse(rollout: Rollout, geometry: Geometry) -> Cloud:
    """Back-project some points of every frame; of more than 400 frames, of those that are spread evenly."""
    maps, cameras, bad = geometry.maps, geometry.cameras, geometry.bad
    views = rollout.frames + rollout.heldout
    parts = []
    for frame in np.union1d(_spread(len(views), _FRAMES), np.flatnonzero(bad)[:_FRAMES]):
        points, _ = maps.surface(int(frame), cameras.poses[frame], cameras.intrinsics, _POINTS_OF_A_FRAME)
        picture = read_rgb(views[frame].image)[:: maps.stride, :: maps.stride].reshape(-1, 3)
        colours = picture[maps.samples[frame, : len(points)]]
        parts.append((points, np.full_like(colours, BAD_COLOUR) if bad[frame] else colours))
    return Cloud(*map(np.concatenate, zip(*parts, strict=True)))


def _spread(count: int, most: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def frusta(cameras: Cameras) -> Float:
    """`(n, 11, 3)` one line per camera that draws its pyramid of view, metres, world frame."""
    k = cameras.intrinsics
    # A camera of 2x2 pixels whose centres are the corners of the picture.
    corners = Intrinsics(2, 2, k.fx / k.width, k.fy / k.height, k.cx / k.width + 0.5, k.cy / k.height + 0.5)
    tip_and_corners = np.concatenate([np.zeros((1, 3)), _FRUSTUM_M * pixel_directions(corners).reshape(4, 3)])
    line = tip_and_corners[[0, 1, 2, 0, 4, 3, 0, 1, 3, 4, 2]]
    return np.einsum("nij,kj->nki", cameras.poses[:, :3, :3], line) + cameras.poses[:, None, :3, 3]


def _frustum_colours(bad: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.where(bad[:, None], BAD_COLOUR, GOOD_COLOUR).astype(np.uint8)


def write_ply(path: Path, cloud: Cloud) -> None:
    """Write the cloud as binary PLY with Open3D.

    Raises:
        OSError: it could not be written.
    """
    import open3d as o3d

    written = o3d.geometry.PointCloud()
    written.points = o3d.utility.Vector3dVector(cloud.points)
    written.colors = o3d.utility.Vector3dVector(cloud.colours / 255)
    if not o3d.io.write_point_cloud(str(path), written):  # pyright: ignore[reportArgumentType]
        raise OSError(f"Open3D could not write {path.name}")


def draw_overview(path: Path, cloud: Cloud, geometry: Geometry, verdicts: list[Verdict]) -> None:
    """Draw the cloud and the cameras, as pyramids, from above and from the side; write it as PNG."""
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    cameras, bad = geometry.cameras, geometry.bad
    kept = np.random.default_rng(0).permutation(len(cloud.points))[:_MOST_POINTS]
    points, colours = cloud.points[kept], cloud.colours[kept] / 255
    centres = cameras.poses[:, :3, 3]
    # A ceiling would hide the room.
    below = points[:, 1] < centres[:, 1].max() + _ABOVE_CAMERAS_M
    behind = points[:, 2] < np.median(centres[:, 2])
    lines, line_colours = frusta(cameras), _frustum_colours(bad) / 255
    figure = Figure(figsize=(14, 6.5), layout="constrained")
    for place, down, towards, chosen, title in (
        (1, 2, 1, below, "from above, without the ceiling"),
        (2, 1, 2, behind, "from the side, without the nearer half"),
    ):
        axes = figure.add_subplot(1, 2, place, facecolor=_GROUND)
        order = np.flatnonzero(chosen)[np.argsort(points[chosen, towards])]
        axes.scatter(points[order, 0], points[order, down], s=_POINT, c=colours[order], linewidths=0, rasterized=True)
        axes.add_collection(LineCollection(list(lines[:, :, [0, down]]), colors=line_colours, linewidths=0.6))
        # Without the few points that fly far away when poses are wrong.
        shown = np.concatenate([points[chosen], centres])[:, [0, down]]
        low, high = np.percentile(shown, [_OUTLIERS, 100 - _OUTLIERS], axis=0)
        (left, bottom), (right, top) = low - 0.08 * (high - low) - 0.1, high + 0.08 * (high - low) + 0.1
        axes.set(xlim=(left, right), ylim=(bottom, top), xlabel="x [m]", ylabel=f"{'xyz'[down]} [m]", title=title)
        axes.set_aspect("equal")
        if down == 2:  # as on a map
            axes.invert_yaxis()
    failed = [verdict.name for verdict in verdicts if not verdict.passed]
    good, wrong = f"{(~bad).sum()} cameras agree (blue)", f"{bad.sum()} disagree (red)"
    figure.suptitle(f"{'FAILED: ' + ', '.join(failed) if failed else 'all checks passed'}; {good}, {wrong}")
    figure.savefig(path, format="png", dpi=110)


def write_recording(path: Path, rollout: Rollout, cloud: Cloud, geometry: Geometry) -> None:
    """Write an `.rrd` file.

    Entities: `world/cloud`, `world/frusta` (red where a frame disagrees), and on the time line `frame` the
    `world/camera` with its picture; of more than 200 frames, of those that are spread evenly.

    Raises:
        OSError: it cannot be written.
    """
    path.touch()  # Rerun's own error for an unwritable path has neither the path nor an errno.
    cameras, views = geometry.cameras, rollout.frames + rollout.heldout
    recording = rr.RecordingStream(FORMAT)
    recording.save(path, default_blueprint=_blueprint())
    try:
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        recording.log("world/cloud", rr.Points3D(cloud.points, colors=cloud.colours, radii=[0.008]), static=True)
        lines = rr.LineStrips3D(list(frusta(cameras)), colors=_frustum_colours(geometry.bad), radii=[0.004])
        recording.log("world/frusta", lines, static=True)
        for frame in _spread(len(views), _PICTURES):
            recording.set_time("frame", sequence=int(frame))
            _log_camera(recording, cameras.poses[frame], cameras.intrinsics, views[frame].image)
    finally:
        recording.disconnect()


def _log_camera(recording: rr.RecordingStream, pose: Float, intrinsics: Intrinsics, image: Path) -> None:
    stride = max(1, round(intrinsics.width / _PICTURE_WIDTH))
    picture = np.ascontiguousarray(read_rgb(image)[::stride, ::stride])
    pinhole = rr.Pinhole(
        image_from_camera=np.diag([1 / stride, 1 / stride, 1.0]) @ intrinsics.matrix,
        resolution=[picture.shape[1], picture.shape[0]],
        camera_xyz=rr.ViewCoordinates.RUB,
        image_plane_distance=0.3,
    )
    recording.log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
    recording.log("world/camera/picture", pinhole, rr.Image(picture).compress(jpeg_quality=80))


def _blueprint() -> rrb.Blueprint:
    scene = rrb.Spatial3DView(origin="world", name="fused cloud and cameras")
    picture = rrb.Spatial2DView(origin="world/camera/picture", name="picture")
    return rrb.Blueprint(
        rrb.Horizontal(scene, picture, column_shares=[3, 2]), rrb.TimePanel(timeline="frame"), collapse_panels=True
    )


def choose_folder(rollout: Path, out: Path | None) -> Path:
    """Where the results go: `ROLLOUT-check` beside the rollout by default.

    Raises:
        UsageError: it lies inside the rollout, or holds files but no results of a check.
    """
    rollout = rollout.resolve()
    folder = rollout.with_name(f"{rollout.name}-check") if out is None else out
    if folder.resolve().is_relative_to(rollout):
        raise UsageError(f"--out {folder}: expected a folder outside the rollout, which stays as it is")
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--out {folder}: expected a folder, found a file")
    if folder.is_dir() and any(folder.iterdir()) and not _is_ours(folder / REPORT):
        raise UsageError(f"--out {folder}: holds other files and no {REPORT} of a check; choose another name")
    return folder


def _is_ours(path: Path) -> bool:
    try:
        return json.loads(path.read_text(encoding="utf-8")).get("format") == FORMAT
    except (OSError, ValueError, AttributeError):
        return False


def write_outputs(
    folder: Path, rollout: Path, verdicts: list[Verdict], files: dict[str, Callable[[Path], None]]
) -> None:
    """Write the report and the files; each appears when it is whole and replaces that of an earlier check.

    Args:
        folder: from `choose_folder`.
        rollout: which was checked.
        verdicts: what was found.
        files: by name, what writes them; those of an earlier check that are not among them are removed.

    Raises:
        RolloutError: the folder cannot be written.
    """
    try:
        for name in {PICTURE, CLOUD, RECORDING} - files.keys():
            (folder / name).unlink(missing_ok=True)
        for name, write in (files | {REPORT: lambda path: _write_report(path, rollout, verdicts)}).items():
            with atomic_file(folder / name) as partial:
                write(partial)
    except OSError as error:
        raise RolloutError(f"--out {folder}: cannot write there: {error.strerror or error}") from None


def _write_report(path: Path, rollout: Path, verdicts: list[Verdict]) -> None:
    report = {
        "format": FORMAT,
        "format_version": 1,
        "rollout": rollout.resolve().name,
        "passed": all(verdict.passed for verdict in verdicts),
        "verdicts": [asdict(verdict) | {"figures": _finite(verdict.figures)} for verdict in verdicts],
        "versions": installed_versions(_VERSIONED),
    }
    path.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _finite(figures: dict[str, float]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}


def outputs_of(rollout: Rollout, geometry: Geometry, verdicts: list[Verdict]) -> dict[str, Callable[[Path], None]]:
    """What writes the picture, the cloud and the recording."""
    cloud = fuse(rollout, geometry)
    return {
        PICTURE: lambda path: draw_overview(path, cloud, geometry, verdicts),
        CLOUD: lambda path: write_ply(path, cloud),
        RECORDING: lambda path: write_recording(path, rollout, cloud, geometry),
    }
