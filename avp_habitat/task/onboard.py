"""Observations of a robot: what its own depth camera has shown of floor and surface, from where, and nothing else.

No coverage ratio, no size of the scene, no share of the surface: what enters is known to who has the pictures and
poses. `privileged` adds these, to see what they are worth.
"""

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.sight.rules import turned
from avp_habitat.surface import around
from avp_habitat.task import floor_map
from avp_habitat.task.observations import Agents, Trail
from avp_habitat.task.settings import ACTION_NAMES, TaskSettings

HERE_M = 0.5
"""Views taken from this near count as taken from here, metres on the floor."""
TURNS, TILTS = 12, 3
"""Directions of the views taken from here: so many of yaw to the right of the agent's, and three of pitch."""
RAYS = 24
"""Directions in which the walkable floor is followed, to the right, the first one straight ahead."""
FREE_M = 3.0
"""So far at most, metres."""
RECENT = 8
"""Views over which recent gains are averaged."""
_TILT_RAD = np.radians(15.0)
_MANY_VIEWS = 4.0
_SPREAD_M = 5.0
_GAIN = 12.0
_TOTAL = 8.0
_POOLED = floor_map.SIDE // 2
PARTS = {
    "state": 8,
    "gains": 6,
    "last action": len(ACTION_NAMES),
    "free": 2 * RAYS,
    "views from here": TILTS * TURNS,
    "views": around.SIDE**2,
    "floor": len(floor_map.CHANNELS) * _POOLED**2,
    "surface maps": len(around.CHANNELS) * around.SIDE**2,
    "surface around": 2 * len(around.BANDS) * around.SECTORS,
}
"""What the numbers are, in their order, and how many; `Onboard` says what each is."""


class Onboard:
    """What a robot knows, as one vector within [-1, 1].

    state: t / T, exp(-(T - t) / 2) (when to stop at the latest), sine and cosine of pitch, least and mean depth of
    the newest view, collided, distance to the mean position in 5 m. gains: of ΣΔQ and ΣΔS the newest view's and the
    mean of the last `RECENT`, by their roots, and the logarithms of the sums so far. last action: one of six. free:
    in `RAYS` directions how far nothing is known to block the way, in 3 m, and how much of that is observed floor.
    views from here: how many, by pitch and yaw. views, floor and surface maps: 10 x 10 cells of 0.8 m, turned to the
    heading. surface around: see `surface.around`.
    """

    needs_surface = True
    needs_parallax = True
    further = 0

    def __init__(self, settings: TaskSettings) -> None:
        """Say the space."""
        self.space = Box(-1.0, 1.0, (sum(PARTS.values()) + self.further,), np.float32)

    def __call__(self, agents: Agents) -> NDArray[np.float32]:
        """`(n, …)` float32, `PARTS`."""
        trail, count = agents.trail(), len(agents.steps)
        here, views = np.zeros((count, TILTS, TURNS)), np.zeros((count, around.SIDE, around.SIDE))
        _count_views(trail.path, trail.angles, agents.steps, here, views)
        floor = agents.floor_maps().reshape(count, -1, _POOLED, 2, _POOLED, 2).mean(axis=(3, 5))
        known = [scene.surface_around() for scene in agents.scenes]
        parts = [
            _state(agents),
            _gains(trail, agents.steps),
            _last_action(trail, agents.steps),
            agents.joined([scene.free_floor(RAYS, FREE_M) for scene in agents.scenes]),
            here / _MANY_VIEWS,
            views / _MANY_VIEWS,
            floor,
            agents.joined([maps for maps, _ in known]),
            agents.joined([polar for _, polar in known]),
            *self._further(agents),
        ]
        flat = np.concatenate([part.reshape(count, -1) for part in parts], axis=1, dtype=np.float32)
        return np.clip(flat, -1.0, 1.0)

    def _further(self, agents: Agents) -> list[NDArray[np.floating]]:
        return []


class Privileged(Onboard):
    """`Onboard`, and what only the scene tells.

    Coverage, the shares of Σa·Q and Σa·S, the offset from the start by the scene's diameter, and that in 20 m.
    """

    further = 6

    def _further(self, agents: Agents) -> list[NDArray[np.floating]]:
        offset = (agents.position - agents.start)[:, [0, 2]] / agents.diameter_m[:, None]
        shares = agents.joined([scene.surface_shares()[:, 2:] for scene in agents.scenes])
        return [np.column_stack([agents.coverage, shares, offset, agents.diameter_m / 20.0])]


def _state(agents: Agents) -> NDArray[np.floating]:
    budget = agents.settings.budget
    columns = [agents.steps / budget, np.exp((agents.steps - budget) / 2.0), np.sin(agents.pitch), np.cos(agents.pitch)]
    columns += [agents.min_depth, agents.mean_depth, agents.collided * 1.0, agents.spread_m / _SPREAD_M]
    return np.column_stack(columns)


def _gains(trail: Trail, steps: NDArray[np.int64]) -> NDArray[np.floating]:
    everyone, done = np.arange(len(steps)), np.arange(trail.gain.shape[1])
    past = (done >= 1) & (done <= steps[:, None])
    recent = past & (done > steps[:, None] - RECENT)
    total = (trail.gain * past[..., None]).sum(axis=1)
    mean = (trail.gain * recent[..., None]).sum(axis=1) / np.maximum(recent.sum(axis=1), 1)[:, None]
    newest = trail.gain[everyone, steps] * (steps > 0)[:, None]
    return np.concatenate([np.sqrt(newest) / _GAIN, np.sqrt(mean) / _GAIN, np.log1p(total) / _TOTAL], axis=1)


def _last_action(trail: Trail, steps: NDArray[np.int64]) -> NDArray[np.floating]:
    last = trail.action[np.arange(len(steps)), np.maximum(steps - 1, 0)]
    return np.equal(np.arange(len(ACTION_NAMES)), last[:, None]) * (steps > 0)[:, None] * 1.0


@njit(cache=True)
def _count_views(path, angles, steps, here, views):
    """Count each agent's views, of this episode: those from here by pitch and yaw, and all by map cell.

    `path` and `angles` are those of `Trail`; `here` `(n, 3, turns)` and `views` `(n, side, side)` are zeros before.
    """
    side, turns = views.shape[1], here.shape[2]
    for k in range(len(steps)):
        now = steps[k]
        yaw = angles[k, now, 0]
        sine, cosine = np.sin(yaw), np.cos(yaw)
        for t in range(1, now + 1):
            x, z = path[k, t, 0] - path[k, now, 0], path[k, t, 2] - path[k, now, 2]
            ahead, right = turned(x, z, sine, cosine)
            row = int(np.floor(side / 2 - ahead / around.CELL_M))
            column = int(np.floor(side / 2 + right / around.CELL_M))
            if 0 <= row < side and 0 <= column < side:
                views[k, row, column] += 1
            if x * x + z * z <= HERE_M * HERE_M:
                pitch = angles[k, t, 1]
                tilt = 0 if pitch < -_TILT_RAD else (2 if pitch > _TILT_RAD else 1)
                share = ((yaw - angles[k, t, 0]) / (2 * np.pi)) % 1.0
                here[k, tilt, int(share * turns + 0.5) % turns] += 1
