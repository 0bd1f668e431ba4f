"""What a rollout gives in equal time and in equal iterations: avp-nerfacto with and without depth, and nerfacto.

Every reconstruction runs in a process of its own, one after the other, and is scored at full resolution: on all
held-out views in the comparison by time, on every fourth in that by iterations. What is done is kept in `--cells` and
not done again; `--report-only` writes the report from it.
"""

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import reporting
from reconstruction_process import WAYS
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.rollout.format import Rollout, read_rollout


@dataclass(frozen=True)
class Cell:
    """One reconstruction of the study."""

    way: str
    """Method and settings, a key of `WAYS`."""
    minutes: float
    """Time to train; 0 for no limit."""
    iterations: int
    """Iterations to train; 0 for no limit."""

    @property
    def limit(self) -> str:
        """The limit in words."""
        return f"{self.minutes:g} minutes" if self.minutes else f"{self.iterations:,} iterations"

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.way}-{self.limit.replace(' ', '-').replace(',', '')}"


def _parser() -> argparse.ArgumentParser:
    made = reporting.parser(__doc__, "reconstruction")
    add = made.add_argument
    add("--data", required=True, type=Path, help="the rollout")
    add("--minutes", default=10.0, type=float, help="training time of the first comparison; 0 leaves it out")
    add("--iterations", default=1000, type=int, help="iterations of the second comparison; 0 leaves it out")
    add("--score-every", default=4, type=int, help="held-out views scored in the second comparison: every n-th")
    add("--ways", nargs="+", default=list(WAYS), choices=list(WAYS), help="methods and settings")
    add("--pictures", nargs="*", default=[0, 7, 13], type=int, help="held-out views to show")
    add("--cells", default=Path("runs/reconstruction"), type=Path, help="folder of the single reconstructions")
    add("--report-only", action="store_true", help="write the report from what is done")
    return made


def main(argv: Sequence[str]) -> None:
    """Reconstruct, print and write."""
    options = _parser().parse_args(argv)
    reporting.check_least(options, minutes=0.0, iterations=0, score_every=1)
    if not options.minutes and not options.iterations:
        raise UsageError("--minutes 0 --iterations 0: expected one of them above 0")
    rollout = read_rollout(options.data)
    cells = [Cell(way, options.minutes, 0) for way in options.ways if options.minutes]
    cells += [Cell(way, 0.0, options.iterations) for way in options.ways if options.iterations]
    with reporting.reported("reconstruction", options) as results:
        results["rollout"] = [_facts(rollout)]
        for cell in tqdm(cells, desc="reconstructions", unit="run", disable=None):
            done = _result(cell, options)
            if done is not None:
                results.setdefault(cell.limit, []).append({"way": cell.way, **_row(done)})
        _picture(cells, options)
        _write_markdown(results, options)


def _facts(rollout: Rollout) -> dict[str, Any]:
    camera, meta = rollout.intrinsics, rollout.meta
    scene, policy, metrics = (
        part if isinstance(part, dict) else {} for part in map(meta.get, ("scene", "policy", "metrics"))
    )
    return {
        "scene": scene.get("name"),
        "policy": policy.get("name"),
        "seed": meta.get("seed"),
        "coverage": metrics.get("coverage"),
        "frames": len(rollout.frames),
        "held_out": len(rollout.heldout),
        "pixels": f"{camera.width}x{camera.height}",
    }


def _result(cell: Cell, options: argparse.Namespace) -> dict[str, Any] | None:
    folder = options.cells / cell.name
    path = folder / "result.json"
    if not path.exists() and not options.report_only:
        folder.mkdir(parents=True, exist_ok=True)
        words = [sys.executable, str(Path(__file__).with_name("reconstruction_process.py"))]
        words += ["--way", cell.way, "--data", str(options.data), "--output", str(folder)]
        words += ["--seconds", str(60 * cell.minutes), "--iterations", str(cell.iterations)]
        words += ["--pictures", *map(str, options.pictures)]
        words += ["--score-every", str(1 if cell.minutes else options.score_every)]
        with (folder / "log.txt").open("w") as log:
            code = subprocess.run(words, stdout=log, stderr=subprocess.STDOUT, check=False).returncode
        if code:
            raise AVPError(f"{cell.name}: exit code {code}; {folder / 'log.txt'} says why: {shlex.join(words)}")
    return json.loads(path.read_text()) if path.exists() else None


def _row(done: dict[str, Any]) -> dict[str, Any]:
    mean = done["mean"]
    return {
        "iterations": done["iterations"],
        "million_rays": done["iterations"] * done["rays_per_batch"] / 1e6,
        "train_s": done["train_seconds"],
        "psnr_db": f"{mean['psnr']:.2f}",
        "ssim": f"{mean['ssim']:.3f}",
        "lpips": f"{mean['lpips']:.3f}" if "lpips" in mean else None,
        "depth_error_m": f"{mean['depth_error_m']:.3f}" if "depth_error_m" in mean else None,
        "views": len(done["views"]),
        "score_s": done["score_seconds"],
        "memory_gb": done["peak_memory_bytes"] / 1e9,
        "device": done["device"],
    }


def _write_markdown(results: reporting.Results, options: argparse.Namespace) -> None:
    """The tables and the picture as a page beside the report."""
    machine, path = reporting.machine(), options.out.with_suffix(".md")
    line = shlex.join(["python", "benchmarks/reconstruction.py", *sys.argv[1:]])
    about = f"`{line}` at commit {reporting.git_commit()}; {machine['cpus']} CPUs ({machine['cpu_model']})"
    threads = ", ".join(f"{name}={value}" for name, value in machine["threads"].items())
    text = ["# Reconstructions of one rollout", "", f"{about}{f', {threads}' if threads else ''}; seed 0.", ""]
    for title, rows in results.items():
        keys = list(dict.fromkeys(key for row in rows for key in row))
        cells = [[str(_short(row.get(key))) for key in keys] for row in rows]
        text += [f"## {title}", "", f"| {' | '.join(keys)} |", f"|{' --- |' * len(keys)}"]
        text += [*(f"| {' | '.join(line)} |" for line in cells), ""]
    picture = options.out.with_suffix(".jpg")
    if picture.exists():
        text += [f"![Held-out views: the truth, and what each way makes of them]({picture.name})", ""]
    path.write_text("\n".join(text), encoding="utf-8")
    print(f"{path}: the tables")


def _short(value: Any) -> Any:
    if value is None:
        return ""
    return f"{value:,.4g}" if isinstance(value, float) and abs(value) < 1000 else _whole(value)


def _whole(value: Any) -> Any:
    return f"{value:,.0f}" if isinstance(value, int | float) else value


def _picture(cells: Sequence[Cell], options: argparse.Namespace) -> None:
    """Truth and renders of the first comparison side by side, beside the report."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = [cell for cell in cells if cell.limit == cells[0].limit]
    shown = [cell for cell in shown if (options.cells / cell.name / "pictures").is_dir()]
    if not shown or not options.pictures:
        return
    columns = [("truth", shown[0], "truth"), *((cell.way, cell, "view") for cell in shown)]
    figure, axes = plt.subplots(
        len(options.pictures), len(columns), figsize=(3 * len(columns), 2.4 * len(options.pictures)), squeeze=False
    )
    for row, view in zip(axes, options.pictures, strict=True):
        for axis, (title, cell, kind) in zip(row, columns, strict=True):
            axis.imshow(plt.imread(options.cells / cell.name / "pictures" / f"{kind}_{view:02d}.png"))
            axis.set_title(title if view == options.pictures[0] else "", fontsize=10)
            axis.axis("off")
    figure.tight_layout(pad=0.3)
    path = options.out.with_suffix(".jpg")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90, pil_kwargs={"quality": 88})
    plt.close(figure)
    print(f"{path}: held-out views {', '.join(map(str, options.pictures))} after {cells[0].limit}")


if __name__ == "__main__":
    sys.exit(command.run(main))
