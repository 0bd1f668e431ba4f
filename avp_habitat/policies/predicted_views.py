"""Which cells of a known map views should show, and which of them were not observed all the same."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.policies.known_map import BLOCKED, BODY_M, FREE, UNKNOWN, KnownMap, known_map
from avp_habitat.sight.rules import Camera, camera_numbers, in_image
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.settings import TaskSettings


class Lens(NamedTuple):
    """A camera above a flat floor; lengths in cells."""

    height: float
    """Of the camera above the floor."""
    reach: float
    """Greatest distance from the camera to a floor point."""
    camera: Camera
    """The image."""


def make_lens(settings: TaskSettings, cell_m: float) -> Lens:
    """The task's camera."""
    return Lens(settings.sensor_height_m / cell_m, settings.max_range_m / cell_m, camera_numbers(settings.intrinsics))


def looking_down(settings: TaskSettings) -> float:
    """The pitch in radians, a whole number of tilts below the horizon, at which planners look at the floor.

    It is the highest one whose views begin no farther than `BODY_M` from the agent: without a gap between the floor
    around the body and the floor in view, what is seen can be walked on. The task's limit may allow less.
    """
    camera = settings.intrinsics
    down = np.degrees(np.arctan(settings.sensor_height_m / BODY_M) - np.arctan(camera.cy / camera.fy))
    tilts = min(np.ceil(down / settings.tilt_deg - 1e-9), np.floor(settings.pitch_limit_deg / settings.tilt_deg + 1e-9))
    return -float(np.radians(max(tilts, 0.0) * settings.tilt_deg))


def should_look_down(view: AgentView) -> bool:
    """Whether the camera is still above `looking_down` by at least half a tilt."""
    return view.pitch > looking_down(view.settings) + np.radians(view.settings.tilt_deg) / 2


@njit(cache=True)
def in_frame(lens, row, column, forward_row, forward_column, cos_pitch, sin_pitch):
    """Whether a floor point `(row, column)` cells away from under the camera lies inside the image and within reach."""
    if row * row + column * column + lens.height * lens.height > lens.reach * lens.reach:
        return False
    right, forward = row * forward_column - column * forward_row, row * forward_row + column * forward_column
    ahead, up = forward * cos_pitch - lens.height * sin_pitch, -forward * sin_pitch - lens.height * cos_pitch
    return in_image(right, up, ahead, lens.camera)


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


class Memory:
    """Of one agent within one episode."""

    def __init__(self) -> None:
        """Remember nothing."""
        self._stood = np.empty((0, 3))
        self._misses = np.zeros((0, 0), dtype=np.uint8)
        self._first = np.zeros(2, dtype=np.int64)

    def update(self, view: AgentView) -> tuple[KnownMap, NDArray[np.uint8]]:
        """Take in the newest view; call it once per step.

        Returns:
            The map, and `(rows, columns)` how many views should have observed a cell that is still not observed:
            something stands there or hides it.
        """
        self._stood = np.concatenate([self._stood, view.position[None]])
        known = known_map(view, self._stood)
        misses = np.zeros_like(known.state)
        row, column = np.maximum(self._first - known.first, 0)
        height, width = self._misses.shape
        misses[row : row + height, column : column + width] = self._misses
        if view.steps:
            missed = _should_see(view, known)
            misses[tuple(missed.T)] = np.minimum(misses[tuple(missed.T)], 254) + 1
        self._misses, self._first = misses, known.first
        return known, misses


def _should_see(view: AgentView, known: KnownMap) -> NDArray[np.int64]:
    """`(k, 2)` cells not observed that the newest view should have shown."""
    cells = np.argwhere((known.state == FREE) | (known.state == UNKNOWN))
    row, column = known.at(view.position)
    lens = make_lens(view.settings, known.cell_m)
    return cells[in_view(known.state, cells, row, column, view.yaw, view.pitch, lens)]
