"""The folder that a check leaves: never inside the rollout, never over files of somebody else."""

import io
import json
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from PIL import Image

from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.files import atomic_file
from avp_habitat.provenance import installed_versions
from avp_habitat.rollout.format import Rollout
from avp_nerfstudio.check.cloud import Cloud, frusta, frustum_colours, fuse, write_ply
from avp_nerfstudio.check.hypotheses import Cameras
from avp_nerfstudio.check.verdict import Verdict

FORMAT = "avp-check"
REPORT, PICTURE, CLOUD, RECORDING = "check.json", "overview.png", "cloud.ply", "check.rrd"
_VERSIONED = ("avp-suite", "numpy", "open3d", "pycolmap", "rerun-sdk", "matplotlib")
_PICTURES = 200
_PICTURE_WIDTH = 320
_ABOVE_CAMERAS_M = 0.3
_MOST_POINTS = 150_000
_OUTLIERS = 0.5
_GROUND = "#f4f4f2"
_POINT = 4.0
"""Area of a point, square typographic points: so large that surfaces close and hide what lies behind them."""


def draw_overview(path: Path, cloud: Cloud, cameras: Cameras, bad: NDArray[np.bool_], verdicts: list[Verdict]) -> None:
    """Write the picture as PNG.

    Args:
        path: the file.
        cloud: of the frames.
        cameras: drawn as pyramids.
        bad: `(n,)` those drawn red.
        verdicts: named in the title.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    kept = np.random.default_rng(0).permutation(len(cloud.points))[:_MOST_POINTS]
    points, colours = cloud.points[kept], cloud.colours[kept] / 255
    centres = cameras.poses[:, :3, 3]
    # A ceiling would hide the room.
    below = points[:, 1] < centres[:, 1].max() + _ABOVE_CAMERAS_M
    lines, line_colours = frusta(cameras), frustum_colours(bad) / 255
    figure = Figure(figsize=(14, 6.5), layout="constrained")
    behind = points[:, 2] < np.median(centres[:, 2])
    for axes, (across, along), towards, chosen, title in (
        (*_pair(figure, 0), 1, below, "from above, without the ceiling"),
        (*_pair(figure, 1), 2, behind, "from the side, without the nearer half"),
    ):
        order = np.flatnonzero(chosen)[np.argsort(points[chosen, towards])]
        axes.scatter(
            points[order, across], points[order, along], s=_POINT, c=colours[order], linewidths=0, rasterized=True
        )
        axes.add_collection(LineCollection(list(lines[:, :, [across, along]]), colors=line_colours, linewidths=0.6))
        axes.set_aspect("equal")
        axes.set_xlabel(f"{'xyz'[across]} [m]")
        axes.set_ylabel(f"{'xyz'[along]} [m]")
        _limit(axes, np.concatenate([points[chosen], centres]), across, along)
        axes.set_title(title)
    failed = [verdict.name for verdict in verdicts if not verdict.passed]
    good, wrong = f"{(~bad).sum()} cameras agree (blue)", f"{bad.sum()} disagree (red)"
    figure.suptitle(f"{'FAILED: ' + ', '.join(failed) if failed else 'all checks passed'}; {good}, {wrong}")
    figure.savefig(path, format="png", dpi=110)


def _pair(figure, column: int):
    """The axes of a view and the two coordinates it shows; from above z points down, as on a map."""
    axes = figure.add_subplot(1, 2, column + 1, facecolor=_GROUND)
    if column == 0:
        axes.invert_yaxis()
    return axes, ((0, 2), (0, 1))[column]


def _limit(axes, points: NDArray[np.floating], across: int, along: int) -> None:
    """Leave out the few points that fly far away when poses are wrong."""
    for axis, setter in ((across, axes.set_xlim), (along, axes.set_ylim)):
        low, high = np.percentile(points[:, axis], [_OUTLIERS, 100 - _OUTLIERS])
        margin = 0.08 * (high - low) + 0.1
        limits = (low - margin, high + margin)
        setter(limits[::-1] if axis == 2 else limits)


def write_recording(path: Path, rollout: Rollout, cloud: Cloud, cameras: Cameras, bad: NDArray[np.bool_]) -> None:
    """Write an `.rrd` file.

    Entities: `world/cloud`, `world/frusta` (red where a frame disagrees), and on the time line `frame` the
    `world/camera` with its picture; of more than 200 frames, of those that are spread evenly.

    Args:
        path: the file.
        rollout: for the pictures.
        cloud: of the frames.
        cameras: of the frames.
        bad: `(n,)` those drawn red.

    Raises:
        OSError: it cannot be written.
    """
    path.touch()  # Rerun's own error for an unwritable path has neither the path nor an errno.
    recording = rr.RecordingStream(FORMAT)
    recording.save(path, default_blueprint=_blueprint())
    try:
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        recording.log("world/cloud", rr.Points3D(cloud.points, colors=cloud.colours, radii=[0.008]), static=True)
        lines = rr.LineStrips3D(list(frusta(cameras)), colors=frustum_colours(bad), radii=[0.004])
        recording.log("world/frusta", lines, static=True)
        views = rollout.frames + rollout.heldout
        for frame in np.unique(np.linspace(0, len(views) - 1, min(len(views), _PICTURES)).round().astype(int)):
            recording.set_time("frame", sequence=int(frame))
            _log_camera(recording, cameras, int(frame), views[frame].image)
    finally:
        recording.disconnect()


def _log_camera(recording: rr.RecordingStream, cameras: Cameras, frame: int, image: Path) -> None:
    pose, k = cameras.poses[frame], cameras.intrinsics
    with Image.open(image) as picture:
        width = min(_PICTURE_WIDTH, k.width)
        small = picture.convert("RGB").resize((width, max(1, round(k.height * width / k.width))))
    encoded = io.BytesIO()
    small.save(encoded, format="JPEG", quality=80)
    across, down = small.width / k.width, small.height / k.height
    matrix = k.matrix * np.array([[across], [down], [1.0]])
    recording.log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
    recording.log(
        "world/camera/picture",
        rr.Pinhole(
            image_from_camera=matrix,
            resolution=[small.width, small.height],
            camera_xyz=rr.ViewCoordinates.RUB,
            image_plane_distance=0.3,
        ),
        rr.EncodedImage(contents=encoded.getvalue(), media_type="image/jpeg"),
    )


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
        "verdicts": [as_json(verdict) for verdict in verdicts],
        "versions": installed_versions(_VERSIONED),
    }
    path.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def as_json(verdict: Verdict) -> dict[str, Any]:
    """A verdict as JSON has it: figures that are not numbers become null."""
    values = asdict(verdict)
    values["figures"] = {name: value if math.isfinite(value) else None for name, value in verdict.figures.items()}
    return values


def outputs_of_geometry(rollout: Rollout, geometry: Any, verdicts: list[Verdict]) -> dict[str, Callable[[Path], None]]:
    """What writes the picture, the cloud and the recording of a `Geometry`."""
    cameras, bad = geometry.cameras, geometry.bad
    cloud = fuse(rollout, geometry.maps, cameras, bad)
    return {
        PICTURE: lambda path: draw_overview(path, cloud, cameras, bad, verdicts),
        CLOUD: lambda path: write_ply(path, cloud),
        RECORDING: lambda path: write_recording(path, rollout, cloud, cameras, bad),
    }
