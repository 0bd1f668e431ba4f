"""How long nerfstudio waits for `avp-data` before it trains, and how much memory that takes.

A few random views of a generated room are captured at the given size; folders of more frames are made of them with hard
links, so that every frame is a file of its own with a real picture behind it. Each folder is parsed for both splits
that a training asks for, in a process of its own: `first_s` is the first time (the files were just written, so they are
in the system's cache as far as memory allows), `train_s`, `val_s` and `cpu_s` (of both) are medians of three more
times, each by a new parser. `rss_growth_mb` is by how much the process's highest memory rose the first time;
`python_peak_mb` is the most that Python and numpy held, counted by tracemalloc in a last one.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import reporting
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.collect import Collect, collect
from avp_habitat.errors import AVPError
from avp_habitat.rollout.format import frame_name, read_rollout
from avp_habitat.scenes.location import HELP as SCENES

_REPEATS = 3
_MEASURE = "--measure"


def _parser() -> argparse.ArgumentParser:
    made = reporting.parser(__doc__, "dataparser")
    add = made.add_argument
    add("--frames", default=[80, 1000, 10_000], type=int, nargs="*", help="of the folders")
    add("--width", default=640, type=int, help="of the pictures, pixels")
    add("--height", default=480, type=int, help="of the pictures, pixels")
    add("--pictures", default=40, type=int, help="different pictures among them")
    add("--scene", default="builtin:1", help=f"the room: {SCENES}")
    return made


def main(argv: Sequence[str]) -> None:
    """Measure, print and write."""
    if list(argv[:1]) == [_MEASURE]:
        print(json.dumps(_measure(Path(argv[1]))))
        return
    options = _parser().parse_args(argv)
    reporting.check_least(options, frames=1, width=8, height=8, pictures=1)
    with tempfile.TemporaryDirectory() as name, reporting.reported("dataparser", options) as results:
        results["dataparser"] = []
        source = Path(name) / "source"
        collect(
            Collect(
                scene=options.scene,
                policy="random",
                out=source,
                reward="coverage",
                budget=options.pictures,
                width=options.width,
                height=options.height,
            )
        )
        for frames in tqdm(options.frames, unit="folder", desc="parsing", disable=None):
            folder = Path(name) / f"of_{frames}"
            size = lengthened(source, folder, frames)
            row = {"frames": frames, "image": f"{options.width}x{options.height}", "pictures_mb": size / 1e6}
            results["dataparser"].append(row | _in_new_process(folder))
            shutil.rmtree(folder)


def lengthened(source: Path, folder: Path, frames: int) -> int:
    """Make a rollout of so many frames out of a shorter one.

    Args:
        source: a rollout.
        folder: the new one, on the same disk; must not exist.
        frames: the frames of the source are repeated as hard links until there are so many.

    Returns:
        The size of its pictures and depth images in bytes.
    """
    available, size = len(read_rollout(source).frames), 0
    shutil.copytree(source / "heldout", folder / "heldout")
    shutil.copy(source / "floor.png", folder)
    for kind, suffix in (("images", ".png"), ("depth", ".png"), ("poses", ".txt")):
        (folder / kind).mkdir()
        for index in range(frames):
            origin = source / kind / f"{frame_name(index % available)}{suffix}"
            # Poses are copied, because one file with many names would be read from one place.
            (shutil.copyfile if kind == "poses" else os.link)(origin, folder / kind / f"{frame_name(index)}{suffix}")
            size += 0 if kind == "poses" else origin.stat().st_size
    meta = json.loads((source / "rollout.json").read_text())
    meta["counts"]["frames"] = frames
    (folder / "rollout.json").write_text(json.dumps(meta))
    return size


def _in_new_process(folder: Path) -> dict[str, float]:
    """What `_measure` finds, in a process whose memory has held nothing else."""
    line = [sys.executable, "-W", "ignore", __file__, _MEASURE, str(folder)]
    done = subprocess.run(line, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    if done.returncode:
        raise AVPError(f"{folder}: could not be parsed: {(done.stderr.splitlines() or ['no reason given'])[-1]}")
    return json.loads(done.stdout.splitlines()[-1])


def _measure(folder: Path) -> dict[str, float]:
    import torch

    # nerfstudio's modules import each other in circles: its cameras come first.
    from nerfstudio.cameras.cameras import Cameras

    from avp_nerfstudio.data.dataparser import AVPDataParserConfig

    # The first Cameras of a process make torch import sympy, which takes seconds and is not the parser's.
    Cameras(torch.eye(4)[None, :3], fx=1.0, fy=1.0, cx=1.0, cy=1.0, width=2, height=2)

    def parse() -> tuple[float, float, float]:
        """Seconds for the train split and for the val split after it, and the processor's seconds for both."""
        parser: Any = AVPDataParserConfig(data=folder).setup()
        start, cpu = time.perf_counter(), time.process_time()
        outputs = [parser.get_dataparser_outputs("train")]
        between = time.perf_counter()
        outputs.append(parser.get_dataparser_outputs("val"))
        return between - start, time.perf_counter() - between, time.process_time() - cpu

    before = _highest_memory_mb()
    first = parse()
    growth = _highest_memory_mb() - before
    train, val, cpu = (statistics.median(times) for times in zip(*(parse() for _ in range(_REPEATS)), strict=True))
    tracemalloc.start()
    parse()
    return {
        "first_s": first[0] + first[1],
        "train_s": train,
        "val_s": val,
        "cpu_s": cpu,
        "rss_growth_mb": growth,
        "python_peak_mb": tracemalloc.get_traced_memory()[1] / 1e6,
    }


def _highest_memory_mb() -> float:
    """The most memory that this process had so far."""
    try:
        import resource
    except ImportError:  # not on Windows
        return float("nan")
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


if __name__ == "__main__":
    sys.exit(command.run(main))
