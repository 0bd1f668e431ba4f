"""How the actions move n agents, and what the rewards ask about their earlier views."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.poses import camera_to_world, heading, wrap_angle
from avp_habitat.task.rewards import RewardConstants
from avp_habitat.task.settings import LOOK_DOWN, LOOK_UP, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT, TaskSettings

Float = NDArray[np.float64]
Actions = NDArray[np.integer]


def turn(settings: TaskSettings, action: Actions, yaw: Float, pitch: Float) -> tuple[Float, Float]:
    """Yaw and pitch `(n,)` in radians of n agents after `(n,)` actions; pitch stays within its limit."""
    step, tilt, limit = np.radians([settings.turn_deg, settings.tilt_deg, settings.pitch_limit_deg])
    turned = yaw + step * ((action == TURN_LEFT) * 1.0 - (action == TURN_RIGHT))
    tilted = pitch + tilt * ((action == LOOK_UP) * 1.0 - (action == LOOK_DOWN))
    return np.asarray(wrap_angle(turned), dtype=np.float64), np.clip(tilted, -limit, limit)


def walk(area: NavigableArea, settings: TaskSettings, action: Actions, position: Float, yaw: Float) -> Float:
    """Feet `(n, 3)` in metres of n agents of one scene after `(n,)` actions; forward slides along obstacles."""
    walking = np.flatnonzero(action == MOVE_FORWARD)
    position = position.copy()
    if len(walking):
        position[walking] = area.slide(position[walking], heading(yaw[walking]) * settings.forward_m)
    return position


def act(
    area: NavigableArea, settings: TaskSettings, action: Actions, position: Float, yaw: Float, pitch: Float
) -> tuple[Float, Float, Float]:
    """Feet, yaw and pitch of n agents of one scene after `(n,)` actions, as `walk` and `turn` give them."""
    yaw, pitch = turn(settings, action, yaw, pitch)
    return walk(area, settings, action, position, yaw), yaw, pitch


def sensor_poses(settings: TaskSettings, position: Float, yaw: Float, pitch: Float) -> Float:
    """`(n, 4, 4)` camera_to_world of agents, habitat axes."""
    return camera_to_world(position + np.array([0.0, settings.sensor_height_m, 0.0]), yaw=yaw, pitch=pitch)


class History(NamedTuple):
    """Answers about the newest step of n agents."""

    earlier_visits: NDArray[np.int64]
    """`(n,)` v: earlier views taken from the cell in which the agent now stands."""
    redundant: NDArray[np.bool_]
    """`(n,)` whether an earlier view lies within d_red with both angles within δ."""
    spread_m: NDArray[np.float64]
    """`(n,)` ‖p − p̄‖ in metres on the floor plane, p̄ over the start and all steps so far."""


def history(
    path: NDArray[np.float64],
    angles: NDArray[np.float64],
    cells: NDArray[np.int64],
    steps: NDArray[np.int64],
    constants: RewardConstants,
) -> History:
    """Compare each agent's newest view with its earlier ones, by the constants' d_red and δ.

    Args:
        path: `(n, T + 1, 3)` the start and the positions after each step, metres.
        angles: `(n, T + 1, 2)` yaw and pitch, radians.
        cells: `(n, T + 1, 2)` row and column of the floor cells under the positions.
        steps: `(n,)` t; entries after t are not read.
        constants: of the rewards.
    """
    count = len(steps)
    answer = History(np.zeros(count, np.int64), np.zeros(count, np.bool_), np.zeros(count))
    angle_rad = float(np.radians(constants.redundancy_angle_deg))
    _compare(path, angles, cells, steps, constants.redundancy_distance_m, angle_rad, *answer)
    return answer


@njit(cache=True)
def _compare(path, angles, cells, steps, distance_m, angle_rad, visits, redundant, spread):
    for k in range(len(steps)):
        now = steps[k]
        x, y, z = path[k, now]
        yaw, pitch = angles[k, now]
        sum_x, sum_z = path[k, 0, 0], path[k, 0, 2]
        for t in range(1, now + 1):
            sum_x += path[k, t, 0]
            sum_z += path[k, t, 2]
            if t == now:
                break
            if cells[k, t, 0] == cells[k, now, 0] and cells[k, t, 1] == cells[k, now, 1]:
                visits[k] += 1
            dx, dy, dz = path[k, t, 0] - x, path[k, t, 1] - y, path[k, t, 2] - z
            if dx * dx + dy * dy + dz * dz < distance_m * distance_m:
                turned = abs((angles[k, t, 0] - yaw + np.pi) % (2 * np.pi) - np.pi)
                tilted = abs((angles[k, t, 1] - pitch + np.pi) % (2 * np.pi) - np.pi)
                if turned < angle_rad and tilted < angle_rad:
                    redundant[k] = True
        spread[k] = np.hypot(x - sum_x / (now + 1), z - sum_z / (now + 1))
