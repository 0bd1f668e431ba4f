"""Which cells of a known map a camera at a given pose should see."""

from typing import NamedTuple

import numpy as np

from avp_habitat.compiled import njit
from avp_habitat.policies.planning import BLOCKED, BODY_M
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.settings import TaskSettings


class Lens(NamedTuple):
    """A camera above a flat floor; lengths in cells."""

    height: float
    """Of the camera above the floor."""
    reach: float
    """Greatest distance from the camera to a floor point."""
    half_width: float
    """Tangent of half the horizontal field of view."""
    half_height: float
    """Tangent of half the vertical field of view."""


def make_lens(settings: TaskSettings, cell_m: float) -> Lens:
    """The task's camera."""
    half_width = float(np.tan(np.radians(settings.hfov_deg) / 2))
    return Lens(
        settings.sensor_height_m / cell_m,
        settings.max_range_m / cell_m,
        half_width,
        half_width * settings.height / settings.width,
    )


def looking_down(settings: TaskSettings) -> float:
    """The pitch in radians, a whole number of tilts below the horizon, at which planners look at the floor.

    It is the highest one whose views begin no farther than `BODY_M` from the agent: without a gap between the floor
    around the body and the floor in view, what is seen can be walked on. The task's limit may allow less.
    """
    lens = make_lens(settings, 1.0)
    down = np.degrees(np.arctan(lens.height / BODY_M) - np.arctan(lens.half_height))
    tilts = min(np.ceil(down / settings.tilt_deg - 1e-9), np.floor(settings.pitch_limit_deg / settings.tilt_deg + 1e-9))
    return -float(np.radians(max(tilts, 0.0) * settings.tilt_deg))


def should_look_down(view: AgentView) -> bool:
    """Whether the camera is still above `looking_down` by at least half a tilt."""
    return view.pitch > looking_down(view.settings) + np.radians(view.settings.tilt_deg) / 2


@njit(cache=True)
def in_frame(lens, row, column, forward_row, forward_column, cos_pitch, sin_pitch):
    """Whether a floor point `(row, column)` cells away from under the camera lies inside the image and within reach."""
    forward = row * forward_row + column * forward_column
    aside = row * forward_column - column * forward_row
    depth = forward * cos_pitch - lens.height * sin_pitch
    upwards = -forward * sin_pitch - lens.height * cos_pitch
    if depth <= 0 or abs(aside) > depth * lens.half_width or abs(upwards) > depth * lens.half_height:
        return False
    return row * row + column * column + lens.height * lens.height <= lens.reach * lens.reach


@njit(cache=True)
def clear_line(state, row, column, to_row, to_column):
    """Whether no BLOCKED cell lies between two points of the grid; sampled once per cell of the longer axis."""
    steps = int(np.ceil(max(abs(to_row - row), abs(to_column - column))))
    for i in range(1, steps):
        share = i / steps
        if state[int(row + (to_row - row) * share), int(column + (to_column - column) * share)] == BLOCKED:
            return False
    return True


@njit(cache=True)
def in_view(state, cells, row, column, yaw, pitch, lens):
    """`(k,)` whether a camera over a point of the grid should see the centres of `(k, 2)` cells.

    Args:
        state: `(rows, columns)` of a `KnownMap`; unknown cells hide nothing.
        cells: `(k, 2)` rows and columns.
        row: of the camera, in cells.
        column: of the camera, in cells.
        yaw: radians.
        pitch: radians.
        lens: of the camera.
    """
    seen = np.zeros(len(cells), np.bool_)
    forward_row, forward_column = -np.cos(yaw), -np.sin(yaw)
    cos_pitch, sin_pitch = np.cos(pitch), np.sin(pitch)
    for i in range(len(cells)):
        to_row, to_column = cells[i, 0] + 0.5, cells[i, 1] + 0.5
        if in_frame(lens, to_row - row, to_column - column, forward_row, forward_column, cos_pitch, sin_pitch):
            seen[i] = clear_line(state, row, column, to_row, to_column)
    return seen
