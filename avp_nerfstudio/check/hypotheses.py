"""The mistakes that are known, each with what undoes it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, camera_to_world, opencv_to_habitat
from avp_nerfstudio.check.verdict import full_angles, has_no_roll

Float = NDArray[np.floating]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Cameras:
    """Poses and intrinsics as they are believed under some hypothesis."""

    poses: Float
    """`(n, 4, 4)` camera_to_world, habitat axes; first the captured frames in order, then the held-out views."""
    intrinsics: Intrinsics
    """Of all n."""
    captured: int
    """How many of the n are captured frames."""
    kept: Mask
    """`(n,)` those for which the hypothesis says something."""

    def select(self, group: str) -> Mask:
        """`(n,)` the members of a group: "all", "captured" or "held-out"."""
        captured = np.arange(len(self.poses)) < self.captured
        return {"all": np.ones(len(captured), bool), "captured": captured, "held-out": ~captured}[group]


@dataclass(frozen=True)
class Hypothesis:
    """A mistake, and the cameras as they would be without it."""

    key: str
    """Its short name."""
    cause: str
    """In words."""
    cameras: Cameras
    """With the mistake undone."""


_CONVENTIONS = {
    "axes": "camera axes look like opencv written as habitat: y and z flipped",
    "transposed": "the rotations look transposed: their rows are the camera's axes, expected columns",
    "world-to-camera": "the matrices look like world_to_camera: expected camera_to_world, their inverse",
    "world-to-camera-opencv": "the matrices look like world_to_camera with opencv axes, as COLMAP writes them: "
    "expected camera_to_world with habitat axes",
}
_ONLY = {"all": "", "captured": " (of the captured frames alone)", "held-out": " (of the held-out views alone)"}


def conventions(given: Cameras, group: str) -> Iterator[Hypothesis]:
    """Matrices that mean something else than camera_to_world with habitat axes."""
    undone = {
        "axes": opencv_to_habitat(given.poses),
        "transposed": _transposed(given.poses),
        "world-to-camera": np.linalg.inv(given.poses),
        "world-to-camera-opencv": opencv_to_habitat(np.linalg.inv(given.poses)),
    }
    for key, poses in undone.items():
        yield Hypothesis(key, _CONVENTIONS[key] + _ONLY[group], _with_poses(given, poses, group))


def time_shifts(given: Cameras) -> Iterator[Hypothesis]:
    """Captured frames that carry the pose of an earlier or later one."""
    n = given.captured
    for shift in (1, -1, 2, -2):
        source = np.arange(n) - shift
        known = (source >= 0) & (source < n)
        poses, kept = given.poses.copy(), given.kept.copy()
        poses[:n] = given.poses[np.clip(source, 0, n - 1)]
        kept[:n] &= known
        frames = "frame" if abs(shift) == 1 else "frames"
        whose = "next" if shift > 0 else "previous"
        cause = f"the poses are shifted in time by {abs(shift)} {frames}: each frame has the pose of the {whose} one"
        if abs(shift) > 1:
            cause += " but one"
        yield Hypothesis("time-shift", cause, replace(given, poses=poses, kept=kept))


def swapped_intrinsics(given: Cameras) -> Iterator[Hypothesis]:
    """A principal point or focal lengths that were computed from width and height the wrong way round."""
    k = given.intrinsics
    exchanged = replace(k, fx=k.fy, fy=k.fx, cx=k.cy, cy=k.cx)
    from_height = k.fx * k.width / k.height
    cause = "width and height look swapped in the intrinsics: cx and cy belong to a picture of {}x{}"
    from_width = replace(k, fx=from_height, fy=from_height)
    for intrinsics in (exchanged, replace(exchanged, fx=from_height, fy=from_height), from_width):
        yield Hypothesis("swapped", cause.format(k.height, k.width), replace(given, intrinsics=intrinsics))


def focal_factor(given: Cameras, factor: float) -> Hypothesis:
    """A focal length that is `factor` times the right one."""
    k = given.intrinsics
    percent = 100 * (factor - 1)
    cause = (
        f"the focal length is {abs(percent):.1f} % too {'long' if factor > 1 else 'short'}: "
        f"{k.fx:.1f} pixels given, {k.fx / factor:.1f} fit the depth"
    )
    intrinsics = replace(k, fx=k.fx / factor, fy=k.fy / factor)
    return Hypothesis("focal", cause, replace(given, intrinsics=intrinsics))


def scale_factor(given: Cameras, factor: float, group: str = "all", *, step_ratio: float | None = None) -> Hypothesis:
    """Positions that are `factor` times the right ones.

    Args:
        given: the cameras.
        factor: of the positions about the world's origin.
        group: whose positions.
        step_ratio: longest step between frames over the length of a forward move, where that is known; it tells
            wrong positions from wrong depth, which look the same otherwise.
    """
    poses = given.poses.copy()
    poses[:, :3, 3] /= factor
    cause = f"wrong scale: the positions are {factor:.3g} times too large for the depth"
    if step_ratio is not None and abs(step_ratio / factor - 1) < 0.02:
        cause += f" (steps are {step_ratio:.3g} times the length of a forward move)"
    elif step_ratio is not None and abs(step_ratio - 1) < 0.02:
        cause = f"wrong scale: the depth is {factor:.3g} times too small for the positions, whose steps are right"
    return Hypothesis("scale", cause + _ONLY[group], _with_poses(given, poses, group))


def radians_taken_for_degrees(given: Cameras, group: str) -> Iterator[Hypothesis]:
    """Pitch in radians that was converted from degrees once too often: cameras that look level."""
    if not has_no_roll(given.poses).all():
        return
    pitch = np.degrees(full_angles(given.poses)[1])
    if np.abs(pitch).max() < np.pi / 2:
        cause = "the pitch was converted from degrees to radians twice: it is 57 times too small"
        yield Hypothesis("pitch", cause + _ONLY[group], _with_poses(given, with_pitch(given.poses, pitch), group))


def pitches_from_degrees(poses: Float, *, limit_deg: float) -> list[Float]:
    """Pitches in radians of which each pose may be the result, had their degrees been taken for radians.

    Args:
        poses: `(n, 4, 4)` without roll.
        limit_deg: greatest pitch, degrees.

    Returns:
        For each pose the possible pitches, `(k,)`, the flattest first: degrees as radians go round several times.
    """
    turns = 2 * np.pi * np.arange(-int(limit_deg / 6) - 1, int(limit_deg / 6) + 2)
    found = []
    for pitch in full_angles(poses)[1]:
        degrees = pitch + turns
        degrees = degrees[np.abs(degrees) <= limit_deg + 1e-6]
        found.append(np.radians(degrees[np.argsort(np.abs(degrees), kind="stable")]))
    return found


def degrees_taken_for_radians(given: Cameras, pitch: Float, group: str) -> Hypothesis:
    """Pitch in degrees that was used as if in radians; `(n,)` the pitches in radians as they should have been."""
    cause = "the pitch in degrees was taken for radians: pitched cameras look anywhere, up to upside down"
    return Hypothesis("pitch", cause + _ONLY[group], _with_poses(given, with_pitch(given.poses, pitch), group))


def with_pitch(poses: Float, pitch: Float) -> Float:
    """The same positions and yaw with `(n,)` other pitches in radians; the poses may be upside down."""
    return camera_to_world(poses[:, :3, 3], yaw=full_angles(poses)[0], pitch=pitch)


def exchanged(given: Cameras, a: int, b: int) -> Cameras:
    """The cameras with two poses exchanged."""
    poses = given.poses.copy()
    poses[[a, b]] = given.poses[[b, a]]
    return replace(given, poses=poses)


def _transposed(poses: Float) -> Float:
    turned = poses.copy()
    turned[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return turned


def _with_poses(given: Cameras, poses: Float, group: str) -> Cameras:
    return replace(given, poses=np.where(given.select(group)[:, None, None], poses, given.poses))
