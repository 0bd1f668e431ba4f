"""What it takes to make a generated scene: rooms and homes of the same seeds in turn, by processor time."""

import argparse
import statistics
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import reporting
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.scenes.loader import load_scene
from avp_habitat.scenes.location import HOME, ROOM
from avp_habitat.scenes.mesh import TexturedMesh


def _parser() -> argparse.ArgumentParser:
    made = reporting.parser(__doc__, "generation")
    made.add_argument("--seeds", default=list(range(10)), type=int, nargs="+", help="of the rooms and of the homes")
    return made


def main(argv: Sequence[str]) -> None:
    """Measure, print and write."""
    options = _parser().parse_args(argv)
    reporting.check_least(options, seeds=0)
    with reporting.reported("generation", options) as results:
        results["kinds"], results["scenes"] = [], []
        # Not measured: what a process imports once is no scene's cost.
        load_scene(f"{ROOM}0")
        for seed in tqdm(options.seeds, desc="seeds"):
            results["scenes"] += [_measure(kind, seed) for kind in (ROOM, HOME)]
        for kind in (ROOM, HOME):
            results["kinds"].append(_summary(kind, results["scenes"]))


def floor_m2(mesh: TexturedMesh) -> float:
    """Area of what faces upwards at height 0."""
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    level = corners[np.abs(corners[:, :, 1]).max(axis=1) < 1e-6]
    return float(np.cross(level[:, 1] - level[:, 0], level[:, 2] - level[:, 0])[:, 1].clip(0).sum() / 2)


def _measure(kind: str, seed: int) -> dict[str, Any]:
    start = time.process_time()
    mesh = load_scene(f"{kind}{seed}").mesh
    took = time.process_time() - start
    textures = sum(texture.nbytes for texture in mesh.textures) / 1e6
    figures = {"cpu_s": took, "floor_m2": floor_m2(mesh), "triangles": len(mesh.triangles), "textures_mb": textures}
    return {"scene": f"{kind}{seed}"} | figures


def _summary(kind: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """All scenes of a kind; per square metre their sums."""
    own = [row for row in rows if row["scene"].startswith(kind)]
    floors = [row["floor_m2"] for row in own]
    spread = {"least_m2": min(floors), "median_m2": statistics.median(floors), "most_m2": max(floors)}
    total = {f"{name}_per_m2": sum(row[name] for row in own) / sum(floors) for name in ("cpu_s", "triangles")}
    return {"kind": kind, "scenes": len(own)} | spread | total


if __name__ == "__main__":
    sys.exit(command.run(main))
