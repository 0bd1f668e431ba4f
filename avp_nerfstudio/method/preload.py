"""Everything heavy that a reconstruction needs, imported and compiled: preload it, then fork.

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["avp_nerfstudio.method.preload"])

Set `OMP_NUM_THREADS=1` before the first fork: torch's threads do not survive one, and none is started while importing.
"""

# nerfstudio's scripts come first: its modules import each other in circles, and this way round is its own.
import nerfstudio.scripts.train  # noqa: I001
import nerfstudio.scripts.eval  # noqa: F401

import numpy as np

import avp_nerfstudio.plugin
import avp_nerfstudio.reconstruct
import avp_nerfstudio.method.reconstruction  # noqa: F401
from avp_nerfstudio.method.hash_encoding import _encode, _spread


def _compile() -> None:
    """Load the compiled loops from numba's cache, or compile them, for the types that trainings call them with."""
    positions, scalings = np.zeros((1, 3), np.float32), np.ones(1, np.float32)
    table, encoded = np.zeros((8, 2), np.float32), np.zeros((1, 2), np.float32)
    _encode(positions, scalings, table, 7, encoded)
    _spread(positions, scalings, 7, encoded, table)


_compile()
