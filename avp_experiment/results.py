"""Everything that was found, gathered into the one file from which tables and figures are made."""

import json
import os
import platform
import shutil
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from avp_experiment.cells import COLLECT, RECONSTRUCT, TRAIN, Cell
from avp_experiment.configuration import Configuration
from avp_experiment.store import Store
from avp_experiment.top_down import floor_map
from avp_habitat.provenance import PACKAGES, installed_versions

FORMAT = 1
FILE, PICTURES = "results.json", "pictures"


def gather(
    configuration: Configuration, store: Store, cells: Sequence[Cell], *, command: str, hours: float
) -> dict[str, Any]:
    """The content of `results.json` (docs/experiment.md describes it) of what is done by now.

    Args:
        configuration: of the experiment.
        store: its folder.
        cells: all of them.
        command: that was typed.
        hours: of work in all cells, one after another.
    """
    done = [(cell, record) for cell in cells if (record := store.record(cell)) is not None]
    by_kind = {
        kind: [(cell, record) for cell, record in done if cell.kind == kind] for kind in (TRAIN, COLLECT, RECONSTRUCT)
    }
    return {
        "format": FORMAT,
        "configuration": configuration.as_json(),
        "methods": [method.name for method in configuration.methods],
        "origin": {
            "command": command,
            "commits": sorted({record["commit"] for _, record in done if record["commit"]}),
            "machine": machine(),
            "versions": installed_versions(PACKAGES),
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "hours": round(hours, 2),
        },
        "training": [_training(cell, record) for cell, record in by_kind[TRAIN]],
        "rollouts": [_rollout(cell, record, store) for cell, record in by_kind[COLLECT]],
        "reconstructions": [_reconstruction(cell, record, store) for cell, record in by_kind[RECONSTRUCT]],
        "failed": [
            {"cell": cell.key, "reason": reason, "log": str(store.log(cell).relative_to(store.root))}
            for cell in cells
            if not store.is_done(cell) and (reason := store.failure(cell)) is not None
        ],
    }


def write(results: dict[str, Any], folder: Path) -> Path:
    """Write `results.json`, whole or not at all."""
    path = folder / FILE
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(results, separators=(",", ":"), allow_nan=False) + "\n", encoding="utf-8")
    temporary.replace(path)
    return path


def copy_pictures(store: Store, cells: Sequence[Cell]) -> None:
    """Held-out views and their renders, out of the reconstructions that kept them, beside the results."""
    target = store.root / PICTURES
    for cell in cells:
        source = cell.output(store.root) / PICTURES
        if cell.scene is None or not source.is_dir():
            continue
        target.mkdir(exist_ok=True)
        for path in sorted(source.glob("*.png")):
            kind, _, number = path.stem.partition("_")
            who = "truth" if kind == "truth" else cell.method.name
            shutil.copyfile(path, target / f"{cell.scene.slug}-{who}-{int(number):02d}.png")


def machine() -> dict[str, Any]:
    """What the results were made on."""
    import torch

    return {
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _about(cell: Cell, record: dict[str, Any]) -> dict[str, Any]:
    about = {"method": cell.method.name, "seed": cell.seed}
    if cell.scene is not None:
        about |= {"scene": cell.scene.name, "role": cell.scene.role, "start": cell.start}
    return about | {"commit": record["commit"], "seconds": record["seconds"]}


def _training(cell: Cell, record: dict[str, Any]) -> dict[str, Any]:
    facts = record["facts"]
    return _about(cell, record) | {name: facts[name] for name in ("steps", "curves", "run_id")}


def _rollout(cell: Cell, record: dict[str, Any], store: Store) -> dict[str, Any]:
    first = cell.seed == 0 and cell.start == 0
    return _about(cell, record) | record["facts"] | {"map": floor_map(cell.output(store.root)) if first else None}


def _reconstruction(cell: Cell, record: dict[str, Any], store: Store) -> dict[str, Any]:
    assert cell.needs is not None
    found, rollout = record["facts"], store.record(cell.needs)
    assert rollout is not None
    views = round(rollout["facts"]["metrics"]["views"])
    seen = found.get("visibility") or {}
    shares = seen.get("per_view") or [None] * len(found["per_view"])
    per_view = [
        {name: view.get(name) for name in ("psnr", "ssim", "lpips")} | {"visibility": share}
        for view, share in zip(found["per_view"], shares, strict=True)
    ]
    return _about(cell, record) | {
        "frames": cell.frames or views,
        "views": views,
        "whole": cell.frames is None,
        "iterations": found["iterations"],
        "scores": found["scores"],
        "lpips_reason": found.get("lpips_reason"),
        "visibility": seen.get("visibility"),
        "per_view": per_view,
    }
