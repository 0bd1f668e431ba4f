"""What torch's safe loader must accept in nerfstudio's checkpoints, and nothing more."""

from typing import Any

import numpy as np
import torch


def checkpoint_types() -> list[Any]:
    """The types beyond torch's own that a checkpoint of nerfstudio 1.1.5 holds.

    Its learning-rate schedulers remember numpy scalars (float64), because they compute with numpy: a scalar is stored
    as its type's name, its dtype and its bytes. All of them only hold numbers; none runs code of a file's choosing.
    """
    scalar = np.float64(0).__reduce__()[0]
    # numpy 2 writes numpy._core.multiarray.scalar, numpy 1 numpy.core.multiarray.scalar: checkpoints of both exist.
    names = ("numpy._core.multiarray.scalar", "numpy.core.multiarray.scalar")
    return [*((scalar, name) for name in names), np.dtype, type(np.dtype(np.float64))]


def allow_checkpoints() -> None:
    """Let `torch.load(weights_only=True)`, the default since torch 2.6, open nerfstudio's checkpoints.

    The safe loader stays on: any other type in a checkpoint is still refused.
    """
    torch.serialization.add_safe_globals(checkpoint_types())
