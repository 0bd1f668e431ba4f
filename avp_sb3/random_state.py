"""Actions drawn at random beside a training, without any effect on the training's own random numbers."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


@contextmanager
def own_random_state(model: "BaseAlgorithm", seed: int) -> Iterator[None]:
    """Within the block, all generators that `model.predict` may use start from `seed`; after it they are as before.

    These are Python's, NumPy's and torch's global ones and that of the model's action space. The policy's training mode
    is given back, too.
    """
    space = model.action_space.np_random
    python, numpy_, mode = random.getstate(), np.random.get_state(), model.policy.training
    drawn = space.bit_generator.state
    on_gpu = model.device.type == "cuda"
    with torch.random.fork_rng([model.device] if on_gpu else []):
        try:
            random.seed(seed)
            np.random.seed(seed % 2**32)
            torch.default_generator.manual_seed(seed)
            if on_gpu:
                torch.cuda.manual_seed(seed)
            space.bit_generator.state = np.random.default_rng(seed).bit_generator.state
            yield
        finally:
            model.policy.set_training_mode(mode)
            space.bit_generator.state = drawn
            np.random.set_state(numpy_)
            random.setstate(python)
