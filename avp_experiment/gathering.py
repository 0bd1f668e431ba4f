"""Gathering what an experiment found by now into its `results.json`."""

import os
import platform
import re
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from PIL import Image

from avp_experiment.cells import COLLECT, RECONSTRUCT, Cell, floor_map
from avp_experiment.configuration import Configuration, scene_slug
from avp_experiment.folder import Folder, write_json
from avp_experiment.results import FILE, FORMAT, PARTS, PICTURES
from avp_habitat.metrics import FIGURES, figures
from avp_habitat.provenance import PACKAGES, installed_versions

_WIDEST = 240
"""Pixels; figure 6 shows six pictures beside each other."""


def gather(configuration: Configuration, folder: Folder, cells: Sequence[Cell], *, command: str) -> dict[str, Any]:
    """Write `results.json` (docs/experiment.md describes it) of what is done by now, with pictures; its content."""
    done = [(cell, record) for cell in cells if (record := folder.record(cell)) is not None]
    known = figures(configuration.metrics)
    measured = {name for cell, record in done if cell.kind == COLLECT for name in record["facts"]["metrics"]}
    results = {
        "format": FORMAT,
        "configuration": configuration.as_json(),
        "methods": [method.name for method in configuration.methods],
        "figures": {name: asdict(known[name]) for name in sorted(measured & set(known) - set(FIGURES))},
        "origin": {
            "command": command,
            "commits": sorted({record["commit"] for _, record in done if record["commit"]}),
            "machine": _machine(),
            "versions": installed_versions(PACKAGES),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "hours": round(sum(record["seconds"] for _, record in done) / 3600, 2),
        },
        **{part: [_entry(cell, folder) for cell, _ in done if cell.kind == kind] for part, kind in PARTS.items()},
        "failed": [
            {"cell": cell.key, "reason": reason, "log": str(folder.log(cell).relative_to(folder.root))}
            for cell in cells
            if not folder.is_done(cell) and (reason := folder.failure(cell)) is not None
        ],
    }
    for cell, _ in done:
        _copy_pictures(cell, folder.root)
    write_json(folder.root / FILE, results, separators=(",", ":"))
    return results


def _machine() -> dict[str, Any]:
    import torch

    # Python names no processor on most Linux systems.
    name = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    return {
        "platform": platform.platform(),
        "processor": name[1] if name else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def _entry(cell: Cell, folder: Folder) -> dict[str, Any]:
    record = folder.record(cell) or {}
    entry = {"method": cell.method.name, "seed": cell.seed, "commit": record["commit"], "seconds": record["seconds"]}
    if cell.scene is None:
        return entry | record["facts"]
    entry |= {"scene": cell.scene.name, "role": cell.scene.role, "start": cell.start}
    if cell.kind == RECONSTRUCT:
        return entry | _scored(cell, record["facts"], folder)
    first = cell.seed == cell.start == 0
    return entry | record["facts"] | {"map": floor_map(cell.output(folder.root)) if first else None}


def _scored(cell: Cell, found: dict[str, Any], folder: Folder) -> dict[str, Any]:
    rollout = (folder.record(cell.needs) if cell.needs else None) or {}
    views, seen = round(rollout["facts"]["metrics"]["views"]), found.get("visibility") or {}
    shares = seen.get("per_view") or [None] * len(found["per_view"])
    return {
        "frames": cell.frames or views,
        "views": views,
        "whole": cell.frames is None,
        "iterations": found["iterations"],
        "scores": found["scores"],
        "lpips_reason": found.get("lpips_reason"),
        "geometry": found.get("geometry", {}),
        "visibility": seen.get("visibility"),
        "per_view": [
            {name: view.get(name) for name in ("psnr", "ssim", "lpips")} | {"visibility": share}
            for view, share in zip(found["per_view"], shares, strict=True)
        ],
    }


def _copy_pictures(cell: Cell, root: Path) -> None:
    """Held-out views and their renders, out of a reconstruction that kept them, to beside the results."""
    for path in sorted((cell.output(root) / PICTURES).glob("*.png")):
        assert cell.scene is not None
        kind, _, number = path.stem.partition("_")
        shown = "truth" if kind == "truth" else cell.method.name
        (root / PICTURES).mkdir(exist_ok=True)
        _copy_small(path, root / PICTURES / f"{scene_slug(cell.scene.name)}-{shown}-{int(number):02d}.png")


def _copy_small(path: Path, out: Path) -> None:
    """Copy a picture, no wider than `_WIDEST`, so that results can be kept beside code."""
    with Image.open(path) as picture:
        if picture.width <= _WIDEST:
            shutil.copyfile(path, out)
            return
        size = _WIDEST, round(picture.height * _WIDEST / picture.width)
        small = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
        small.quantize(256, dither=Image.Dither.NONE).save(out, optimize=True)
