"""The oracle's two kinds of plans, over its tables: by beam search, and by the tour of a greedy set cover."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from avp_habitat.policies.oracle import kernels
from avp_habitat.policies.oracle.places import ScenePlaces, new_views, views_from
from avp_habitat.poses import wrap_angle
from avp_habitat.sight.bits import Bits, gains, pack
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.motion import act
from avp_habitat.task.settings import LOOK_DOWN, LOOK_UP, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT, TaskSettings

Float = NDArray[np.float64]

POSE_SPACING_M = 0.5
"""Of a tour: between the positions of the poses, metres."""
HEADINGS = 12
"""Of a tour: of the poses at each position."""
PITCHES_DEG = (0.0, -20.0, -40.0)
"""Of a tour's poses, degrees; those within the task's limit are used."""

PER_KEY = 2
"""Of a beam search: states kept of those that stand and look alike."""
PACE = 2.0
"""Of a beam search: steps counted for each step of the shortest way to a cell not yet seen; above 1, because one walk
cannot take the shortest way to all cells at once."""

_MOVES = np.array([MOVE_FORWARD, TURN_LEFT, TURN_RIGHT, LOOK_UP, LOOK_DOWN])
_AHEAD_M = 0.8
_ARRIVED_M = 0.2


@dataclass(frozen=True)
class States:
    """n agents that have taken equally many views; every array's first axis is n."""

    position: Float
    """`(n, 3)` feet, metres."""
    yaw: Float
    """`(n,)` radians."""
    pitch: Float
    """`(n,)` radians."""
    seen: Bits
    """`(n, words)` sets of the observed cells."""
    value: Float
    """`(n,)` cells times views: what the new cells add to the area under the curve of observed cells over views."""


def start_state(view: AgentView, members: int) -> States:
    """An agent that has seen no more than the floor cells that it has observed; so many members its bit set has."""
    seen = np.zeros((1, members), dtype=np.bool_)
    seen[0, : len(view.observed)] = view.observed
    return States(view.position[None], np.array([view.yaw]), np.array([view.pitch]), pack(seen), np.zeros(1))


def beam_search(
    places: ScenePlaces, settings: TaskSettings, start: States, views: int, width: int
) -> NDArray[np.int64]:
    """The `(views,)` actions that make the area under the curve of coverage over views as large as the beam finds.

    They never stop. The best `width` states are kept after each step, ranked by the area that is certain, plus, for
    every cell not yet seen, the views that would be left if the agent turned and walked straight to where that cell is
    in sight.
    """
    states, history = start, []
    for left in range(views - 1, -1, -1):
        states, parent, action = _advance(places, settings, states, left, width)
        history.append((parent, action))
    return back_from(int(np.argmax(states.value)), history)


def back_from(row: int, history: list[tuple[NDArray[np.int64], NDArray[np.int64]]]) -> NDArray[np.int64]:
    """The actions that lead to a row of the last states, by each step's parents and actions."""
    actions = []
    for parent, action in reversed(history):
        actions.append(action[row])
        row = parent[row]
    return np.array(actions[::-1], dtype=np.int64)


@dataclass(frozen=True)
class Moves:
    """c candidates: what k states can do next, and where that leads; every array's first axis is c."""

    parent: NDArray[np.int64]
    """`(c,)` rows of the states."""
    action: NDArray[np.int64]
    """`(c,)` numbers of `settings.ACTION_NAMES`; never stop."""
    position: Float
    """`(c, 3)` feet, metres."""
    yaw: Float
    """`(c,)` radians."""
    pitch: Float
    """`(c,)` radians."""
    place: NDArray[np.int64]
    """`(c,)` numbers of the nearest places."""
    heading: NDArray[np.uint8]
    """`(c,)` the yaw in 256ths of a turn."""
    key: NDArray[np.int64]
    """`(c,)` alike for candidates that stand and look alike."""


def all_moves(places: ScenePlaces, settings: TaskSettings, position: Float, yaw: Float, pitch: Float) -> Moves:
    """Every useful action of k agents: `(k, 3)` feet in metres, `(k,)` angles in radians."""
    n = len(yaw)
    parent, action = np.tile(np.arange(n), len(_MOVES)), np.repeat(_MOVES, n)
    limit, before = np.radians(settings.pitch_limit_deg) - 1e-9, pitch[parent]
    useful = ~(((action == LOOK_UP) & (before >= limit)) | ((action == LOOK_DOWN) & (before <= -limit)))
    parent, action = parent[useful], action[useful]
    position, yaw, pitch = act(places.area, settings, action, position[parent], yaw[parent], pitch[parent])
    place = places.nearest(position)
    heading = (np.round(yaw / (2 * np.pi) * 256).astype(np.int64) & 255).astype(np.uint8)
    turn = np.round(wrap_angle(yaw) / np.radians(settings.turn_deg)).astype(np.int64)
    tilt = np.round(pitch / np.radians(settings.tilt_deg)).astype(np.int64)
    key = 1 + (place * 4096 + turn + 2048) * 4096 + tilt + 2048
    return Moves(parent, action, position, yaw, pitch, place, heading, key)


def _advance(
    places: ScenePlaces, settings: TaskSettings, states: States, left: int, width: int
) -> tuple[States, NDArray[np.int64], NDArray[np.int64]]:
    """The states after one more view, the rows that they come from, and the actions that lead to them."""
    moves = all_moves(places, settings, states.position, states.yaw, states.pitch)
    parent, position, yaw, pitch = moves.parent, moves.position, moves.yaw, moves.pitch
    fresh, gain = new_views(places, settings, parent, position, yaw, pitch, states.seen)
    value = states.value[parent] + (left + 1) * gain
    seen = states.seen[parent] | fresh
    unseen = places.wanted & ~seen
    hope = kernels.outlook(
        moves.place, moves.heading, unseen, places.reach, places.heading, *turning(settings), left, PACE
    )
    kept = kernels.choose(np.argsort(-(value + hope), kind="stable"), moves.key, seen, width, PER_KEY)
    return States(position[kept], yaw[kept], pitch[kept], seen[kept], value[kept]), parent[kept], moves.action[kept]


def turning(settings: TaskSettings) -> tuple[Float, Float]:
    """`(256,)` steps of turning for each difference of heading: until a cell is in the image, and until it is ahead."""
    apart = np.abs((np.arange(256) + 128) % 256 - 128) * 360 / 256
    near = np.maximum(apart - settings.hfov_deg / 2, 0) / settings.turn_deg
    return near, apart / settings.turn_deg


def greedy_cover(sets: Bits, wanted: Bits) -> list[int]:
    """Take the set that adds most of the `(words,)` wanted members, again and again, until nothing is added.

    After any k sets the cover is at least 1 - 1/e of the largest that k sets reach (Nemhauser, Wolsey and Fisher
    1978, "An analysis of approximations for maximizing submodular set functions", proposition 4.3).

    Returns:
        Numbers of the chosen of `(n, words)` bit sets in the order of choice; of equals the first.
    """
    chosen: list[int] = []
    missing = wanted.copy()
    while len(sets):
        gain = gains(sets, missing)
        best = int(np.argmax(gain))
        if gain[best] == 0:
            break
        chosen.append(best)
        missing &= ~sets[best]
    return chosen


@dataclass(frozen=True)
class Poses:
    """q poses of cameras and what they see."""

    place: NDArray[np.int64]
    """`(q,)` numbers of the places."""
    yaw: Float
    """`(q,)` radians."""
    pitch: Float
    """`(q,)` radians."""
    sets: Bits
    """`(q, words)` cells that each pose observes."""


def all_poses(places: ScenePlaces, settings: TaskSettings, *, yaw: float) -> Poses:
    """Every combination of position, heading and pitch; `yaw`, in radians, is one of the headings.

    With the agent's own yaw all of them are reachable.
    """
    corner = np.floor(places.position[:, [0, 2]] / POSE_SPACING_M)
    chosen = np.sort(np.unique(corner, axis=0, return_index=True)[1])
    turns = yaw + 2 * np.pi * np.arange(HEADINGS) / HEADINGS
    pitches = np.radians([pitch for pitch in PITCHES_DEG if abs(pitch) <= settings.pitch_limit_deg])
    place, turn, pitch = (grid.ravel() for grid in np.meshgrid(chosen, wrap_angle(turns), pitches, indexing="ij"))
    return Poses(place, turn, pitch, views_from(places, settings, places.position[place], turn, pitch))


def covering_tour(places: ScenePlaces, settings: TaskSettings, start: States, views: int) -> NDArray[np.int64]:
    """Visit the poses of a greedy set cover, next the one that still adds most cells per step of the way to it.

    Returns:
        `(views,)` actions; turns to the left when nothing is left to be seen.
    """
    poses = all_poses(places, settings, yaw=float(start.yaw[0]))
    chosen = np.array(greedy_cover(poses.sets, places.wanted & ~start.seen[0]), dtype=np.int64)
    walk = _Walk(places, settings, start, views)
    while len(walk.actions) < views:
        gain = gains(poses.sets[chosen], places.wanted & ~walk.seen)
        chosen, gain = chosen[gain > 0], gain[gain > 0]
        steps = walk.steps_to(poses, chosen)
        if not np.isfinite(steps).any():
            break
        best = int(np.argmax(gain / steps))
        walk.go(int(poses.place[chosen[best]]))
        walk.face(float(poses.yaw[chosen[best]]), float(poses.pitch[chosen[best]]))
        chosen = np.delete(chosen, best)
    return np.array(walk.actions + [TURN_LEFT] * (views - len(walk.actions)), dtype=np.int64)


class _Walk:
    """One agent's actions so far, and where they have led."""

    def __init__(self, places: ScenePlaces, settings: TaskSettings, start: States, views: int) -> None:
        self._places, self._settings, self._views = places, settings, views
        self.position, self.yaw, self.pitch = start.position, start.yaw, start.pitch
        self.seen = start.seen[0].copy()
        self.actions: list[int] = []
        begin, slot = np.nonzero(places.neighbours >= 0)
        ways = (places.lengths_m[begin, slot], (begin, places.neighbours[begin, slot]))
        self._graph = csr_array(ways, shape=(len(places.position),) * 2)

    def steps_to(self, poses: Poses, chosen: NDArray[np.int64]) -> Float:
        """`(len(chosen),)` steps to poses, at least 1; not finite where no way leads."""
        settings = self._settings
        walking = dijkstra(self._graph, indices=self._here)[poses.place[chosen]] / settings.forward_m
        turning = np.abs(wrap_angle(poses.yaw[chosen] - self.yaw[0])) / np.radians(settings.turn_deg)
        tilting = np.abs(poses.pitch[chosen] - self.pitch[0]) / np.radians(settings.tilt_deg)
        return np.maximum(walking + turning + tilting, 1.0)

    def go(self, goal: int) -> None:
        """Walk to a place; gives up where the walls do not let the agent through as the places do."""
        length, towards = dijkstra(self._graph, indices=goal, return_predecessors=True)
        arrived_m = max(_ARRIVED_M, self._settings.forward_m / 2)
        patience = 3 * int(length[self._here] / self._settings.forward_m) + 36
        for _ in range(patience):
            if np.linalg.norm((self._places.position[goal] - self.position[0])[[0, 2]]) <= arrived_m or self._over:
                return
            offset = self._places.position[self._ahead(towards, length)] - self.position[0]
            if not self._turn(float(np.arctan2(-offset[0], -offset[2]))):
                self._act(MOVE_FORWARD)

    def face(self, yaw: float, pitch: float) -> None:
        """Turn and tilt until the angles, in radians, are as near as the amounts allow."""
        while not self._over and self._turn(yaw):
            pass
        tilt = np.radians(self._settings.tilt_deg)
        for _ in range(abs(round((pitch - self.pitch[0]) / tilt))):
            if not self._over:
                self._act(LOOK_UP if pitch > self.pitch[0] else LOOK_DOWN)

    @property
    def _over(self) -> bool:
        return len(self.actions) >= self._views

    @property
    def _here(self) -> int:
        return int(self._places.nearest(self.position)[0])

    def _ahead(self, towards: NDArray[np.integer], length: Float) -> int:
        """The place some way ahead on the shortest path from here."""
        here = at = self._here
        while towards[at] >= 0 and length[here] - length[at] < _AHEAD_M:
            at = int(towards[at])
        return at

    def _turn(self, yaw: float) -> bool:
        """Turn one step towards a heading in radians; whether there was need to."""
        off, turn = float(wrap_angle(yaw - self.yaw[0])), np.radians(self._settings.turn_deg)
        if abs(off) <= turn / 2 + 1e-9:
            return False
        self._act(TURN_LEFT if off > 0 else TURN_RIGHT)
        return True

    def _act(self, action: int) -> None:
        state = act(self._places.area, self._settings, np.array([action]), self.position, self.yaw, self.pitch)
        self.position, self.yaw, self.pitch = state
        self.seen |= views_from(self._places, self._settings, *state)[0]
        self.actions.append(action)
