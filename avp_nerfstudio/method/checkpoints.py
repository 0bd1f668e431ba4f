"""What torch's safe loader must accept in nerfstudio's checkpoints, and how it refuses everything else."""

import functools
import os
import pickle
import re
import sys
from typing import Any

import numpy as np
import torch

from avp_habitat.errors import AVPError

_REFUSED = re.compile(r"GLOBAL (\S+) (?:was not an allowed global|whose module \S+ is blocked)")


class UnsafeCheckpointError(AVPError, pickle.UnpicklingError, SystemExit):
    """A checkpoint that holds something which could run code when it is loaded.

    An ordinary `UnpicklingError`, as torch raises it, to whoever catches it; where nobody does (in `ns-eval`,
    `ns-train --load-dir`, ...) the interpreter ends as on `sys.exit(text)`: the text on one line, exit code 1 and no
    traceback.
    """

    def __init__(self, text: str) -> None:
        """Remember the text as the interpreter's last words."""
        super().__init__(text)
        self.code = f"error: {text}"


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


@functools.cache
def refuse_in_one_line() -> None:
    """Have a refused checkpoint end the `ns-` commands with one line that names the file and what is in it.

    torch 2.15 raises an error of twenty lines that advises to switch its safe loader off, and nerfstudio 1.1.5 prints
    it below a traceback. `torch.load` is called as before, with the caller's arguments; only its refusals, and only
    when it is nerfstudio that calls, become an `UnsafeCheckpointError`.
    """
    load = torch.load

    @functools.wraps(load)
    def torch_load(f: Any, *args: Any, **kwargs: Any) -> Any:
        try:
            return load(f, *args, **kwargs)
        except pickle.UnpicklingError as error:
            refused = _REFUSED.search(str(error))
            caller = sys._getframe(1).f_globals.get("__name__", "")
            if refused and caller.startswith("nerfstudio."):
                raise UnsafeCheckpointError(_refusal(f, refused[1])) from error
            raise

    torch.load = torch_load


def _refusal(file: Any, name: str) -> str:
    path = os.fspath(file) if isinstance(file, str | os.PathLike) else getattr(file, "name", "the checkpoint")
    return (
        f"{path}: expected the tensors and numbers of a nerfstudio checkpoint, found {name}, which could run code "
        "when it is loaded; refused"
    )
