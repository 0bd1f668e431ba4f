"""How fast views are written into a rollout folder, beside casting their rays alone.

The views are held-out ones of each scene. `rays` renders their depth and nothing else; `export` renders colours too,
and encodes and writes the pictures. Both take turns, so that other programs disturb them alike; rates are those of the
fastest round, on all cores. `share` is of the ray rate by the clock, `cpu_share` by the time that all threads took: it
hardly depends on what else runs. `first_s` is the first view of the process, with what is compiled or read for it.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import reporting
from numpy.typing import NDArray
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout.writing import RolloutWriter
from avp_habitat.scenes.loader import load_scene
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.sight.heldout import heldout_poses
from avp_habitat.simulators.raycast import RaycastSimulator
from avp_habitat.task.settings import TaskSettings


def _parser() -> argparse.ArgumentParser:
    made = reporting.parser(__doc__, "export")
    add = made.add_argument
    add("--scene", default=["builtin:0"], nargs="+", help=SCENES)
    add("--views", default=100, type=int, help="views of a round")
    add("--rounds", default=3, type=int, help="rounds of rays and export each")
    add("--width", default=640, type=int, help="of the pictures, pixels")
    add("--height", default=480, type=int, help="of the pictures, pixels")
    return made


def main(argv: Sequence[str]) -> None:
    """Measure, print and write."""
    options = _parser().parse_args(argv)
    reporting.check_least(options, views=1, rounds=1, width=8, height=8)
    with reporting.reported("export", options) as results:
        results["export"] = []
        for scene in tqdm(options.scene, desc="scenes"):
            results["export"].append({"scene": Path(scene).name, **_measure(scene, options)})


def _measure(scene: str, options: argparse.Namespace) -> dict[str, Any]:
    simulator, settings = RaycastSimulator(load_scene(scene)), TaskSettings()
    poses = heldout_poses(simulator, sensor_height_m=settings.sensor_height_m, views=options.views)
    camera = Intrinsics.from_hfov(options.width, options.height, hfov_deg=settings.hfov_deg)
    first_s, _ = _timed(lambda: simulator.render(poses[:1], camera, rgb=True))
    rays, exports = [], []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.rounds):
            rays.append(_timed(lambda: _cast(simulator, poses, camera)))
            exports.append(_timed(lambda name=f"{folder}/{number}": _export(simulator, poses, camera, name)))
        size = sum(file.stat().st_size for file in Path(folder).rglob("*.png")) / options.rounds
    (rays_s, rays_cpu_s), (export_s, export_cpu_s) = min(rays), min(exports)
    return {
        "views": options.views,
        "export_s": export_s,
        "export_per_s": options.views / export_s,
        "rays_per_s": options.views / rays_s,
        "share": rays_s / export_s,
        "export_cpu_ms": 1000 * export_cpu_s / options.views,
        "rays_cpu_ms": 1000 * rays_cpu_s / options.views,
        "cpu_share": rays_cpu_s / export_cpu_s,
        "first_s": first_s,
        "kb_per_view": size / 1000 / options.views,
    }


def _timed(work: Callable[[], object]) -> tuple[float, float]:
    """Seconds by the clock, and those of all threads."""
    clock_s, cpu_s = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - clock_s, time.process_time() - cpu_s


def _cast(simulator: RaycastSimulator, poses: NDArray[np.floating], camera: Intrinsics) -> None:
    for pose in poses:
        simulator.render(pose[None], camera, rgb=False)


def _export(simulator: RaycastSimulator, poses: NDArray[np.floating], camera: Intrinsics, folder: str) -> None:
    with RolloutWriter(folder, camera) as writer:
        for pose in poses:
            frames = simulator.render(pose[None], camera, rgb=True)
            assert frames.rgb is not None
            writer.add_frame(frames.rgb[0], frames.depth[0], pose)
        writer.publish({})


if __name__ == "__main__":
    sys.exit(command.run(main))
