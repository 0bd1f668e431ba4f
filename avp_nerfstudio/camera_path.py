"""`python -m avp_nerfstudio.camera_path`: a rollout's walk as a smooth camera path for `ns-render camera-path`."""

import json
import math
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional

from avp_habitat import command
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.files import atomic_file
from avp_habitat.poses import camera_to_world, y_up_to_z_up, yaw_and_pitch
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.rollout.format import read_rollout

Float = NDArray[np.floating]

# One action of the task, by default: 0.25 m forward or 10 degrees to the side take the same time in the film.
_STEP_M = 0.25
_STEP_RAD = math.radians(10.0)
_SAMPLES_PER_STEP = 8
_SMOOTHING_STEPS = 1.5


@dataclass(frozen=True)
class CameraPath:
    """Write a smooth camera path along a rollout's walk, for `ns-render camera-path`."""

    rollout: Positional[Path]
    """The rollout's folder."""
    out: Path
    """The JSON file to write; must not exist."""
    seconds: Annotated[float, Range(0, 3600)] = 8.0
    """Length of the film."""
    fps: Annotated[int, Range(1, 240)] = 24
    """Pictures per second."""
    width: Annotated[int, Range(8, 8192)] = 640
    """Of the pictures in pixels."""
    height: Annotated[int, Range(8, 8192)] = 480
    """Of the pictures in pixels; their vertical field of view is that of the rollout's pictures."""
    scale: Annotated[float, Range(1e-6, 10**6)] = 1.0
    """avp-data's --scale, where it was used."""

    def __post_init__(self) -> None:
        """Hold the ranges."""
        hold_ranges(self)
        if self.frames < 2:
            raise UsageError(
                f"seconds: expected at least two pictures' worth, got {self.seconds:g} at {self.fps} pictures a second"
            )

    @property
    def frames(self) -> int:
        """How many pictures that makes."""
        return round(self.seconds * self.fps)


def camera_path(film: CameraPath) -> dict[str, Any]:
    """A rollout's walk in the form in which nerfstudio's viewer saves a path.

    Returns:
        What `nerfstudio.cameras.camera_paths.get_path_from_json` reads, with 4x4 camera_to_world, row by row,
        OpenGL camera axes, Z up, metres times `film.scale`, as avp-data gives the poses.

    Raises:
        RolloutError: the rollout cannot be read, or its camera never moves.
    """
    rollout = read_rollout(film.rollout)
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


def main(film: CameraPath) -> None:
    """Write one camera path; print what to run next."""
    with atomic_file(film.out, replace=False, failure=UsageError, option="--out") as file:
        file.write_text(json.dumps(camera_path(film)), encoding="utf-8")
    path, video = (shlex.quote(str(name)) for name in (film.out, film.out.with_suffix(".mp4")))
    print(f"{film.out}: {film.frames} cameras, {film.seconds:g} s at {film.fps} pictures per second")
    print(f"render:  ns-render camera-path --load-config CONFIG --camera-path-filename {path} --output-path {video}")
    print("         CONFIG is the config.yml of the reconstruction; --rendered-output-names rgb depth adds depth")


if __name__ == "__main__":
    sys.exit(command.run(main))
