"""The task's figures, averaged over the last episodes, in Stable-Baselines3's logger."""

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

from avp_habitat.command import progress
from avp_habitat.metrics import coverage_per_view
from avp_sb3.callbacks.base import finished_episodes, record, required
from avp_sb3.evaluation.policy import RETURN

_READER = "MetricsCallback"


class EpisodeWindow:
    """The figures of the last episodes, as rows of one array."""

    def __init__(self, size: int) -> None:
        """Make an empty window of at most `size` episodes."""
        if size < 1:
            raise ValueError(f"expected a window of at least 1 episode, got {size}")
        self._names: dict[str, str] = {}
        self._rows = np.empty((size, 0))
        self._added = 0

    def add(self, episode: Mapping[str, Any]) -> None:
        """Take in an episode's `info["avp_episode"]`, in place of the oldest one when the window is full.

        Raises:
            MissingInfoError: coverage or views is missing.
        """
        for key in ("coverage", "views"):
            required(episode, key, reader=_READER, inside="info['avp_episode']")
        if new := {key: _name(key) for key in episode if key not in self._names}:
            self._names |= new
            self._rows = np.hstack([self._rows, np.tile([_number({}, key) for key in new], (len(self._rows), 1))])
        self._rows[self._added % len(self._rows)] = [_number(episode, key) for key in self._names]
        self._added += 1

    def means(self) -> dict[str, float]:
        """Means over the window by the name to record, with CpV.

        An episode that does not know a figure (missing or nan) does not count for it; a figure that no episode of the
        window knows is left out.
        """
        rows = self._rows[: self._added]
        known = ~np.isnan(rows)
        counts = known.sum(axis=0)
        mean = np.where(known, rows, 0.0).sum(axis=0) / np.maximum(counts, 1)
        means = dict(zip(self._names.values(), mean.tolist(), strict=True))
        found = {name: value for (name, value), count in zip(means.items(), counts, strict=True) if count}
        if "avp/coverage" in found and "avp/views" in found:
            found["avp/cpv"] = coverage_per_view(np.array([found["avp/coverage"]]), np.array([found["avp/views"]]))
        return found


def _name(key: str) -> str:
    """Under which the mean of a figure, or of the return of a reward's part, is recorded."""
    if key.startswith(RETURN):
        return f"reward/{key.removeprefix(RETURN)}"
    return "avp/stop_share" if key == "stopped" else f"avp/{key}"


def _number(episode: Mapping[str, Any], key: str) -> float:
    # A part of the reward that an episode does not have gave it nothing; another figure is not known.
    return float(episode.get(key, 0.0 if key.startswith(RETURN) else np.nan))


class MetricsCallback(BaseCallback):
    """Records every figure of `info["avp_episode"]` (coverage, views, ANND …), CpV, and the return of each reward part.

    They appear wherever SB3 logs (screen, CSV, TensorBoard, MLflow) as `avp/FIGURE` and `reward/PART`, averaged over
    the last `window` episodes like SB3's own `rollout/ep_rew_mean`. Where SB3 itself prints nothing (`verbose=0` and
    no progress bar on a terminal), this shows how far the training is: steps, rate, time left, coverage.
    """

    def __init__(self, window: int = 100, verbose: int = 1) -> None:
        """Average over the last `window` episodes; with `verbose=0` no progress is shown."""
        super().__init__(verbose)
        self._bar: tqdm | None = None
        self._size = window
        self._window = EpisodeWindow(window)

    def _on_training_start(self) -> None:
        if self.num_timesteps == 0:
            self._window = EpisodeWindow(self._size)
        has_bar = self.locals.get("progress_bar") and sys.stdout.isatty()
        if self.verbose and not self.model.verbose and not has_bar:
            total = self.model._total_timesteps
            self._bar = progress(total=total, initial=self.num_timesteps, desc="training", unit="step")

    def _on_step(self) -> bool:
        finished = finished_episodes(self.locals)
        for _, info in finished:
            self._window.add(required(info, "avp_episode", reader=_READER))
        if finished:
            self._record()
        return True

    def _on_rollout_end(self) -> None:
        # A rollout in which no episode ended still shows the window, as SB3 does with its own.
        self._record()
        self._show()

    def _on_training_end(self) -> None:
        self._show()
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _show(self) -> None:
        if self._bar is None:
            return
        coverage = self._window.means().get("avp/coverage")
        if coverage is not None:
            self._bar.set_postfix_str(f"coverage {100 * coverage:.1f} %", refresh=False)
        # The last rollout may go beyond what was asked for.
        self._bar.total = max(self._bar.total, self.num_timesteps)
        self._bar.update(self.num_timesteps - self._bar.n)

    def _record(self) -> None:
        for name, value in self._window.means().items():
            record(self.logger, name, value)
