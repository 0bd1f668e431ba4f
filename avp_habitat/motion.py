"""How actions move agents and where their cameras are: the task's rules without its views."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.navigation.area import NavigableArea
from avp_habitat.poses import camera_to_world, heading, wrap_angle
from avp_habitat.settings import LOOK_DOWN, LOOK_UP, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT, TaskSettings

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
