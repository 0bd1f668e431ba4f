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
from avp_habitat.poses import Intrinsics, heading, wrap_angle
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.settings import LOOK_DOWN, LOOK_UP, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT

Float = NDArray[np.float64]

RAYS = 36
"""Directions of rays around a candidate place; of the views from there at most as many."""
ELEVATIONS_DEG = np.arange(-70.0, 71.0, 10.0)
"""Of those rays."""
STEEPEST_DEG, PITCH_STEP_DEG = 30.0, 10.0
"""Greatest pitch of the views, and about how far apart they are."""
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
_DEPTH_WIDTH = 160
_BODY_M = 0.2
_NEAR_M = 0.4
_HEAD_M, _STEP_M = 1.5, 0.2
"""What is occupied between these heights above the floor blocks the way."""


@dataclass(frozen=True)
class _Candidates:
    """k reachable places, each with views in the directions that turns and tilts can reach."""

    places: Float
    """`(k, 2)` z and x, metres."""
    aims: list[Float | None]
    """Where to walk straight to on the way, in cells; None at the place where the agent is."""
    first: NDArray[np.floating]
    """`(k,)` radians by which to turn to face the aim."""
    yaws: Float
    """`(y,)` radians; whole turns from the agent's."""
    pitches: Float
    """`(p,)` radians; whole tilts from the agent's, up to the task's limit."""
    apart: tuple[float, float]
    """How far yaws, and pitches, have to be apart to be other ones, radians."""
    actions: Float
    """`(k, y, p)` how many it takes to get there, at least 1."""


class NextBestViewPlanner:
    """Of one agent within one episode."""

    def __init__(self) -> None:
        """Know nothing yet."""
        self._grid: OccupancyGrid | None = None
        self._blocked: list[Float] = []
        # z and x in metres, yaw and pitch in radians: of the goal, and of all views taken.
        self._goal: Float | None = None
        self._taken = np.zeros((0, 4))

    def act(self, view: AgentView) -> int:
        """The next action."""
        settings, pose = view.settings, view.camera_to_world
        grid = self._grid = self._grid or OccupancyGrid(view.position, settings.max_range_m)
        grid.cover(view.position, settings.max_range_m)
        height = max(1, round(_DEPTH_WIDTH * settings.height / settings.width))
        camera = Intrinsics.from_hfov(_DEPTH_WIDTH, height, hfov_deg=settings.hfov_deg)
        depth = view.simulator.render(pose[None], camera, rgb=False).depth[0]
        grid.integrate(depth, pose, camera, settings.max_range_m)
        if view.collided:
            self._blocked.append(view.position + heading(np.array(view.yaw)) * (_BODY_M + VOXEL_M))
        self._taken = np.concatenate([self._taken, [[*view.position[[2, 0]], view.yaw, view.pitch]]])
        found = self._candidates(view, grid)
        gain = _gains(grid, found, view)
        worth = np.where((gain >= _LEAST_GAIN) & ~_alike(found, self._taken), gain / found.actions, 0.0)
        if self._goal is not None:
            worth[_alike(found, self._goal[None])] /= LOYALTY
        best = np.unravel_index(worth.argmax(), worth.shape)
        if worth[best] <= 0:
            self._goal = None
            return TURN_LEFT
        place, yaw, pitch = (int(index) for index in best)
        self._goal = np.array([*found.places[place], found.yaws[yaw], found.pitches[pitch]])
        return self._action(view, found, place, float(found.yaws[yaw]), float(found.pitches[pitch]))

    @staticmethod
    def _action(view: AgentView, found: _Candidates, place: int, yaw: float, pitch: float) -> int:
        """The first move, tilt or turn on the way to a candidate."""
        turn = np.radians(view.settings.turn_deg)
        if found.aims[place] is not None:
            angle = found.first[place]
            return MOVE_FORWARD if abs(angle) <= turn / 2 + 1e-9 else (TURN_LEFT if angle > 0 else TURN_RIGHT)
        if abs(pitch - view.pitch) > 1e-6:
            return LOOK_UP if pitch > view.pitch else LOOK_DOWN
        return TURN_LEFT if wrap_angle(np.array(yaw - view.yaw)) >= 0 else TURN_RIGHT

    def _candidates(self, view: AgentView, grid: OccupancyGrid) -> _Candidates:
        """The nearest reachable places a spacing apart, by walk, the agent's own first."""
        settings, passable = view.settings, self._passable(view, grid)
        at = (view.position - grid.corner)[[2, 0]] / VOXEL_M
        length, before = shortest_walks(passable, *map(int, at))
        every = round(SPACING_M / VOXEL_M)
        row, column = (int(cell) % every for cell in at)
        cells = np.argwhere(np.isfinite(length[row::every, column::every])) * every + [row, column]
        cells = cells[np.argsort(length[tuple(cells.T)], kind="stable")][:MOST_PLACES]
        aims = [_aim(passable, before, at, cell) for cell in cells]
        headings = np.array([view.yaw if aim is None else np.arctan2(at[1] - aim[1], at[0] - aim[0]) for aim in aims])
        turn, tilt = np.radians([settings.turn_deg, settings.tilt_deg])
        yaws, pitches = _yaws(view.yaw, turn), _pitches(view, tilt)
        first = wrap_angle(headings - view.yaw)
        turns = np.abs(wrap_angle(yaws - headings[:, None])) + np.abs(first)[:, None]
        tilts = np.abs(pitches - view.pitch) / tilt
        moves = length[tuple(cells.T)] * VOXEL_M / settings.forward_m
        actions = moves[:, None, None] + turns[:, :, None] / turn + tilts
        apart = max(turn, 2 * np.pi / RAYS) / 2, max(tilt, np.radians(PITCH_STEP_DEG)) / 2
        places = (cells + 0.5) * VOXEL_M + grid.corner[[2, 0]]
        return _Candidates(places, aims, first, yaws, pitches, apart, np.maximum(actions, 1.0))

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


def _yaws(yaw: float, turn: float) -> Float:
    """`(y,)` yaws that whole turns reach, no denser than the rays."""
    every = max(1, int(2 * np.pi / RAYS / turn + 1e-6)) * turn
    return np.asarray(yaw + every * np.arange(max(1, round(2 * np.pi / every))), np.float64)


def _pitches(view: AgentView, tilt: float) -> Float:
    """`(p,)` pitches that whole tilts reach, the agent's own among them."""
    every = max(1, round(np.radians(PITCH_STEP_DEG) / tilt)) * tilt
    limit, count = np.radians(view.settings.pitch_limit_deg), int(np.pi / every)
    found = np.clip(view.pitch + every * np.arange(-count, count + 1), -limit, limit)
    level = np.abs(found) <= np.radians(STEEPEST_DEG) + 1e-6
    return np.unique(np.asarray([*found[level], view.pitch], np.float64))


def _aim(passable: NDArray[np.bool_], before: NDArray[np.int64], at: Float, cell: NDArray[np.int64]) -> Float | None:
    """Where to walk straight to from a place `(2,)` on the way to a cell; None for who is there."""
    if np.hypot(*(cell + 0.5 - at)) * VOXEL_M < SPACING_M / 4:
        return None
    route = route_to(before, cell)
    return farthest_straight(passable, at, route) if len(route) else None


def _alike(found: _Candidates, views: Float) -> NDArray[np.bool_]:
    """`(k, y, p)` whether candidates are like any of `(t, 4)` views: they will not show more."""
    places = np.linalg.norm(found.places - views[:, None, :2], axis=-1) < SPACING_M / 2
    yaws = np.abs(wrap_angle(found.yaws - views[:, 2:3])) < found.apart[0]
    pitches = np.abs(found.pitches - views[:, 3:]) < found.apart[1]
    return np.einsum("tk,ty,tp->kyp", places, yaws, pitches, dtype=np.int64) > 0


def _gains(grid: OccupancyGrid, found: _Candidates, view: AgentView) -> Float:
    """`(k, y, p)` information gain of candidates, in voxels for each of a view's rays."""
    settings = view.settings
    eyes = np.zeros((len(found.places), 3))
    eyes[:, [2, 0]] = found.places
    eyes[:, 1] = view.position[1] + settings.sensor_height_m
    elevations = np.radians(ELEVATIONS_DEG)
    around = view.yaw + np.arange(RAYS) * 2 * np.pi / RAYS
    yaw, elevation = (each.ravel() for each in np.meshgrid(around, elevations, indexing="ij"))
    directions = heading(yaw, elevation)
    rays = grid.gains(eyes, directions, settings.max_range_m, REAR_SIDE).reshape(len(eyes), RAYS, len(elevations))
    camera, solid = settings.intrinsics, np.cos(elevations)
    half_yaw = max(np.arctan(camera.width / 2 / camera.fx), np.pi / RAYS)
    half_pitch = max(np.arctan(camera.height / 2 / camera.fy), np.radians(5.0))
    across = np.abs(wrap_angle(around[:, None] - found.yaws)) <= half_yaw + 1e-6
    along = (np.abs(elevations[:, None] - found.pitches) <= half_pitch + 1e-6) * solid[:, None]
    seen = np.einsum("kre,ry,ep->kyp", rays, across.astype(float), along, optimize=True)
    return seen / (across.sum(axis=0)[:, None] * along.sum(axis=0))


class NextBestViewPolicy(PlanningPolicy):
    """`nbv`: the next best view by volumetric information gain."""

    def make_planner(self, rng: np.random.Generator) -> NextBestViewPlanner:
        """For one episode; nothing is drawn at random."""
        return NextBestViewPlanner()
