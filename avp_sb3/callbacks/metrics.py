"""The task's figures, averaged over the last episodes, in Stable-Baselines3's logger."""

import sys
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

from avp_habitat.command import progress
from avp_habitat.metrics import coverage_per_view
from avp_sb3.callbacks.base import MissingInfoError, finished_episodes, required

MEANS = {
    "coverage": "avp/coverage",
    "views": "avp/views",
    "annd_m": "avp/annd_m",
    "ei": "avp/ei",
    "stopped": "avp/stop_share",
    "collisions": "avp/collisions",
    "redundant_views": "avp/redundant_views",
}
"""Keys of `info["avp_episode"]`, and the names under which their means are recorded."""
_RETURN = "return_"
_READER, _INSIDE = "MetricsCallback", "info['avp_episode']"


class EpisodeWindow:
    """The figures of the last episodes, as rows of one array."""

    def __init__(self, size: int) -> None:
        """Make an empty window of at most `size` episodes."""
        if size < 1:
            raise ValueError(f"expected a window of at least 1 episode, got {size}")
        self._size = size
        self._keys = [*MEANS]
        self._rows = np.zeros((size, len(self._keys)))
        self._added = 0

    def add(self, episode: Mapping[str, float]) -> None:
        """Take in an episode, in place of the oldest one when the window is full.

        Args:
            episode: `info["avp_episode"]`.

        Raises:
            MissingInfoError: a key of `MEANS`, or the return of a reward part that earlier episodes had, is missing or
                no number.
        """
        new = [key for key in episode if key.startswith(_RETURN) and key not in self._keys]
        if new:
            # A part that earlier episodes did not have gave them nothing.
            self._keys += sorted(new)
            self._rows = np.hstack([self._rows, np.zeros((self._size, len(new)))])
        self._rows[self._added % self._size] = [_number(episode, key) for key in self._keys]
        self._added += 1

    def means(self) -> dict[str, float]:
        """Means over the window by the name to record, with CpV; empty before the first episode.

        An episode in which a figure is nan, not known, does not count for it; a figure that no episode of the window
        knows is left out.
        """
        if not self._added:
            return {}
        rows = self._rows[: self._added]
        mean = rows.mean(axis=0)
        if np.isnan(mean).any():
            mean = _known_mean(rows)
        by_key = dict(zip(self._keys, mean.tolist(), strict=True))
        named = {MEANS.get(key) or f"reward/{key.removeprefix(_RETURN)}": value for key, value in by_key.items()}
        named["avp/cpv"] = coverage_per_view(np.array([by_key["coverage"]]), np.array([by_key["views"]]))
        return {name: value for name, value in named.items() if value == value}


def _known_mean(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of each column over what is not nan; nan for a column of nothing else."""
    known = ~np.isnan(rows)
    counts = known.sum(axis=0)
    sums = np.where(known, rows, 0.0).sum(axis=0)
    return np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)


def _number(episode: Mapping[str, float], key: str) -> float:
    value = required(episode, key, reader=_READER, inside=_INSIDE)
    try:
        return float(value)
    except (TypeError, ValueError):
        raise MissingInfoError(f"{_READER}: expected a number as {_INSIDE}[{key!r}], got {value!r}") from None


class MetricsCallback(BaseCallback):
    """Records coverage, CpV, ANND, EI, views, stop share, collisions, redundancy and the return of each reward part.

    They appear wherever SB3 logs (screen, CSV, TensorBoard, MLflow) as `avp/...` and `reward/...`, averaged over the
    last `window` episodes like SB3's own `rollout/ep_rew_mean`. Where SB3 itself prints nothing (`verbose=0` and no
    progress bar on a terminal), this shows how far the training is: steps, rate, time left, coverage.
    """

    def __init__(self, window: int = 100, verbose: int = 1) -> None:
        """Set the window.

        Args:
            window: episodes to average over.
            verbose: 0 shows no progress.
        """
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
            self.logger.record(name, value)
