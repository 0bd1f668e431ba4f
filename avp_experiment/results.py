"""`results.json`: everything that an experiment found, from which tables and figures are made."""

import base64
import json
import os
import platform
import re
import shutil
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_experiment.cells import COLLECT, RECONSTRUCT, TRAIN, Cell, floor_map
from avp_experiment.configuration import Configuration, scene_slug
from avp_experiment.folder import Folder, write_json
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.metrics import FIGURES, Figure, figures
from avp_habitat.provenance import PACKAGES, installed_versions

FORMAT = 1
FILE, PICTURES = "results.json", "pictures"
PARTS = {"training": TRAIN, "rollouts": COLLECT, "reconstructions": RECONSTRUCT}
"""Lists of what cells found, each with the kind of its cells."""
_ORIGIN = ("command", "commits", "machine", "versions", "finished", "hours")
Key = tuple[str, int, int]
"""Scene, seed and start: what two methods have in common."""


@dataclass(frozen=True)
class _Measured:
    """What rollouts and reconstructions have in common."""

    method: str
    role: str
    """Of its scene: train or unseen."""
    key: Key


@dataclass(frozen=True)
class EpisodeResult(_Measured):
    """One rollout."""

    metrics: Mapping[str, float]
    """Of the whole episode."""
    coverage_curve: tuple[float, ...]
    """After each view, within [0, 1]."""
    floor: Mapping[str, Any] | None
    """Its map (`floor_map`) with its numbers, kept of the first episode only."""


@dataclass(frozen=True)
class Reconstruction(_Measured):
    """One reconstruction of an episode's first frames, or of all of them."""

    frames: int
    whole: bool
    """Of all frames of the episode."""
    scores: Mapping[str, float]
    """`psnr` in dB, `ssim`, `lpips`, as far as they could be computed: means over the held-out views."""
    lpips_reason: str | None
    visibility: float | None
    """Share of the held-out pixels that its frames have seen."""
    psnr_by_view: tuple[float | None, ...]
    """In dB, of each held-out view."""


@dataclass(frozen=True)
class Training:
    """One training."""

    method: str
    seed: int
    curves: Mapping[str, NDArray[np.float64]]
    """`(n, 2)` steps and values by metric."""


@dataclass(frozen=True)
class Results:
    """Everything that an experiment found."""

    folder: Path
    configuration: Mapping[str, Any]
    methods: tuple[str, ...]
    """In the order of the tables."""
    figures: Mapping[str, Figure]
    """Those that users added, by name."""
    origins: Mapping[str, Mapping[str, Any]]
    """By label: command, commits, machine, versions; one, labelled as the folder, unless results were merged."""
    sources: Mapping[str, Sequence[str]]
    """By method: the labels of its origins."""
    commits: Mapping[str, Sequence[str]]
    """By method: of its own cells."""
    training: tuple[Training, ...]
    rollouts: tuple[EpisodeResult, ...]
    reconstructions: tuple[Reconstruction, ...]
    failed: tuple[Mapping[str, str], ...]
    """`cell`, `reason` and `log` (relative to the experiment's folder) of what was tried in vain; merged: `label`."""

    def scenes(self, role: str) -> list[str]:
        """Names of the scenes of a role, in the experiment's order."""
        return [scene["name"] for scene in self.configuration["scenes"] if scene["role"] == role]

    @property
    def seeds(self) -> str:
        """How many, in words."""
        count = self.configuration.get("seeds", "?")
        return f"{count} seed" if count == 1 else f"{count} seeds"

    def values(self, method: str, role: str, name: str) -> dict[Key, float]:
        """A figure of a method by episode in scenes of a role, as far as it is known; a score of all its frames."""
        of = (method, role)
        scores = {one.key: one.scores for one in self.reconstructions if one.whole and (one.method, one.role) == of}
        metrics = {one.key: one.metrics for one in self.rollouts if (one.method, one.role) == of}
        found = metrics if any(name in figures for figures in metrics.values()) else scores
        return {key: figures[name] for key, figures in found.items() if name in figures}

    def reconstruction_curves(self, method: str, role: str) -> dict[Key, dict[int, Reconstruction]]:
        """By episode its reconstructions by number of frames, ascending; of episodes that have several, if any has."""
        found: dict[Key, dict[int, Reconstruction]] = {}
        for one in sorted(self.reconstructions, key=lambda one: (one.frames, one.whole)):
            if (one.method, one.role) == (method, role):
                found.setdefault(one.key, {})[one.frames] = one
        return {key: curve for key, curve in found.items() if len(curve) > 1} or found


def floor_of(entry: Mapping[str, Any]) -> NDArray[np.uint16]:
    """`(rows, columns)` numbers of a map, as its rollout's `floor.png` holds them."""
    packed = zlib.decompress(base64.b64decode(entry["floor"], validate=True))
    return np.frombuffer(packed, dtype="<u2").reshape(entry["shape"]).astype(np.uint16)


def read_results(folder: Path) -> Results:
    """Read the `results.json` of an experiment's folder; an `AVPError` where that is missing or damaged."""
    return as_results(folder, load_results(folder))


def load_results(folder: Path) -> dict[str, Any]:
    """The content of a folder's `results.json`, of which only the format is checked."""
    path = folder / FILE
    if not path.is_file():
        raise UsageError(f"{folder}: expected the folder of an experiment (with {FILE}), found none")
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise AVPError(f"{path}: expected JSON, could not read it: {error}") from None
    found = value.get("format") if isinstance(value, dict) else type(value).__name__
    if found != FORMAT:
        raise AVPError(f"{path}: expected results of format {FORMAT}, found {found!r}")
    return value


def as_results(folder: Path, value: dict[str, Any]) -> Results:
    """Check and convert the content of a folder's `results.json`; an `AVPError` where that is damaged."""
    try:
        for scene in value["configuration"]["scenes"]:
            _ = scene["name"], scene["sha256"], scene["role"]
        # Only merged results have several.
        origins = value["origins"] if "origins" in value else {folder.resolve().name: value["origin"]}
        return Results(
            folder=folder,
            configuration=value["configuration"],
            methods=tuple(value["methods"]),
            # Results of before users could add figures have none.
            figures={name: Figure(**entry) for name, entry in value.get("figures", {}).items()},
            origins={label: {name: origin[name] for name in _ORIGIN} for label, origin in origins.items()},
            sources=_sources(value, origins),
            commits={method: commits_of(entries_of(value, method)) for method in value["methods"]},
            training=tuple(map(_training, value["training"])),
            rollouts=tuple(map(_episode, value["rollouts"])),
            reconstructions=tuple(map(_reconstruction, value["reconstructions"])),
            failed=tuple(value["failed"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError, zlib.error) as error:
        raise AVPError(f"{folder / FILE}: missing or damaged: {error!r}") from None


def entries_of(value: Mapping[str, Any], method: str) -> dict[str, list[Any]]:
    """A method's entries in each of the `PARTS` of a `results.json`."""
    return {part: [one for one in value[part] if one["method"] == method] for part in PARTS}


def commits_of(entries: Mapping[str, Sequence[Any]]) -> list[str]:
    """The commits of a method's entries, as far as they are known."""
    return sorted({one["commit"] for part in entries.values() for one in part if one.get("commit")})


def _sources(value: Mapping[str, Any], origins: Mapping[str, Any]) -> dict[str, list[str]]:
    """By method the labels of its origins; all labels are held against the origins that are there."""
    known = value["sources"] if "origins" in value else {method: [*origins] for method in value["methods"]}
    found = {method: known[method] for method in value["methods"]}
    for labels in (*found.values(), *([one["label"]] for one in value["failed"] if "label" in one)):
        if not labels or not set(labels) <= set(origins):
            raise ValueError(f"no origin of {labels}")
    return found


def _training(entry: Any) -> Training:
    curves = {name: np.array(points, float).reshape(-1, 2) for name, points in entry["curves"].items()}
    return Training(entry["method"], int(entry["seed"]), curves)


def _measured(entry: Any) -> tuple[str, str, Key]:
    return entry["method"], entry["role"], (entry["scene"], entry["seed"], entry["start"])


def _numbers(entry: Any) -> dict[str, float]:
    """What is known of named numbers."""
    return {name: float(number) for name, number in entry.items() if isinstance(number, int | float)}


def _episode(entry: Any) -> EpisodeResult:
    curve = tuple(float(share) for share in entry["coverage_curve"])
    floor = entry.get("map") and {**entry["map"], "numbers": floor_of(entry["map"])}
    return EpisodeResult(*_measured(entry), _numbers(entry["metrics"]), curve, floor)


def _reconstruction(entry: Any) -> Reconstruction:
    return Reconstruction(
        *_measured(entry),
        # An episode that stopped before has no more frames than it has.
        frames=min(int(entry["frames"]), round(entry["views"])),
        whole=bool(entry["whole"]),
        scores=_numbers(entry["scores"]),
        lpips_reason=entry.get("lpips_reason"),
        visibility=entry.get("visibility"),
        psnr_by_view=tuple(view.get("psnr") for view in entry["per_view"]),
    )


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
        shutil.copyfile(path, root / PICTURES / f"{scene_slug(cell.scene.name)}-{shown}-{int(number):02d}.png")
