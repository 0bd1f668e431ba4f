"""Finding the episodes that ended in the step that Stable-Baselines3 just took."""

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from avp_habitat.errors import AVPError

NOT_FOR = ("stdout", "log", "json", "csv", "tensorboard")
"""Formats that cannot hold a file: `logger.record(name, LoggedFile(path), exclude=NOT_FOR)`."""


@dataclass(frozen=True)
class LoggedFile:
    """A file to keep with the run; MLflow copies it when the logger is dumped."""

    path: Path
    """Where it lies."""
    name: str
    """How the artifact is called, `/` for folders: an artifact of the same name is replaced."""


@contextmanager
def logged_alone(callback: BaseCallback) -> Iterator[None]:
    """What is recorded within the block is dumped at its end, at the current step and without what was pending.

    SB3's own `EvalCallback` dumps the training's pending values, too: half of a rollout's figures, and the last
    update's losses at a step at which there was none.
    """
    logger = callback.logger
    pending = {name: getattr(logger, name) for name in ("name_to_value", "name_to_count", "name_to_excluded")}
    for name, held in pending.items():
        empty = held.copy()
        empty.clear()
        setattr(logger, name, empty)
    try:
        yield
        logger.record("time/total_timesteps", callback.num_timesteps, exclude=("tensorboard", "mlflow"))
        logger.dump(callback.num_timesteps)
    finally:
        for name, held in pending.items():
            setattr(logger, name, held)


def move_to_front(callback: BaseCallback, whole: Any) -> bool:
    """Let a callback come first, so that its last figures reach trackers that close at the end of the training.

    Args:
        callback: to be first.
        whole: what `learn` calls. The lists that the caller made stay as they are.

    Returns:
        Whether the callback is in `whole`.
    """
    if not isinstance(whole, CallbackList):
        return whole is callback
    holds = [move_to_front(callback, part) for part in whole.callbacks]
    order = sorted(range(len(holds)), key=lambda number: not holds[number])
    whole.callbacks = [whole.callbacks[number] for number in order]
    return any(holds)


def is_learning(model: Any) -> bool:
    """Whether `model.learn` is among the callers.

    rl_zoo3 calls the first callback's `on_training_end` once more in a `finally`, whatever ended the training; only
    `learn` itself calls it when the training came to its own end.
    """
    frame = sys._getframe()
    while frame is not None:
        if frame.f_code.co_name == "learn" and frame.f_locals.get("self") is model:
            return True
        frame = frame.f_back
    return False


class MissingInfoError(AVPError):
    """An environment that does not report what a callback reads."""


def finished_episodes(locals_: Mapping[str, Any]) -> list[tuple[int, dict[str, Any]]]:
    """Index of the environment, and the last `info`, of every episode that ended in this step.

    Args:
        locals_: a callback's `self.locals`.
    """
    dones = np.asarray(locals_["dones"])
    if not dones.any():
        return []
    infos = locals_["infos"]
    return [(int(index), infos[index]) for index in np.flatnonzero(dones)]


def required(info: Mapping[str, Any], key: str, *, reader: str, inside: str = "info") -> Any:
    """`info[key]`.

    Args:
        info: the mapping.
        key: what must be in it.
        reader: the callback that needs it, for the error's text.
        inside: how the mapping is called, for the error's text.

    Raises:
        MissingInfoError: the key is missing.
    """
    if key in info:
        return info[key]
    found = ", ".join(sorted(map(str, info))) or "nothing"
    raise MissingInfoError(
        f"{reader}: expected {key!r} in {inside} at the end of an episode, found {found}; train on AVP-v0 "
        "(gymnasium.make('avp_habitat:AVP-v0')) or another environment that reports it, and keep it in every wrapper"
    )
