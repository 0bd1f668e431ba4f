"""`nbv`: goes for the view that gains most volumetric information for each action that it takes to get there.

Only the agent's own depth images and poses enter. Information gain as in `grid`; candidates are views from the free
space that is known to be reachable, and the gain is held against the moves, turns and tilts up to there.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.policies.frontier import farthest_straight, route_to, shortest_walks
from avp_habitat.policies.nbv.grid import FREE, OCCUPIED, VOXEL_M, OccupancyGrid
from avp_habitat.policies.planning import PlanningPolicy
from avp_habitat.poses import Intrinsics, wrap_angle
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.settings import LOOK_DOWN, LOOK_UP, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT

Float = NDArray[np.float64]

YAWS = 36
"""Directions of rays around a candidate place, and of the views from there."""
ELEVATIONS_DEG = np.arange(-70.0, 71.0, 10.0)
"""Of those rays."""
PITCHES_DEG = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 30.0)
"""Of the views."""
SPACING_M = 0.5
"""Candidate places lie this far apart."""
MOST_PLACES = 150
"""The nearest ones are considered, metres of walk counted."""
REAR_SIDE = 2.0
"""Worth of a ray to the rear side of a surface, in unknown voxels; a ray into unknown space is worth 2 in all."""
LOYALTY = 0.7
"""The view that was chosen before is left for one that is better by this factor."""
_LEAST_GAIN = 0.02
"""Share of a view's rays that must lead into unknown space for a view to be worth going for."""
_DEPTH_SIZE = 160, 120
_ALIKE_RAD = np.radians(5.0)
_BODY_M = 0.2
_NEAR_M = 0.4
_HEAD_M, _STEP_M = 1.5, 0.2
"""What is occupied between these heights above the floor blocks the way."""


@dataclass(frozen=True)
class _Candidates:
    """k reachable places, each with `YAWS` x pitches views."""

    cells: NDArray[np.int64]
    """`(k, 2)` of the grid, along z and x."""
    aims: list[Float | None]
    """Where to walk straight to on the way, in cells; None at the place where the agent is."""
    first: NDArray[np.floating]
    """`(k,)` radians by which to turn to face the aim."""
    yaws: Float
    """`(YAWS,)` radians; whole turns from the agent's."""
    pitches: Float
    """Radians."""
    actions: Float
    """`(k, YAWS, pitches)` how many it takes to get there, at least 1."""


class NextBestViewPlanner:
    """Of one agent within one episode."""

    def __init__(self) -> None:
        """Know nothing yet."""
        self._grid: OccupancyGrid | None = None
        self._blocked: list[Float] = []
        # Along z and x from the grid's corner in metres, yaw and pitch in radians: of the goal, and of all views taken.
        self._goal: Float | None = None
        self._taken = np.zeros((0, 4))

    def act(self, view: AgentView) -> int:
        """The next action."""
        grid = self._grid = self._grid or OccupancyGrid(view.position)
        camera, pose = Intrinsics.from_hfov(*_DEPTH_SIZE, hfov_deg=view.settings.hfov_deg), view.camera_to_world
        depth = view.simulator.render(pose[None], camera, rgb=False).depth[0]
        grid.integrate(depth, pose, camera, view.settings.max_range_m)
        if view.collided:
            ahead = np.array([-np.sin(view.yaw), 0.0, -np.cos(view.yaw)])
            self._blocked.append(view.position + ahead * (_BODY_M + VOXEL_M))
        here = (view.position - grid.corner)[[2, 0]]
        self._taken = np.concatenate([self._taken, [[*here, view.yaw, view.pitch]]])
        found = self._candidates(view, grid, here / VOXEL_M)
        gain = _gains(grid, found, view)
        worth = np.where((gain >= _LEAST_GAIN) & ~_alike(found, self._taken), gain / found.actions, 0.0)
        if self._goal is not None:
            worth[_alike(found, self._goal[None])] /= LOYALTY
        best = np.unravel_index(worth.argmax(), worth.shape)
        if worth[best] <= 0:
            self._goal = None
            return TURN_LEFT
        place, yaw, pitch = (int(index) for index in best)
        self._goal = np.array([*(found.cells[place] + 0.5) * VOXEL_M, found.yaws[yaw], found.pitches[pitch]])
        return self._action(view, found, place, float(found.yaws[yaw]), float(found.pitches[pitch]))

    @staticmethod
    def _action(view: AgentView, found: _Candidates, place: int, yaw: float, pitch: float) -> int:
        """The first move, tilt or turn on the way to a candidate."""
        turn, tilt = np.radians([view.settings.turn_deg, view.settings.tilt_deg])
        if found.aims[place] is not None:
            angle = found.first[place]
            return MOVE_FORWARD if abs(angle) <= turn / 2 + 1e-9 else (TURN_LEFT if angle > 0 else TURN_RIGHT)
        if abs(pitch - view.pitch) > tilt / 2:
            return LOOK_UP if pitch > view.pitch else LOOK_DOWN
        return TURN_LEFT if wrap_angle(np.array(yaw - view.yaw)) >= 0 else TURN_RIGHT

    def _candidates(self, view: AgentView, grid: OccupancyGrid, at: Float) -> _Candidates:
        """The nearest reachable places a spacing apart, by walk, the agent's own, at `(2,)` cells, first."""
        settings, passable = view.settings, self._passable(view, grid)
        length, before = shortest_walks(passable, *map(int, at))
        every = round(SPACING_M / VOXEL_M)
        row, column = (int(cell) % every for cell in at)
        cells = np.argwhere(np.isfinite(length[row::every, column::every])) * every + [row, column]
        cells = cells[np.argsort(length[tuple(cells.T)], kind="stable")][:MOST_PLACES]
        aims = [_aim(passable, before, at, cell) for cell in cells]
        headings = np.array([view.yaw if aim is None else np.arctan2(at[1] - aim[1], at[0] - aim[0]) for aim in aims])
        yaws = view.yaw + np.arange(YAWS) * 2 * np.pi / YAWS
        pitches, first = np.radians(PITCHES_DEG), wrap_angle(headings - view.yaw)
        turns = np.abs(wrap_angle(yaws - headings[:, None])) + np.abs(first)[:, None]
        tilts = np.abs(pitches - view.pitch) / np.radians(settings.tilt_deg)
        moves = length[tuple(cells.T)] * VOXEL_M / settings.forward_m
        actions = moves[:, None, None] + turns[:, :, None] / np.radians(settings.turn_deg) + tilts
        return _Candidates(cells, aims, first, yaws, pitches, np.maximum(actions, 1.0))

    def _passable(self, view: AgentView, grid: OccupancyGrid) -> NDArray[np.bool_]:
        """`(z, x)` columns of the grid that the agent's body can be in, as far as known."""
        from scipy.ndimage import binary_dilation

        floor = (view.position[1] - grid.corner[1]) / VOXEL_M
        low, high = int(floor + _STEP_M / VOXEL_M), int(floor + _HEAD_M / VOXEL_M)
        obstacle = (grid.state[:, low : high + 1] == OCCUPIED).any(axis=1)
        free = grid.state[:, high] == FREE
        for place in self._blocked:
            x, _, z = ((place - grid.corner) / VOXEL_M).astype(int)
            obstacle[x, z] = True
        reach = int(np.ceil(_BODY_M / VOXEL_M))
        disc = np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) <= _BODY_M / VOXEL_M + 1e-9
        # Who stands near a wall may leave it.
        x, z = (np.arange(size) + 0.5 for size in free.shape)
        here = (view.position - grid.corner) / VOXEL_M
        near = np.hypot(x[:, None] - here[0], z - here[2]) <= _NEAR_M / VOXEL_M
        return (free & ~obstacle & (near | ~binary_dilation(obstacle, disc))).T  # type: ignore[operator]


def _aim(passable: NDArray[np.bool_], before: NDArray[np.int64], at: Float, cell: NDArray[np.int64]) -> Float | None:
    """Where to walk straight to from a place `(2,)` on the way to a cell; None for who is there."""
    if np.hypot(*(cell + 0.5 - at)) * VOXEL_M < SPACING_M / 4:
        return None
    route = route_to(before, cell)
    return farthest_straight(passable, at, route) if len(route) else None


def _alike(found: _Candidates, views: Float) -> NDArray[np.bool_]:
    """`(k, YAWS, pitches)` whether candidates are like any of `(t, 4)` views: they will not show more."""
    places = np.linalg.norm((found.cells + 0.5) * VOXEL_M - views[:, None, :2], axis=-1) < SPACING_M / 2
    yaws = np.abs(wrap_angle(found.yaws - views[:, 2:3])) < np.pi / YAWS
    pitches = np.abs(found.pitches - views[:, 3:]) < _ALIKE_RAD
    return np.einsum("tk,ty,tp->kyp", places, yaws, pitches, dtype=np.int64) > 0


def _gains(grid: OccupancyGrid, found: _Candidates, view: AgentView) -> Float:
    """`(k, YAWS, pitches)` information gain of candidates, in voxels for each of a view's rays."""
    settings, cells = view.settings, found.cells
    eyes = np.zeros((len(cells), 3))
    eyes[:, [2, 0]] = (cells + 0.5) * VOXEL_M + grid.corner[[2, 0]]
    eyes[:, 1] = view.position[1] + settings.sensor_height_m
    elevations = np.radians(ELEVATIONS_DEG)
    yaw, elevation = (each.ravel() for each in np.meshgrid(found.yaws, elevations, indexing="ij"))
    directions = np.stack(
        [-np.sin(yaw) * np.cos(elevation), np.sin(elevation), -np.cos(yaw) * np.cos(elevation)], axis=1
    )
    rays = grid.gains(eyes, directions, settings.max_range_m, REAR_SIDE).reshape(len(cells), YAWS, len(elevations))
    weighted = rays * np.cos(elevations)
    camera = settings.intrinsics
    half_yaws = round(np.arctan(camera.width / 2 / camera.fx) / (2 * np.pi / YAWS))
    half_pitch = np.arctan(camera.height / 2 / camera.fy)
    around = sum(np.roll(weighted, shift, axis=1) for shift in range(-half_yaws, half_yaws + 1))
    shown = np.abs(elevations[:, None] - found.pitches) <= half_pitch
    rays_of_view = (2 * half_yaws + 1) * (np.cos(elevations)[:, None] * shown).sum(axis=0)
    return around @ shown.astype(np.float64) / rays_of_view


class NextBestViewPolicy(PlanningPolicy):
    """`nbv`: the next best view by volumetric information gain."""

    def make_planner(self, rng: np.random.Generator) -> NextBestViewPlanner:
        """For one episode; nothing is drawn at random."""
        return NextBestViewPlanner()
