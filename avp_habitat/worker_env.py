"""What `gymnasium.make("AVP-v0")` gives to a worker of Stable-Baselines3's `SubprocVecEnv` if the scene does not open.

An exception there ends the worker with a traceback, and its parent sees a broken pipe alone. So the failure waits
within the environment: `avp_sb3.zoo.Batched` asks for it, and whoever does not gets one line at the first reset.
"""

import sys
from typing import Any, NoReturn

import gymnasium

from avp_habitat.errors import AVPError
from avp_habitat.settings import OBSERVATION_NAMES, TaskSettings
from avp_habitat.spaces import action_space, observation_space

_WORKERS = "stable_baselines3.common.vec_env.subproc_vec_env"


def in_sb3_worker() -> bool:
    """Whether a worker of `SubprocVecEnv` is among the callers."""
    frame = sys._getframe()
    while frame is not None:
        if frame.f_code.co_name == "_worker" and frame.f_globals.get("__name__") == _WORKERS:
            return True
        frame = frame.f_back
    return False


class UnopenedEnv(gymnasium.Env):
    """An environment without a scene, which can only tell why."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 - gymnasium's own declaration

    def __init__(self, error: AVPError, **options: Any) -> None:
        """Keep the error.

        Args:
            error: that opening the scene ended in.
            **options: of the `AVPEnv` that could not be made.
        """
        self.failure = (type(error).__name__, str(error))
        """Name of the error's class, and its text."""
        self.render_mode = options.get("render_mode")
        settings = options.get("settings") or TaskSettings()
        kind = options.get("observation", settings.observation)
        self.observation_space = observation_space(kind if kind in OBSERVATION_NAMES else OBSERVATION_NAMES[0])
        self.action_space = action_space()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> NoReturn:
        """End the process.

        Raises:
            SystemExit: always, with the error's text, which Python prints as one line.
        """
        raise SystemExit(f"error: {self.failure[1]}")

    def step(self, action: Any) -> NoReturn:
        """As `reset`."""
        self.reset()
