"""The task for n agents at a time: actions, views, coverage, rewards and the ends of episodes, over arrays.

`AVPEnv` is n = 1, the batched vector environment is n > 1; this is the only place where the task's maths is put
together. Every step of an agent captures one view, also a step that does not move it.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from avp_habitat import poses
from avp_habitat.simulators.base import Simulator
from avp_habitat.surface.memory import RoomSurface
from avp_habitat.task import motion
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.cast import CastSensor, TableSensor
from avp_habitat.task.floor_map import MapObserver
from avp_habitat.task.observations import Agents, Observed, SceneAgents, Trail, make_observation
from avp_habitat.task.rewards import StepFacts, find_reward, has_stop, reward_parts, stops_episode
from avp_habitat.task.settings import MOVE_FORWARD, STOP, TaskSettings
from avp_habitat.task.trajectory import Trajectory
from avp_habitat.task.views import Shown, Views

Float = NDArray[np.floating]
Rows = NDArray[np.integer]


@dataclass(frozen=True)
class StepOutcome:
    """What one step of n agents gave; every array's first axis is n."""

    observation: Observed
    """As the settings' kind of observation says."""
    reward: NDArray[np.float64]
    """`(n,)` sum of the parts."""
    parts: dict[str, NDArray[np.float64]]
    """`(n,)` each named part of the reward."""
    terminated: NDArray[np.bool_]
    """`(n,)` stop was chosen, and ended the episode."""
    truncated: NDArray[np.bool_]
    """`(n,)` the budget ran out without such a stop."""
    facts: StepFacts
    """What the reward was computed from."""


@dataclass(frozen=True)
class _Room:
    """One scene and the agents in it."""

    simulator: Simulator
    sensor: CastSensor | TableSensor
    floor: MapObserver
    surface: RoomSurface | None


class ViewpointTask:
    """The state of n agents, each in its scene."""

    def __init__(self, simulators: Simulator | Sequence[Simulator], settings: TaskSettings, agents: int) -> None:
        """Make room for n agents, at least 1; `reset` places them.

        With several simulators, one for each scene, agent i is in scene i modulo their number.

        Raises:
            UsageError: the settings ask for what a simulator cannot do.
        """
        scenes = list(simulators) if isinstance(simulators, Sequence) else [simulators]
        self.settings = settings
        self.agents = agents
        self._reward = find_reward(settings.reward)
        self.kind = make_observation(settings)
        """The kind of observation; its `space` is of one agent."""
        self._everyone = np.arange(agents)
        # By number; `_room_of` holds each agent's.
        self._rooms: dict[int, _Room] = {}
        self._room_of = np.full(agents, -1)
        self._cells = np.zeros(agents, dtype=np.int64)
        self._diameter = np.zeros(agents)
        self.steps = np.zeros(agents, dtype=np.int64)
        self.position = np.zeros((agents, 3))
        self.yaw, self.pitch = np.zeros((2, agents))
        self._poses = np.zeros((agents, 4, 4))
        self._first_seen = np.zeros((agents, 0), dtype=np.int16)
        for index, scene in enumerate(scenes[:agents]):
            rows = self._everyone[index :: len(scenes)]
            self.enter(rows, self.add_scene(scene, rows))
        self._observed = np.zeros(agents, dtype=np.int64)
        self._collided = np.zeros(agents, dtype=np.bool_)
        # Row 0 is the start, row t the state after step t.
        self._path = np.zeros((agents, settings.budget + 1, 3))
        self._angles = np.zeros((agents, settings.budget + 1, 2))
        self._cell = np.zeros((agents, settings.budget + 1, 2), dtype=np.int64)
        self._gain = np.zeros((agents, settings.budget + 1, 2))
        self._log: dict[str, NDArray[np.float64]] = defaultdict(partial(np.zeros, (agents, settings.budget)))
        # By the names that the reward gives them, from the first step that has them; zero in all others.
        self._parts: dict[str, NDArray[np.float64]] = defaultdict(partial(np.zeros, (agents, settings.budget)))

    def add_scene(self, simulator: Simulator, rows: Rows) -> int:
        """Make a scene ready for some agents, `(k,)`, and give it the number by which they `enter` it.

        Raises:
            UsageError: the settings ask for what the simulator cannot do.
        """
        settings, wider = self.settings, len(simulator.area.centres) - self._first_seen.shape[1]
        sensor = TableSensor(simulator, settings) if settings.lookup else CastSensor(simulator, settings)
        surface = RoomSurface(simulator, settings, self.agents, rows) if settings.with_surface else None
        number = max(self._rooms, default=-1) + 1
        self._rooms[number] = _Room(simulator, sensor, MapObserver(simulator.area), surface)
        if wider > 0:
            self._first_seen = np.pad(self._first_seen, ((0, 0), (0, wider)))
        return number

    def enter(self, rows: Rows, number: int) -> None:
        """Take some agents, of those for whom it was added, to another scene; `reset` must place them there.

        A scene that its last agent leaves is forgotten.
        """
        left = set(self._room_of[rows].tolist())
        area = self._rooms[number].simulator.area
        self._room_of[rows], self._cells[rows], self._diameter[rows] = number, len(area.centres), area.diameter_m
        for empty in left.difference(self._room_of.tolist()):
            self._rooms.pop(empty, None)
        self._all_rooms = self._grouped(self._everyone)

    @property
    def simulators(self) -> list[Simulator]:
        """Those of all scenes, in the order in which they were added."""
        return [room.simulator for room in self._rooms.values()]

    def simulator(self, row: int) -> Simulator:
        """The simulator of one agent's scene."""
        return self._rooms[self._room_of[row]].simulator

    def first_seen(self, row: int) -> NDArray[np.int16]:
        """`(m,)` for each cell of one agent's scene, the step whose view first observed it; 0 for never."""
        return self._first_seen[row, : self._cells[row]]

    def surface_share(self, row: int) -> float | None:
        """Σ Q / m of one agent's episode: how well it has seen the scene's surface, within [0, 1].

        None where it is not computed: neither the reward nor the observation needs it.
        """
        surface = self._rooms[self._room_of[row]].surface
        return None if surface is None else float(surface.quality(row).mean())

    def centre_depth(self, row: int) -> float:
        """Planar depth in metres at an agent's newest view's middle pixel, the whole range where nothing is hit."""
        whole = self.settings.intrinsics
        column, line = whole.width // 2, whole.height // 2
        pixel = poses.Intrinsics(1, 1, whole.fx, whole.fy, whole.cx - column, whole.cy - line)
        pose = self._views(np.array([row])).camera_to_world
        return float(self.simulator(row).render(pose, pixel, rgb=False).depth[0, 0, 0]) or self.settings.max_range_m

    @property
    def coverage(self) -> NDArray[np.float64]:
        """`(n,)` C of the running episodes (Eq. 17)."""
        return self._observed / self._cells

    @property
    def camera_to_world(self) -> NDArray[np.float64]:
        """`(n, 4, 4)` the sensors' poses now, habitat axes."""
        return motion.sensor_poses(self.settings, self.position, self.yaw, self.pitch)

    def reset(self, rows: Sequence[int] | NDArray[np.integer], position: Float, yaw: Float) -> Observed:
        """Start new episodes of some agents, looking straight ahead; these views are not captured.

        Their feet are `(len(rows), 3)` metres, their yaw is `(len(rows),)` radians.
        """
        rows = np.asarray(rows, dtype=np.int64)
        self.position[rows], self.yaw[rows], self.pitch[rows] = position, poses.wrap_angle(yaw), 0.0
        self.steps[rows], self._first_seen[rows], self._collided[rows], self._observed[rows] = 0, 0, False, 0
        self._remember(rows)
        for room, chosen in self._by_room(rows):
            if room.surface is not None:
                room.surface.reset(rows[chosen])
        seen = self._shown(rows, lambda room, there: room.sensor.look(self._views(there)))
        return self._observe(rows, seen, np.zeros(len(rows)))

    def step(self, actions: NDArray[np.integer]) -> StepOutcome:
        """Advance every agent by one of `(n,)` actions, numbers of `settings.ACTION_NAMES`, and one captured view."""
        actions = np.asarray(actions)
        self._collided = self._move(actions)
        self.steps += 1
        self._remember(self._everyone)
        seen = self._shown(self._everyone, self._capture)
        self._observed += seen.new_cells
        facts = self._facts(actions, seen.new_cells, self._capture_surface())
        parts = reward_parts(self._reward, facts, self.settings.constants)
        reward = np.sum(list(parts.values()), axis=0) + np.zeros(self.agents)
        terminated = stops_episode(self._reward, facts, self.settings.constants)
        self._record(actions, reward, parts, facts)
        return StepOutcome(
            observation=self._observe(self._everyone, seen, facts.spread_m),
            reward=reward,
            parts=parts,
            terminated=terminated,
            truncated=(self.steps >= self.settings.budget) & ~terminated,
            facts=facts,
        )

    def trajectory(self, row: int) -> Trajectory:
        """Copies of what one agent did so far in its episode."""
        steps = int(self.steps[row])
        position = self._path[row, 1 : steps + 1].copy()
        yaw, pitch = self._angles[row, 1 : steps + 1].T.copy()
        return Trajectory(
            start=self._path[row, 0].copy(),
            position=position,
            yaw=yaw,
            pitch=pitch,
            camera_to_world=motion.sensor_poses(self.settings, position, yaw, pitch),
            action=self._log["action"][row, :steps].astype(np.int64),
            reward=self._log["reward"][row, :steps].copy(),
            reward_parts={name: values[row, :steps].copy() for name, values in self._parts.items()},
            coverage=self._log["coverage"][row, :steps].copy(),
            collided=self._log["collided"][row, :steps].astype(np.bool_),
            redundant=self._log["redundant"][row, :steps].astype(np.bool_),
            first_seen=self.first_seen(row).copy(),
            surface=self.surface_share(row),
        )

    def agent_view(self, row: int) -> AgentView:
        """What planners may know about one agent."""
        return AgentView(
            settings=self.settings,
            simulator=self.simulator(row),
            position=self.position[row].copy(),
            yaw=float(self.yaw[row]),
            pitch=float(self.pitch[row]),
            steps=int(self.steps[row]),
            observed=self.first_seen(row) > 0,
            centre_depth=self.centre_depth(row),
            collided=bool(self._collided[row]),
        )

    def _by_room(self, rows: Rows) -> list[tuple[_Room, NDArray[np.integer]]]:
        """The rooms of some agents, and which of those agents are in each."""
        return self._all_rooms if rows is self._everyone else self._grouped(rows)

    def _grouped(self, rows: Rows) -> list[tuple[_Room, NDArray[np.integer]]]:
        rooms = self._room_of[rows]
        return [(self._rooms[index], np.flatnonzero(rooms == index)) for index in np.unique(rooms) if index >= 0]

    def _views(self, rows: Rows) -> Views:
        return Views(self.position[rows], self.yaw[rows], self.pitch[rows], self._poses[rows])

    def _remember(self, rows: Rows) -> None:
        """Enter where some agents are now into their paths, and where their cameras are."""
        steps = self.steps[rows]
        self._poses[rows] = motion.sensor_poses(self.settings, self.position[rows], self.yaw[rows], self.pitch[rows])
        self._path[rows, steps] = self.position[rows]
        self._angles[rows, steps, 0], self._angles[rows, steps, 1] = self.yaw[rows], self.pitch[rows]
        for room, chosen in self._by_room(rows):
            self._cell[rows[chosen], steps[chosen]] = room.simulator.area.cell_of(self.position[rows[chosen]])

    def _move(self, actions: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Apply the actions; `(n,)` whether a forward move was blocked."""
        self.yaw, self.pitch = motion.turn(self.settings, actions, self.yaw, self.pitch)
        collided = np.zeros(self.agents, dtype=np.bool_)
        walking = np.flatnonzero(actions == MOVE_FORWARD)
        for room, chosen in self._by_room(walking):
            rows = walking[chosen]
            before = self.position[rows]
            after = motion.walk(room.simulator.area, self.settings, actions[rows], before, self.yaw[rows])
            collided[rows] = np.linalg.norm((after - before)[:, [0, 2]], axis=1) < self.settings.collision_m
            self.position[rows] = after
        return collided

    def _shown(self, rows: Rows, sense: Callable[[_Room, Rows], Shown]) -> Shown:
        """What the newest views of some agents show, as `sense` finds it for those in one room."""
        if len(self._rooms) == 1:
            return sense(next(iter(self._rooms.values())), rows)
        least, mean = np.empty((2, len(rows)))
        whole = Shown(least, mean, np.empty(len(rows), dtype=np.int64))
        for room, chosen in self._by_room(rows):
            part = sense(room, rows[chosen])
            whole.least[chosen], whole.mean[chosen], whole.new_cells[chosen] = part.least, part.mean, part.new_cells
        return whole

    def _capture(self, room: _Room, rows: Rows) -> Shown:
        return room.sensor.capture(self._views(rows), self._first_seen, rows, self.steps[rows])

    def _capture_surface(self) -> NDArray[np.float64]:
        """Enter ΔQ and ΔS of the newest views into the log, give `RoomSurface.capture`; zeros for nothing."""
        surface = np.zeros((self.agents, 2, 4))
        for room, rows in self._by_room(self._everyone):
            if room.surface is not None:
                surface[rows] = room.surface.capture(self._views(rows), rows)
        self._gain[self._everyone, self.steps] = surface[:, 0, :2]
        return surface

    def _facts(self, actions: NDArray[np.integer], new_cells: NDArray[np.integer], surface: Float) -> StepFacts:
        past = motion.history(self._path, self._angles, self._cell, self.steps, self.settings.constants)
        gain, share = surface[:, 0].T, surface[:, 1].T
        return StepFacts(
            new_cells=new_cells,
            new_surface=gain[0],
            **past._asdict(),
            collided=self._collided,
            stop_chosen=(actions == STOP) & has_stop(self._reward),
            coverage=self.coverage,
            steps_left=self.settings.budget - self.steps,
            new_shown=gain[2],
            new_shown_twice=gain[3],
            surface=share[0],
            shown=share[2],
            shown_twice=share[3],
        )

    def _observe(self, rows: Rows, seen: Shown, spread_m: NDArray[np.number]) -> Observed:
        agents = Agents(
            settings=self.settings,
            steps=self.steps[rows],
            start=self._path[rows, 0],
            position=self.position[rows],
            yaw=self.yaw[rows],
            pitch=self.pitch[rows],
            min_depth=seen.least,
            mean_depth=seen.mean,
            coverage=self.coverage[rows],
            collided=self._collided[rows],
            spread_m=np.asarray(spread_m, dtype=np.float64),
            diameter_m=self._diameter[rows],
            trail=partial(self._trail, rows),
            _by_scene=partial(self._scenes, rows),
        )
        return self.kind(agents)

    def _trail(self, rows: Rows) -> Trail:
        return Trail(self._path[rows], self._angles[rows], self._gain[rows], self._log["action"][rows])

    def _scenes(self, rows: Rows) -> list[SceneAgents]:
        scenes = []
        for room, chosen in self._by_room(rows):
            there = rows[chosen]
            views = self._views(there)
            scenes.append(SceneAgents(room.simulator, chosen, views, there, self._first_seen, room.floor, room.surface))
        return scenes

    def _record(self, actions: NDArray, reward: NDArray, parts: dict[str, NDArray], facts: StepFacts) -> None:
        now = (self._everyone, self.steps - 1)
        columns = {"action": actions, "reward": reward} | vars(facts)
        for name in ("action", "reward", "coverage", "collided", "redundant"):
            self._log[name][now] = columns[name]
        for name in dict.fromkeys([*self._parts, *parts]):
            self._parts[name][now] = parts.get(name, 0.0)
