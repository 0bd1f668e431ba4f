"""`python -m avp_nerfstudio.camera_path`: a rollout's walk as a smooth camera path for `ns-render camera-path`."""

import argparse
import json
import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat import command
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.poses import camera_to_world, y_up_to_z_up, yaw_and_pitch
from avp_habitat.rollout.format import read_rollout

Float = NDArray[np.floating]

# One action of the task, by default: 0.25 m forward or 10 degrees to the side take the same time in the film.
_STEP_M = 0.25
_STEP_RAD = math.radians(10.0)
_SAMPLES_PER_STEP = 8
_SMOOTHING_STEPS = 1.5


@dataclass(frozen=True)
class Film:
    """What the film through the room is to be like."""

    seconds: float = 8.0
    """Its length."""
    fps: int = 24
    """Pictures per second."""
    width: int = 640
    """Of the pictures, in pixels."""
    height: int = 480
    """Of the pictures, in pixels; their vertical field of view is that of the rollout's pictures."""
    scale: float = 1.0
    """What avp-data multiplied all positions by; 1 unless the reconstruction was made with its `--scale`."""

    @property
    def frames(self) -> int:
        """How many pictures that makes."""
        return round(self.seconds * self.fps)


def camera_path(folder: str | Path, film: Film) -> dict[str, Any]:
    """A rollout's walk in the form in which nerfstudio's viewer saves a path.

    Returns:
        What `nerfstudio.cameras.camera_paths.get_path_from_json` reads, with 4x4 camera_to_world, row by row,
        OpenGL camera axes, Z up, metres times `film.scale`, as avp-data gives the poses.

    Raises:
        RolloutError: the rollout cannot be read, or its camera never moves.
    """
    rollout = read_rollout(folder)
    poses = smooth_path(np.stack([view.camera_to_world for view in rollout.frames] or [np.eye(4)]), film.frames)
    if poses is None:
        raise RolloutError(
            f"{rollout.folder}: expected frames from at least two places or directions to make a path of; its camera "
            f"never moves ({len(rollout.frames)} frames)"
        )
    fov_deg = math.degrees(2 * math.atan(rollout.intrinsics.height / 2 / rollout.intrinsics.fy))
    turned = y_up_to_z_up(poses)
    turned[:, :3, 3] *= film.scale
    return {
        "camera_type": "perspective",
        "render_width": film.width,
        "render_height": film.height,
        "fps": film.fps,
        "seconds": film.seconds,
        "camera_path": [
            {"camera_to_world": pose.ravel().tolist(), "fov": fov_deg, "aspect": film.width / film.height}
            for pose in turned
        ],
    }


def smooth_path(poses: Float, count: int) -> Float | None:
    """Upright cameras that follow a walk smoothly and at constant speed.

    Speed counts metres and radians together, an action's worth of either alike, so that a turn on the spot takes its
    time. Smoothing is a weighted mean over neighbouring poses (a Gaussian of 1.5 actions): it cuts corners by
    centimetres and never leaves the hull of the poses nearby. First and last pose are kept.

    Args:
        poses: `(n, 4, 4)` camera_to_world, habitat axes, metres, in the order of the walk.
        count: of cameras wanted, at least 2.

    Returns:
        `(count, 4, 4)`, habitat axes, metres; None when all poses are one.
    """
    yaw, pitch = yaw_and_pitch(poses)
    track = np.column_stack([poses[:, :3, 3] / _STEP_M, np.unwrap(yaw) / _STEP_RAD, pitch / _STEP_RAD])
    steps = _length_along(track)[-1]
    if steps < 1e-6:
        return None
    track = _at_equal_distances(track, max(2, math.ceil(steps * _SAMPLES_PER_STEP)))
    track = _at_equal_distances(_smooth(track), count)
    return camera_to_world(track[:, :3] * _STEP_M, yaw=track[:, 3] * _STEP_RAD, pitch=track[:, 4] * _STEP_RAD)


def _length_along(track: Float) -> Float:
    """`(n,)` distance travelled, in actions, until each of the `(n, 5)` points; moves and turns add up as squares."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track, axis=0), axis=1))])


def _at_equal_distances(track: Float, count: int) -> Float:
    """The `(count, 5)` points on a `(n, 5)` polyline that lie equally far apart along it, ends included."""
    along = _length_along(track)
    wanted = np.linspace(0.0, along[-1], count)
    return np.column_stack([np.interp(wanted, along, column) for column in track.T])


def _smooth(track: Float) -> Float:
    """Gaussian mean of each of `(n, 5)` equally spaced points with its neighbours; the ends stay where they are."""
    sigma = _SMOOTHING_STEPS * _SAMPLES_PER_STEP
    reach = min(math.ceil(3 * sigma), len(track) - 1)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    # Reflected through the end points, so that what lies beyond them balances what lies before.
    padded = np.pad(track, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    return np.column_stack([np.convolve(column, weights / weights.sum(), mode="valid") for column in padded.T])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m avp_nerfstudio.camera_path",
        description="Write a smooth camera path along a rollout's walk, for `ns-render camera-path`.",
    )
    add = parser.add_argument
    add("rollout", metavar="ROLLOUT", type=Path, help="the rollout's folder")
    add("--out", required=True, type=Path, metavar="PATH.json", help="the file to write; must not exist")
    add("--seconds", default=Film.seconds, type=float, help="length of the film (default: %(default)s)")
    add("--fps", default=Film.fps, type=int, help="pictures per second (default: %(default)s)")
    add("--width", default=Film.width, type=int, help="of the pictures in pixels (default: %(default)s)")
    add("--height", default=Film.height, type=int, help="of the pictures in pixels (default: %(default)s)")
    add("--scale", default=Film.scale, type=float, help="avp-data's --scale, where it was used (default: %(default)s)")
    return parser


def _film(options: argparse.Namespace) -> Film:
    film = Film(options.seconds, options.fps, options.width, options.height, options.scale)
    for name in ("width", "height"):
        if not 8 <= getattr(film, name) <= 8192:
            raise UsageError(f"--{name}: expected 8 to 8192 pixels, got {getattr(film, name)}")
    if not 1 <= film.fps <= 240:
        raise UsageError(f"--fps: expected 1 to 240 pictures per second, got {film.fps}")
    if not 0 < film.seconds <= 3600 or film.frames < 2:
        raise UsageError(
            f"--seconds: expected at least two pictures' worth and at most an hour, got {film.seconds:g} at {film.fps} "
            "pictures per second"
        )
    if not (math.isfinite(film.scale) and film.scale > 0):
        raise UsageError(f"--scale: expected a number above 0, got {film.scale}")
    return film


def _write(path: Path, content: dict[str, Any]) -> None:
    if path.exists():
        raise UsageError(f"--out: {path} exists; name another file, or remove it first")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"--out: expected a place to write {path}, got: {error.strerror}") from None


def main(argv: Sequence[str]) -> None:
    """Write one camera path; print what to run next."""
    options = _parser().parse_args(argv)
    film = _film(options)
    _write(options.out, camera_path(options.rollout, film))
    path, video = (shlex.quote(str(name)) for name in (options.out, options.out.with_suffix(".mp4")))
    print(f"{options.out}: {film.frames} cameras, {film.seconds:g} s at {film.fps} pictures per second")
    print(f"render:  ns-render camera-path --load-config CONFIG --camera-path-filename {path} --output-path {video}")
    print("         CONFIG is the config.yml of the reconstruction; --rendered-output-names rgb depth adds depth")


if __name__ == "__main__":
    sys.exit(command.run(main))
