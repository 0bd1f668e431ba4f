"""How long the figures of geometry take, and how much they depend on what they are computed with.

Each row changes one choice of `avp_habitat.geometry`: the voxels' side, the truncation, the number of samples, or the
places from which the observable surface is looked for. The first row is what the suite uses. `moved` is the greatest
change by it of completion, completion ratio, precision, F-score and Chamfer-L1, in percent of the first row's;
accuracy, a millimetre of exact depth, and depth L1, which counts the smallest hole whole, are to be read as they are.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import reporting
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.geometry import truth
from avp_habitat.geometry.fusion import TRUNCATION_M, VOXEL_M, fuse
from avp_habitat.geometry.scores import score
from avp_habitat.metrics import GEOMETRY
from avp_habitat.rollout.format import Rollout, read_rollout
from avp_habitat.rollout.images import read_depth
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.simulators.base import Simulator
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.settings import TaskSettings

_ROBUST = ("completion_m", "completion_ratio", "precision", "f_score", "chamfer_m")
_USED = {"voxel_m": VOXEL_M, "truncation_m": TRUNCATION_M, "samples": truth.SAMPLES, "places": truth.PLACES}


def _parser() -> argparse.ArgumentParser:
    made = reporting.parser(__doc__, "geometry")
    add = made.add_argument
    add("--rollout", type=Path, required=True, help="a rollout folder of the scene")
    add("--scene", default="builtin:0", help=SCENES)
    add("--factors", default=[0.75, 1.25], nargs="+", type=float, help="by which each choice is changed")
    return made


def main(argv: Sequence[str]) -> None:
    """Measure, print and write."""
    options = _parser().parse_args(argv)
    reporting.check_least(options, factors=0.1)
    rollout, simulator = read_rollout(options.rollout), open_simulator(SimulatorChoice(), options.scene)
    rows = [dict(_USED)]
    rows += [{**_USED, name: type(value)(value * by)} for name, value in _USED.items() for by in options.factors]
    with reporting.reported("geometry", options) as results:
        results["geometry"] = []
        for row in tqdm(rows, desc="choices"):
            found = _measure(rollout, simulator, row)
            first = results["geometry"][0] if results["geometry"] else found
            moved = max(abs(found[name] / first[name] - 1) for name in _ROBUST)
            results["geometry"].append({**row, **found, "moved": 100 * moved})


def _measure(rollout: Rollout, simulator: Simulator, row: dict[str, Any]) -> dict[str, float]:
    settings, began = TaskSettings(), time.perf_counter()
    known = truth.scene_truth.__wrapped__(simulator, settings, samples=row["samples"], places=row["places"])
    found_s = time.perf_counter()
    views = ((read_depth(view.depth), view.camera_to_world) for view in rollout.frames)
    shape = fuse(
        views,
        rollout.intrinsics,
        max_range_m=settings.max_range_m,
        voxel_m=row["voxel_m"],
        truncation_m=row["truncation_m"],
    )
    fused_s = time.perf_counter()
    assert shape is not None
    figures = score(shape, known, samples=row["samples"]).figures()
    scored_s = time.perf_counter()
    seconds = {"truth_s": found_s - began, "fuse_s": fused_s - found_s, "score_s": scored_s - fused_s}
    return {name: figures[name] for name in GEOMETRY} | seconds


if __name__ == "__main__":
    sys.exit(command.run(main))
