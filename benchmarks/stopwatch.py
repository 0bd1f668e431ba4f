"""The time of a training's steps and updates, by the clock and by the CPU."""

import time

from stable_baselines3.common.callbacks import BaseCallback


class Stopwatch(BaseCallback):
    """Runs from the first rollout to the end of the training; to be the first callback of the list.

    An evaluation that moves itself before it is counted.
    """

    def __init__(self) -> None:
        """Make a watch that has not started."""
        super().__init__()
        self.clock_s = self.cpu_s = 0.0
        self._running = False

    def _on_rollout_start(self) -> None:
        if not self._running:
            self._running = True
            self._start = time.perf_counter(), time.process_time()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self.clock_s = time.perf_counter() - self._start[0]
        self.cpu_s = time.process_time() - self._start[1]
