"""Figures that a callback logs at a step of its own, beside those that the training logs."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList


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
