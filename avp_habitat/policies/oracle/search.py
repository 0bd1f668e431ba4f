"""Action sequences by beam search over the oracle's tables."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.navigation.area import NavigableArea
from avp_habitat.policies.oracle import kernels
from avp_habitat.policies.oracle.places import ScenePlaces, new_views
from avp_habitat.poses import wrap_angle
from avp_habitat.sight.bits import Bits
from avp_habitat.task.motion import act
from avp_habitat.task.settings import LOOK_DOWN, LOOK_UP, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT, TaskSettings

Float = NDArray[np.float64]
_MOVES = np.array([MOVE_FORWARD, TURN_LEFT, TURN_RIGHT, LOOK_UP, LOOK_DOWN])


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


def start_state(position: Float, seen: Bits, *, yaw: float, pitch: float) -> States:
    """One agent at `(3,)` metres that has seen the bit set `(words,)`; angles in radians."""
    return States(
        np.asarray(position, dtype=np.float64)[None], np.array([yaw]), np.array([pitch]), seen[None].copy(), np.zeros(1)
    )


@dataclass(frozen=True)
class BeamSettings:
    """How widely to search, and what to hope for."""

    width: int = 1000
    """States kept after each step."""
    per_key: int = 2
    """States kept of those that stand and look alike."""
    pace: float = 2.0
    """Steps counted for each step of the shortest way to a cell not yet seen; above 1, because one walk cannot take
    the shortest way to all cells at once."""


def beam_search(
    places: ScenePlaces, settings: TaskSettings, start: States, views: int, beam: BeamSettings
) -> NDArray[np.int64]:
    """The actions that make the area under the curve of coverage over views as large as the beam finds.

    States are ranked by the area that is certain, plus, for every cell not yet seen, the views that would be left if
    the agent turned and walked straight to where that cell is in sight.

    Args:
        places: of the scene.
        settings: of the task.
        start: one state.
        views: number of actions.
        beam: how widely to search.

    Returns:
        `(views,)` actions; never stop.
    """
    states, history = start, []
    for left in range(views - 1, -1, -1):
        states, parent, action = _advance(places, settings, states, left, beam)
        history.append((parent, action))
    row = int(np.argmax(states.value))
    actions = []
    for parent, action in reversed(history):
        actions.append(action[row])
        row = parent[row]
    return np.array(actions[::-1], dtype=np.int64)


def _advance(
    places: ScenePlaces, settings: TaskSettings, states: States, left: int, beam: BeamSettings
) -> tuple[States, NDArray[np.int64], NDArray[np.int64]]:
    """The states after one more view, the rows that they come from, and the actions that lead to them."""
    parent, action, position, yaw, pitch = _moved(places.area, settings, states)
    place = places.nearest(position)
    fresh, gain = new_views(places, settings, parent, position, yaw, pitch, states.seen)
    value = states.value[parent] + (left + 1) * gain
    heading = (np.round(yaw / (2 * np.pi) * 256).astype(np.int64) & 255).astype(np.uint8)
    seen = states.seen[parent] | fresh
    hope = kernels.outlook(
        place, heading, places.wanted & ~seen, places.reach, places.heading, *_turning(settings), left, beam.pace
    )
    turn = np.round(wrap_angle(yaw) / np.radians(settings.turn_deg)).astype(np.int64)
    tilt = np.round(pitch / np.radians(settings.tilt_deg)).astype(np.int64)
    key = 1 + (place * 4096 + turn + 2048) * 4096 + tilt + 2048
    order = np.argsort(-(value + hope), kind="stable")
    kept = kernels.choose(order, key, seen, beam.width, beam.per_key)
    return States(position[kept], yaw[kept], pitch[kept], seen[kept], value[kept]), parent[kept], action[kept]


def _moved(
    area: NavigableArea, settings: TaskSettings, states: States
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float, Float, Float]:
    """Every state after each of the five moves, without looks beyond the limit: parent, action, position, angles."""
    n = len(states.value)
    parent, action = np.tile(np.arange(n), len(_MOVES)), np.repeat(_MOVES, n)
    limit = np.radians(settings.pitch_limit_deg) - 1e-9
    before = states.pitch[parent]
    useful = ~(((action == LOOK_UP) & (before >= limit)) | ((action == LOOK_DOWN) & (before <= -limit)))
    parent, action = parent[useful], action[useful]
    moved = act(area, settings, action, states.position[parent], states.yaw[parent], states.pitch[parent])
    return parent, action, *moved


def _turning(settings: TaskSettings) -> tuple[Float, Float]:
    """`(256,)` steps of turning for each difference of heading: until a cell is in the image, and until it is ahead."""
    apart = np.abs((np.arange(256) + 128) % 256 - 128) * 360 / 256
    near = np.maximum(apart - settings.hfov_deg / 2, 0) / settings.turn_deg
    return near, apart / settings.turn_deg
