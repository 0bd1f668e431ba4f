"""Environments whose episodes start from the same places each time: one agent for each episode in each scene."""

from collections.abc import Sequence
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from avp_habitat.settings import TaskSettings
from avp_habitat.simulators import ONE_PER_PROCESS, SimulatorChoice
from avp_sb3.subproc import AVPSubprocVecEnv
from avp_sb3.vec_env import AVPVecEnv


class FixedStarts(AVPVecEnv):
    """One agent for each episode in each of some scenes; seeded, episode i of every scene starts from `seed + i`."""

    def __init__(self, scenes: Sequence[str], *, episodes: int, **options: Any) -> None:
        """Open the scenes.

        Args:
            scenes: each as `avp_habitat.scenes.location.locate` takes it.
            episodes: in each scene.
            **options: of `AVPVecEnv`.

        Raises:
            AVPError: as `AVPVecEnv`.
        """
        super().__init__(list(scenes), agents=episodes * len(scenes), **options)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the starts of the next `reset`."""
        if seed is not None:
            self._seeds = _starts(seed, self.num_envs, len(self.simulators))
        return self._seeds


class FixedStartsInProcesses(AVPSubprocVecEnv):
    """The same with a process for each scene, whatever simulator this process itself holds."""

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the starts of the next `reset`."""
        if seed is not None:
            self._seeds = _starts(seed, self.num_envs, len(self.scenes))
        return self._seeds


def fixed_starts(scenes: Sequence[str], choice: SimulatorChoice, *, episodes: int, settings: TaskSettings) -> VecEnv:
    """The scenes in this process, or each in its own where a process can hold one simulator only.

    Args:
        scenes: as the simulator takes them.
        choice: of the simulator.
        episodes: in each scene.
        settings: of the task.

    Raises:
        AVPError: as `AVPVecEnv` and `AVPSubprocVecEnv`.
    """
    options = {"simulator": choice.name, "gpu": choice.gpu, "navmesh": choice.navmesh, "up": choice.up}
    if choice.name not in ONE_PER_PROCESS:
        return FixedStarts(scenes, episodes=episodes, settings=settings, **options)
    return FixedStartsInProcesses(list(scenes), agents=episodes * len(scenes), settings=settings, **options)


def _starts(seed: int, agents: int, scenes: int) -> list[int | None]:
    """Agent i is in scene i modulo their number."""
    return [seed + row // scenes for row in range(agents)]
