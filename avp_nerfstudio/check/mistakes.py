"""The mistakes that are known, each with what undoes it, and the search for the one that explains a disagreement."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, camera_to_world, opencv_to_habitat, wrap_angle, yaw_and_pitch
from avp_nerfstudio.check.agreement import LEAST_COMPARED, Agreement, Cameras, Comparison, agrees

Float = NDArray[np.floating]
Mask = NDArray[np.bool_]

ROLL = 1e-3
"""Largest height of the camera's x axis (a unit vector) above the horizon that counts as none."""
_PITCH_RAD = 1e-3
_ONLY = {"all": "", "captured": " (of the captured frames alone)", "held-out": " (of the held-out views alone)"}


def has_no_roll(poses: Float) -> Mask:
    """`(n,)` whether the x axis of `(n, 4, 4)` habitat poses is horizontal; true of upside-down cameras too."""
    return np.abs(poses[:, 1, 0]) < ROLL


def full_angles(poses: Float) -> tuple[Float, Float]:
    """Yaw and pitch, `(n,)` each in radians, of `(n, 4, 4)` habitat poses without roll.

    Unlike those of `yaw_and_pitch` they tell a camera that is upside down: its pitch lies beyond ±pi/2.
    """
    yaw, pitch = yaw_and_pitch(poses)
    upside_down = poses[:, 1, 1] < 0
    return wrap_angle(yaw + np.pi * upside_down), np.where(upside_down, wrap_angle(np.pi - pitch), pitch)


def is_upright(poses: Float, *, limit_deg: float) -> Mask:
    """`(n,)` whether `(n, 4, 4)` habitat poses have no roll and a pitch within the limit in degrees."""
    return has_no_roll(poses) & (np.abs(np.degrees(full_angles(poses)[1])) <= limit_deg + 0.01)


def transposed(poses: Float) -> Float:
    """`(n, 4, 4)` poses with their rotations transposed."""
    turned = poses.copy()
    turned[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return turned


@dataclass(frozen=True)
class Mistake:
    """A mistake, and the cameras as they would be without it."""

    cause: str
    """In words."""
    cameras: Cameras
    """With the mistake undone."""


def conventions(given: Cameras, group: str = "all") -> Iterator[Mistake]:
    """Matrices that mean something else than camera_to_world with habitat axes."""
    inverse = np.linalg.inv(given.poses)
    for cause, poses in (
        ("camera axes look like opencv written as habitat: y and z flipped", opencv_to_habitat(given.poses)),
        (
            "the rotations look transposed: their rows are the camera's axes, expected columns",
            transposed(given.poses),
        ),
        ("the matrices look like world_to_camera: expected camera_to_world, their inverse", inverse),
        (
            "the matrices look like world_to_camera with opencv axes, as COLMAP writes them: expected camera_to_world "
            "with habitat axes",
            opencv_to_habitat(inverse),
        ),
    ):
        yield _with_poses(given, cause, poses, group)


def time_shifts(given: Cameras) -> Iterator[Mistake]:
    """Captured frames that carry the pose of an earlier or later one."""
    n = given.captured
    for shift in (1, -1, 2, -2):
        source = np.arange(n) - shift
        poses, kept = given.poses.copy(), given.kept.copy()
        poses[:n] = given.poses[np.clip(source, 0, n - 1)]
        kept[:n] &= (source >= 0) & (source < n)
        frames, but_one = ("frame", "") if abs(shift) == 1 else ("frames", " but one")
        whose = "next" if shift > 0 else "previous"
        cause = f"the poses are shifted in time by {abs(shift)} {frames}: each frame has the pose of the {whose} one"
        yield Mistake(cause + but_one, replace(given, poses=poses, kept=kept))


def swapped_intrinsics(given: Cameras) -> Iterator[Mistake]:
    """A principal point or focal lengths that were computed from width and height the wrong way round."""
    k = given.intrinsics
    exchanged = replace(k, fx=k.fy, fy=k.fx, cx=k.cy, cy=k.cx)
    from_height = {"fx": k.fx * k.width / k.height, "fy": k.fx * k.width / k.height}
    cause = f"width and height look swapped in the intrinsics: cx and cy belong to a picture of {k.height}x{k.width}"
    for intrinsics in (exchanged, replace(exchanged, **from_height), replace(k, **from_height)):
        yield Mistake(cause, replace(given, intrinsics=intrinsics))


def focal_factor(given: Cameras, factor: float, *, evidence: str = "depth") -> Mistake:
    """A focal length that is `factor` times the right one."""
    k = given.intrinsics
    cause = (
        f"the focal length is {abs(100 * (factor - 1)):.1f} % too {'long' if factor > 1 else 'short'}: "
        f"{k.fx:.1f} pixels given, {k.fx / factor:.1f} fit the {evidence}"
    )
    return Mistake(cause, replace(given, intrinsics=zoomed(k, 1 / factor)))


def zoomed(intrinsics: Intrinsics, factor: float) -> Intrinsics:
    """The same camera with `factor` times the focal length."""
    return replace(intrinsics, fx=intrinsics.fx * factor, fy=intrinsics.fy * factor)


def scale_factor(given: Cameras, factor: float, group: str = "all", *, step_ratio: float | None = None) -> Mistake:
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
    return _with_poses(given, cause, poses, group)


def radians_taken_for_degrees(given: Cameras, group: str) -> Iterator[Mistake]:
    """Pitch in radians that was converted from degrees once too often: cameras that look level."""
    pitch = np.degrees(full_angles(given.poses)[1])
    if has_no_roll(given.poses).all() and np.abs(pitch).max() < np.pi / 2:
        cause = "the pitch was converted from degrees to radians twice: it is 57 times too small"
        yield _with_poses(given, cause, _with_pitch(given.poses, pitch), group)


def degrees_taken_for_radians(given: Cameras, group: str, *, unit_deg: float, limit_deg: float) -> Iterator[Mistake]:
    """Pitch in degrees that was used as if in radians, and so went round several times.

    Args:
        given: the cameras.
        group: whose pitch.
        unit_deg: the pitch was a multiple of it; cameras of which that cannot be are not kept.
        limit_deg: greatest pitch.
    """
    most = int(limit_deg / unit_deg)
    degrees = unit_deg * np.arange(-most, most + 1)
    away = np.abs(wrap_angle(full_angles(given.poses)[1][:, None] - degrees))
    members = given.select(group)
    decided = away.min(axis=1) < _PITCH_RAD
    if has_no_roll(given.poses).all() and decided[members].mean() >= 0.5:
        cause = "the pitch in degrees was taken for radians: pitched cameras look anywhere, up to upside down"
        poses = _with_pitch(given.poses, np.radians(degrees[away.argmin(axis=1)]))
        yield _with_poses(replace(given, kept=given.kept & (decided | ~members)), cause, poses, group)


def usual(given: Cameras, group: str = "all", *, unit_deg: float = 1.0, limit_deg: float = 90.0) -> Iterator[Mistake]:
    """The mistakes that no number has to be found for; unit and limit are those of the pitch."""
    yield from conventions(given, group)
    yield from radians_taken_for_degrees(given, group)
    yield from degrees_taken_for_radians(given, group, unit_deg=unit_deg, limit_deg=limit_deg)
    if group == "all":
        yield from time_shifts(given)
        yield from swapped_intrinsics(given)


def _with_pitch(poses: Float, pitch: Float) -> Float:
    return camera_to_world(poses[:, :3, 3], yaw=full_angles(poses)[0], pitch=pitch)


def _with_poses(given: Cameras, cause: str, poses: Float, group: str) -> Mistake:
    members = given.select(group)[:, None, None]
    return Mistake(cause + _ONLY[group], replace(given, poses=np.where(members, poses, given.poses)))


_FINE_M = 0.005
_VERIFIED = 4
_STILL_JUDGED = 0.8
_FACTORS = np.geomspace(0.5, 2.0, 41)
_UNITS = (0.001, 0.01, 0.1, 0.3048, 1 / 0.3048, 10.0, 100.0, 1000.0)


@dataclass(frozen=True)
class Walk:
    """What is known about the walk besides the poses."""

    pitch_limit_deg: float = 60.0
    """Greatest pitch of captured frames."""
    tilt_deg: float = 10.0
    """Pitch changes by multiples of it."""
    step_ratio: float | None = None
    """Longest step between captured frames over the length of a forward move, None where that is not known."""

    @classmethod
    def of(cls, meta: dict[str, Any], captured: Float) -> "Walk":
        """Read from `rollout.json`, as far as it says; `(n, 4, 4)` the captured poses."""
        actions = meta.get("actions", {})
        steps = np.linalg.norm(np.diff(captured[:, [0, 2], 3], axis=0), axis=1)
        forward = actions.get("forward_m")
        return cls(
            float(actions.get("pitch_limit_deg", cls.pitch_limit_deg)),
            float(actions.get("tilt_deg") or cls.tilt_deg),
            float(steps.max() / forward) if forward and len(steps) else None,
        )


def find_mistake(
    comparison: Comparison, given: Cameras, walk: Walk, groups: Iterable[str] = ("all",)
) -> Mistake | None:
    """The mistake of a whole group that, undone, makes all cameras agree; None when there is none such.

    Args:
        comparison: for what is tried.
        given: the cameras.
        walk: for the pitch and the scale.
        groups: see `Cameras.select`.
    """
    tried = [mistake for group in groups for mistake in _known(comparison, given, walk, group)]
    ranked = sorted(tried, key=lambda mistake: -comparison.quick(mistake.cameras))
    believed = comparison.full(given)
    accepted = []
    for mistake in ranked[:_VERIFIED]:
        kept = mistake.cameras.kept
        agreement = comparison.full(mistake.cameras)
        before, after = believed.among(kept).score(), agreement.among(kept).score()
        # Undoing a mistake makes more points agree; cameras that are torn apart have no contradictions either.
        together = _judged(agreement, kept) >= _STILL_JUDGED * _judged(believed, kept)
        if together and after > before and agrees(agreement, kept):
            # The world may hang upside down and yet agree with itself: cameras of a walker stand upright.
            upright = float(is_upright(mistake.cameras.poses, limit_deg=walk.pitch_limit_deg).mean())
            accepted.append((upright, after, mistake))
    return max(accepted, key=lambda found: found[:2])[2] if accepted else None


def _judged(agreement: Agreement, kept: Mask) -> int:
    """How many of the kept frames share enough with others to be judged."""
    return int((agreement.per_frame(kept)[1] >= LEAST_COMPARED)[kept].sum())


def _known(comparison: Comparison, given: Cameras, walk: Walk, group: str) -> Iterator[Mistake]:
    yield from usual(given, group, unit_deg=walk.tilt_deg, limit_deg=walk.pitch_limit_deg)
    yield _best_factor(
        comparison,
        lambda factor: scale_factor(given, factor, group, step_ratio=walk.step_ratio),
        (*_FACTORS, *_UNITS),
    )
    if group == "all":
        yield _best_factor(comparison, lambda factor: focal_factor(given, factor), _FACTORS)


def _best_factor(comparison: Comparison, undo: Callable[[float], Mistake], factors: Iterable[float]) -> Mistake:
    """The best of a family with one number: the best of a list, then refined with a finer tolerance."""
    best = max(factors, key=lambda factor: comparison.quick(undo(factor).cameras))
    low, high = best / 1.036, best * 1.036
    for _ in range(3):
        tried = np.geomspace(low, high, 9)
        scores = [comparison.quick(undo(factor).cameras, tolerance_m=_FINE_M) for factor in tried]
        centre = int(np.argmax(scores))
        best, low, high = tried[centre], tried[max(centre - 1, 0)], tried[min(centre + 1, 8)]
    return undo(float(best))
