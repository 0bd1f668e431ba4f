"""Greedy set cover over a grid of poses, joined by shortest paths: the oracle's first plan."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from avp_habitat.policies.oracle.places import ScenePlaces, views_from
from avp_habitat.policies.oracle.search import States
from avp_habitat.poses import wrap_angle
from avp_habitat.sight.bits import Bits, gains
from avp_habitat.task.motion import act
from avp_habitat.task.settings import LOOK_DOWN, LOOK_UP, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT, TaskSettings

Float = NDArray[np.float64]

POSE_SPACING_M = 0.5
"""Between the positions of the poses, metres."""
HEADINGS = 12
"""Of the poses at each position."""
PITCHES_DEG = (0.0, -20.0, -40.0)
"""Of the poses, degrees; those within the task's limit are used."""
_AHEAD_M = 0.8
_ARRIVED_M = 0.2


def greedy_cover(sets: Bits, wanted: Bits) -> list[int]:
    """Take the set that adds most, again and again, until nothing is added.

    After any k sets the cover is at least 1 - 1/e of the largest that k sets reach (Nemhauser, Wolsey and Fisher
    1978, "An analysis of approximations for maximizing submodular set functions", proposition 4.3).

    Args:
        sets: `(n, words)` bit sets.
        wanted: `(words,)` the members that count.

    Returns:
        Numbers of the chosen sets in the order of choice; of equals the first.
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
    """Every combination of position, heading and pitch.

    Args:
        places: of the scene.
        settings: of the task.
        yaw: one of the headings, radians; the agent's own makes them reachable.
    """
    corner = np.floor(places.position[:, [0, 2]] / POSE_SPACING_M)
    chosen = np.sort(np.unique(corner, axis=0, return_index=True)[1])
    turns = yaw + 2 * np.pi * np.arange(HEADINGS) / HEADINGS
    pitches = np.radians([pitch for pitch in PITCHES_DEG if abs(pitch) <= settings.pitch_limit_deg])
    place, turn, pitch = (grid.ravel() for grid in np.meshgrid(chosen, wrap_angle(turns), pitches, indexing="ij"))
    return Poses(place, turn, pitch, views_from(places, settings, places.position[place], turn, pitch))


def covering_tour(places: ScenePlaces, settings: TaskSettings, start: States, views: int) -> NDArray[np.int64]:
    """Visit the poses of a greedy set cover, next the one that still adds most cells per step of the way to it.

    Args:
        places: of the scene.
        settings: of the task.
        start: one state.
        views: number of actions.

    Returns:
        `(views,)` actions; turns to the left when nothing is left to be seen.
    """
    poses = all_poses(places, settings, yaw=float(start.yaw[0]))
    chosen = np.array(greedy_cover(poses.sets, places.wanted & ~start.seen[0]), dtype=np.int64)
    walk = _Walk(places, settings, start, views)
    graph = _graph(places)
    while len(walk.actions) < views:
        gain = gains(poses.sets[chosen], places.wanted & ~walk.seen)
        chosen, gain = chosen[gain > 0], gain[gain > 0]
        steps = walk.steps_to(graph, poses, chosen)
        if not np.isfinite(steps).any():
            break
        best = int(np.argmax(gain / steps))
        walk.go(graph, int(poses.place[chosen[best]]))
        walk.face(float(poses.yaw[chosen[best]]), float(poses.pitch[chosen[best]]))
        chosen = np.delete(chosen, best)
    return np.array(walk.actions + [TURN_LEFT] * (views - len(walk.actions)), dtype=np.int64)


def _graph(places: ScenePlaces) -> csr_array:
    """`(p, p)` lengths in metres of the ways between neighbouring places."""
    begin, slot = np.nonzero(places.neighbours >= 0)
    entries = (places.lengths_m[begin, slot], (begin, places.neighbours[begin, slot]))
    return csr_array(entries, shape=(len(places.position),) * 2)


class _Walk:
    """One agent's actions so far, and where they have led."""

    def __init__(self, places: ScenePlaces, settings: TaskSettings, start: States, views: int) -> None:
        self._places, self._settings, self._views = places, settings, views
        self.position, self.yaw, self.pitch = start.position, start.yaw, start.pitch
        self.seen = start.seen[0].copy()
        self.actions: list[int] = []

    def steps_to(self, graph: csr_array, poses: Poses, chosen: NDArray[np.int64]) -> Float:
        """`(len(chosen),)` steps to poses, at least 1; not finite where no way leads."""
        here = int(self._places.nearest(self.position)[0])
        settings = self._settings
        walking = dijkstra(graph, indices=here)[poses.place[chosen]] / settings.forward_m
        turning = np.abs(wrap_angle(poses.yaw[chosen] - self.yaw[0])) / np.radians(settings.turn_deg)
        tilting = np.abs(poses.pitch[chosen] - self.pitch[0]) / np.radians(settings.tilt_deg)
        return np.maximum(walking + turning + tilting, 1.0)

    def go(self, graph: csr_array, goal: int) -> None:
        """Walk to a place; gives up where the walls do not let the agent through as the places do."""
        length, towards = dijkstra(graph, indices=goal, return_predecessors=True)
        here = int(self._places.nearest(self.position)[0])
        patience = 3 * int(length[here] / self._settings.forward_m) + 36
        for _ in range(patience):
            if self._distance(goal) <= max(_ARRIVED_M, self._settings.forward_m / 2) or self._over:
                return
            aim = self._ahead(towards, length)
            offset = self._places.position[aim] - self.position[0]
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

    def _distance(self, place: int) -> float:
        return float(np.linalg.norm((self._places.position[place] - self.position[0])[[0, 2]]))

    def _ahead(self, towards: NDArray[np.integer], length: Float) -> int:
        """The place some way ahead on the shortest path from here."""
        here = at = int(self._places.nearest(self.position)[0])
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
