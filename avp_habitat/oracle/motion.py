"""How planned actions move agents: the task's rules without its views."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.navigation.area import NavigableArea
from avp_habitat.poses import camera_to_world, heading, wrap_angle
from avp_habitat.settings import LOOK_DOWN, LOOK_UP, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT, TaskSettings

Float = NDArray[np.float64]


def act(
    area: NavigableArea, settings: TaskSettings, action: NDArray[np.integer], position: Float, yaw: Float, pitch: Float
) -> tuple[Float, Float, Float]:
    """Positions `(n, 3)` in metres, yaw and pitch `(n,)` in radians of n agents after `(n,)` actions."""
    turn, tilt, limit = np.radians([settings.turn_deg, settings.tilt_deg, settings.pitch_limit_deg])
    turned = yaw + turn * ((action == TURN_LEFT) * 1.0 - (action == TURN_RIGHT))
    yaw = np.asarray(wrap_angle(turned), dtype=np.float64)
    pitch = np.clip(pitch + tilt * ((action == LOOK_UP) * 1.0 - (action == LOOK_DOWN)), -limit, limit)
    walking = np.flatnonzero(action == MOVE_FORWARD)
    position = position.copy()
    if len(walking):
        position[walking] = area.slide(position[walking], heading(yaw[walking]) * settings.forward_m)
    return position, yaw, pitch


def sensor_poses(settings: TaskSettings, position: Float, yaw: Float, pitch: Float) -> Float:
    """`(n, 4, 4)` camera_to_world of agents, habitat axes."""
    return camera_to_world(position + np.array([0.0, settings.sensor_height_m, 0.0]), yaw=yaw, pitch=pitch)
