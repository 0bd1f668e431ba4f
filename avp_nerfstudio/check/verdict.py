"""The outcome of a check, and whether cameras stand upright, as those of a walking agent do."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import wrap_angle, yaw_and_pitch


@dataclass(frozen=True)
class Verdict:
    """One check's outcome, in numbers and in words."""

    name: str
    """What was checked, for example `"depth agreement"`."""
    passed: bool
    """Whether every figure keeps its limit."""
    text: str
    """One line: what was measured against what limit."""
    figures: dict[str, float] = field(default_factory=dict)
    """The measured numbers; each name ends in its unit, for example `"agreeing_2cm_percent"`."""
    cause: str | None = None
    """The likely cause in words, where one is known; None for a check that passed."""


Float = NDArray[np.floating]

ROLL = 1e-3
"""Largest height of the camera's x axis (a unit vector) above the horizon that counts as none."""


def has_no_roll(poses: Float) -> NDArray[np.bool_]:
    """`(n,)` whether the x axis of `(n, 4, 4)` habitat poses is horizontal; true of upside-down cameras too."""
    return np.abs(poses[:, 1, 0]) < ROLL


def full_angles(poses: Float) -> tuple[Float, Float]:
    """Yaw and pitch, `(n,)` each in radians, of `(n, 4, 4)` habitat poses without roll.

    Unlike those of `yaw_and_pitch` they tell a camera that is upside down: its pitch lies beyond ±pi/2.
    """
    yaw, pitch = yaw_and_pitch(poses)
    upside_down = poses[:, 1, 1] < 0
    return wrap_angle(yaw + np.pi * upside_down), np.where(upside_down, wrap_angle(np.pi - pitch), pitch)


def is_upright(poses: Float, *, limit_deg: float) -> NDArray[np.bool_]:
    """`(n,)` whether `(n, 4, 4)` habitat poses have no roll and a pitch within the limit in degrees."""
    return has_no_roll(poses) & (np.abs(np.degrees(full_angles(poses)[1])) <= limit_deg + 0.01)
