"""`results.json`: everything that an experiment found, from which tables and figures are made."""

import base64
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_experiment.cells import COLLECT, RECONSTRUCT, TRAIN
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.metrics import GEOMETRY, Figure

FORMAT = 1
FILE, PICTURES = "results.json", "pictures"
_CURVES = {"coverage": "coverage", "visibility": "visibility", "visibility_parallax": "parallax"}
"""Figures of which the whole course is kept, and what it is called in the file."""
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
    curves: Mapping[str, Mapping[int, float]]
    """Figures by name, within [0, 1], by the number of views after which they are known."""
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
    geometry: Mapping[str, float]
    """Of its own depth, where it was measured."""
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

    def model_geometry(self, method: str, role: str, name: str) -> dict[Key, float]:
        """The same of the reconstructions' own geometry."""
        found = [one for one in self.reconstructions if one.whole and (one.method, one.role) == (method, role)]
        return {one.key: one.geometry[name] for one in found if name in one.geometry}

    def after(self, method: str, role: str, name: str, share: float) -> dict[Key, float]:
        """A figure by episode after a share of the budget; an episode that has ended by then counts with all it had.

        Nothing where it is not known of all: those that have ended are not like the others.
        """
        of = [one for one in self.rollouts if (one.method, one.role) == (method, role) and one.curves.get(name)]
        found = {}
        for one in of:
            curve = one.curves[name]
            views = min(round(share * self.budget(one.key[0])), max(curve))
            if views in curve:
                found[one.key] = curve[views]
        return found if len(found) == len(of) else {}

    def budget(self, scene: str) -> int:
        """Most views of an episode in a scene."""
        budgets = (one.get("budget") for one in self.configuration["scenes"] if one["name"] == scene)
        return next(budgets, None) or self.configuration["budget"]

    @property
    def one_budget(self) -> int | None:
        """That of all scenes, if they have the same."""
        budgets = {self.budget(scene["name"]) for scene in self.configuration["scenes"]}
        return budgets.pop() if len(budgets) == 1 else None

    def place(self, key: Key, views: int) -> float:
        """A number of views of an episode on an axis: itself, or where budgets differ percent of the scene's."""
        return float(views if self.one_budget else round(100 * views / self.budget(key[0])))

    def unvisited(self, role: str) -> list[str]:
        """A note for each method that lacks scenes of a role in which it has any episode: its means are of others."""
        notes = []
        for method in self.methods:
            visited = {one.key[0] for one in self.rollouts if (one.method, one.role) == (method, role)}
            lacking = [scene for scene in self.scenes(role) if scene not in visited]
            if visited and lacking:
                notes.append(f"{method}: without {', '.join(lacking)}, so that its means are of other scenes.")
        return notes

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
            _ = scene["name"], scene["sha256"], scene["role"], value["configuration"]["budget"]
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
    metrics, floor = (
        _numbers(entry["metrics"]),
        entry.get("map") and {**entry["map"], "numbers": floor_of(entry["map"])},
    )
    # Results of before have none of parallax and geometry.
    known = {name: entry.get(f"{key}_curve") or () for name, key in _CURVES.items()}
    curves = {name: {i: float(share) for i, share in enumerate(curve, 1)} for name, curve in known.items() if curve}
    for views, found in (entry.get("geometry_after") or {}).items():
        for name, value in _numbers(found).items():
            curves.setdefault(name, {})[int(views)] = value
    for name in GEOMETRY:
        if name in metrics:
            curves.setdefault(name, {})[round(metrics["views"])] = metrics[name]
    return EpisodeResult(*_measured(entry), metrics, curves, floor)


def _reconstruction(entry: Any) -> Reconstruction:
    return Reconstruction(
        *_measured(entry),
        # An episode that stopped before has no more frames than it has.
        frames=min(int(entry["frames"]), round(entry["views"])),
        whole=bool(entry["whole"]),
        scores=_numbers(entry["scores"]),
        lpips_reason=entry.get("lpips_reason"),
        geometry=_numbers(entry.get("geometry") or {}),
        psnr_by_view=tuple(view.get("psnr") for view in entry["per_view"]),
    )
