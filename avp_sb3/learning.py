"""Whether a model's training is running at this moment."""

import sys
from typing import Any


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
