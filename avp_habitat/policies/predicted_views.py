"""What an agent knows of the floor, as a grid, and which cells of it its views should show."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.sight.rules import Camera, camera_numbers, in_image
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.settings import TaskSettings

UNKNOWN, FREE, OBSERVED, BLOCKED = range(4)
"""FREE: navigable as far as known, but not observed yet. OBSERVED: navigable and observed. BLOCKED: not navigable."""
BODY_M = 0.3
"""An agent knows the floor this far around every place where it has stood, metres."""
MARGIN_M = 2.0
"""Unknown floor kept around the known floor, metres."""

_NEIGHBOURS = np.array([(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)])


@dataclass(frozen=True)
class KnownMap:
    """A grid over the known floor with a margin around it; rows along +Z, columns along +X, as in `NavigableArea`."""

    state: NDArray[np.uint8]
    """`(rows, columns)` UNKNOWN, FREE, OBSERVED or BLOCKED."""
    first: NDArray[np.int64]
    """`(2,)` row and column of cell (0, 0) in the scene's grid."""
    cell_m: float
    """Side of a cell in metres."""
    corner: NDArray[np.float64]
    """`(2,)` z and x of the least corner of cell (0, 0), metres."""

    @property
    def navigable(self) -> NDArray[np.bool_]:
        """`(rows, columns)` cells known to be navigable."""
        return (self.state == FREE) | (self.state == OBSERVED)

    def at(self, point: NDArray[np.floating]) -> NDArray[np.float64]:
        """`(2,)` row and column of a `(3,)` point in metres, in cells; a cell's centre lies at +0.5."""
        return (np.asarray(point)[[2, 0]] - self.corner) / self.cell_m


def known_map(view: AgentView, stood: NDArray[np.float64]) -> KnownMap:
    """What an agent that has stood at `(k, 3)` places in metres knows about the floor.

    An observed cell is navigable, and the depth image around its floor point shows which of its 8 neighbours are;
    around its own body the agent knows the cells within `BODY_M`. Nothing else of the scene is read: the grid's size
    follows from these cells too.
    """
    area = view.area
    observed = area.cell_of(area.centres[view.observed])
    body = _around(area.cell_of(stood), BODY_M / area.cell_m)
    known = np.concatenate([(observed[:, None] + _NEIGHBOURS).reshape(-1, 2), body])
    margin = int(np.ceil(MARGIN_M / area.cell_m))
    first = known.min(axis=0) - margin
    state = np.full(known.max(axis=0) + margin + 1 - first, UNKNOWN, dtype=np.uint8)
    inside = ((known >= 0) & (known < area.mask.shape)).all(axis=1)
    navigable = np.zeros(len(known), dtype=np.bool_)
    navigable[inside] = area.mask[tuple(known[inside].T)]
    state[tuple((known - first).T)] = np.where(navigable, FREE, BLOCKED)
    state[tuple((observed - first).T)] = OBSERVED
    return KnownMap(state, first, area.cell_m, area.origin[::-1] + first * area.cell_m)


def _around(cells: NDArray[np.int64], radius: float) -> NDArray[np.int64]:
    """`(k, 2)` cells whose centres lie within a radius, in cells, of the centres of other cells."""
    reach = int(radius)
    offsets = np.argwhere(np.ones((2 * reach + 1,) * 2)) - reach
    offsets = offsets[np.hypot(*offsets.T) <= radius + 1e-9]
    return (np.unique(cells, axis=0)[:, None] + offsets).reshape(-1, 2)


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
    """`(k,)` whether a camera over a point of the grid should see the centres of `(k, 2)` cells; angles in radians.

    `state` is that of a `KnownMap`: BLOCKED cells hide what lies behind them, unknown ones hide nothing.
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
            cells = np.argwhere((known.state == FREE) | (known.state == UNKNOWN))
            here, lens = known.at(view.position), make_lens(view.settings, known.cell_m)
            missed = tuple(cells[in_view(known.state, cells, *here, view.yaw, view.pitch, lens)].T)
            misses[missed] = np.minimum(misses[missed], 254) + 1
        self._misses, self._first = misses, known.first
        return known, misses
