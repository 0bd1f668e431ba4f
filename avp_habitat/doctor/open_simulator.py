"""Program that opens a simulator on the built-in room, renders one small frame and prints what it did as JSON."""

import json
import os
import sys
import time
from typing import Any

import numpy as np

from avp_habitat.errors import AVPError
from avp_habitat.poses import Intrinsics
from avp_habitat.simulators.registry import make_simulator

_EYE_M = 1.5


def opened(name: str) -> dict[str, Any]:
    """Version, seconds and nearest depth in metres; `error` instead when it cannot run here."""
    start = time.monotonic()
    try:
        simulator = make_simulator(name, "builtin:0")
        pose = np.eye(4)
        pose[:3, 3] = simulator.area.random_points(np.random.default_rng(0), 1)[0] + [0.0, _EYE_M, 0.0]
        frames = simulator.render(pose[None], Intrinsics.from_hfov(32, 24, hfov_deg=90.0), rgb=True)
    except AVPError as error:
        return {"error": str(error)}
    seen = frames.depth[frames.depth > 0]
    if frames.rgb is None or not len(seen):
        return {"error": "it rendered an empty picture of the built-in room"}
    return {"version": simulator.version, "seconds": time.monotonic() - start, "nearest_m": float(seen.min())}


if __name__ == "__main__":
    # What engines print must not mix with the answer.
    answer_to = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    print(json.dumps(opened(sys.argv[1])), file=answer_to, flush=True)
    # Leaving by the door: drivers may crash while the interpreter is taken down, and the question is answered.
    os._exit(0)
