"""Reading an experiment's `results.json`, with every fault of it named."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from avp_habitat.errors import AVPError, UsageError

FORMAT = 1
FILE = "results.json"
TRAIN, UNSEEN = "train", "unseen"
Made = TypeVar("Made")
Key = tuple[str, int, int]
"""Scene, seed and start: what two methods have in common."""


@dataclass(frozen=True)
class Rollout:
    """One episode."""

    method: str
    """Its name."""
    role: str
    """Of its scene: train or unseen."""
    key: Key
    """Scene, seed and start."""
    metrics: Mapping[str, float]
    """Figures of the whole episode; shares within [0, 1]."""
    coverage_curve: tuple[float, ...]
    """Coverage after each view, within [0, 1]."""
    floor: Mapping[str, Any] | None
    """Its top-down map (`floor_map`), kept of the first episode only."""


@dataclass(frozen=True)
class Reconstruction:
    """One reconstruction of an episode's first frames, or of all of them."""

    method: str
    """Its name."""
    role: str
    """Of its scene: train or unseen."""
    key: Key
    """Scene, seed and start."""
    frames: int
    """How many frames it was made of."""
    whole: bool
    """Whether those are all of the episode."""
    scores: Mapping[str, float]
    """`psnr` in dB, `ssim`, `lpips`, as far as they could be computed: means over the held-out views."""
    lpips_reason: str | None
    """Why there is no LPIPS."""
    visibility: float | None
    """Share of the held-out pixels that its frames have seen."""
    psnr_by_view: tuple[float | None, ...]
    """In dB, of each held-out view."""


@dataclass(frozen=True)
class Training:
    """One training."""

    method: str
    """Its name."""
    seed: int
    """Of the training."""
    curves: Mapping[str, list[tuple[float, float]]]
    """`(step, value)` points by metric."""


@dataclass(frozen=True)
class Failure:
    """A part of the experiment that could not be done."""

    cell: str
    """Its name."""
    reason: str
    """In one line."""
    log: str
    """Its log, relative to the folder."""


@dataclass(frozen=True)
class Results:
    """Everything that an experiment found."""

    folder: Path
    """Where it is."""
    configuration: Mapping[str, Any]
    """As written."""
    methods: tuple[str, ...]
    """In the order of the tables."""
    origin: Mapping[str, Any]
    """Command, commits, machine, versions, as written."""
    trainings: tuple[Training, ...]
    """All that are done."""
    rollouts: tuple[Rollout, ...]
    """All that are done."""
    reconstructions: tuple[Reconstruction, ...]
    """All that are done."""
    failed: tuple[Failure, ...]
    """All that are not, and were tried."""

    def scenes(self, role: str) -> list[str]:
        """Names of the scenes of a role, in the experiment's order."""
        return [scene["name"] for scene in self.configuration["scenes"] if scene["role"] == role]

    def reconstruction_curves(self, method: str, role: str) -> dict[Key, dict[int, Reconstruction]]:
        """By episode: its reconstructions by their number of frames, in ascending order, none twice.

        Only episodes that have more than one are there, unless no episode has.
        """
        found: dict[Key, dict[int, Reconstruction]] = {}
        for one in sorted(self.reconstructions, key=lambda one: (one.frames, one.whole)):
            if (one.method, one.role) == (method, role):
                found.setdefault(one.key, {})[one.frames] = one
        several = {key: curve for key, curve in found.items() if len(curve) > 1}
        return several or found


def read_results(folder: Path) -> Results:
    """Read the results of an experiment.

    Args:
        folder: of the experiment.

    Raises:
        UsageError: there is no such folder, or no `results.json` in it.
        AVPError: that file is damaged or of another format.
    """
    path = folder / FILE
    if not path.is_file():
        raise UsageError(f"{folder}: expected the folder of an experiment (with {FILE}), found none")
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise AVPError(f"{path}: expected JSON, could not read it: {error}") from None
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        found = value.get("format") if isinstance(value, dict) else type(value).__name__
        raise AVPError(f"{path}: expected results of format {FORMAT}, found {found!r}")
    return Results(
        folder=folder,
        configuration=_part(path, value, "configuration", _configuration),
        methods=_part(path, value, "methods", lambda names: tuple(str(name) for name in names)),
        origin=_part(path, value, "origin", dict),
        trainings=_each(path, value, "training", _training),
        rollouts=_each(path, value, "rollouts", _rollout),
        reconstructions=_each(path, value, "reconstructions", _reconstruction),
        failed=_each(path, value, "failed", lambda one: Failure(one["cell"], one["reason"], one["log"])),
    )


def _part(path: Path, value: dict[str, Any], name: str, made_of: Callable[[Any], Made]) -> Made:
    try:
        return made_of(value[name])
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise AVPError(f"{path}: {name}: missing or damaged: {error!r}") from None


def _each(path: Path, value: dict[str, Any], name: str, made_of: Callable[[Any], Made]) -> tuple[Made, ...]:
    entries = _part(path, value, name, list)
    whole: dict[str, Any] = {f"{name}[{index}]": entry for index, entry in enumerate(entries)}
    return tuple(_part(path, whole, place, made_of) for place in whole)


def _configuration(entry: Any) -> dict[str, Any]:
    for scene in entry["scenes"]:
        if scene["role"] not in (TRAIN, UNSEEN) or not isinstance(scene["name"], str):
            raise ValueError(f"a scene without a name, or neither {TRAIN} nor {UNSEEN}: {scene}")
    return dict(entry)


def _training(entry: Any) -> Training:
    curves = {
        name: [(float(step), float(number)) for step, number in points] for name, points in entry["curves"].items()
    }
    return Training(entry["method"], int(entry["seed"]), curves)


def _key(entry: Any) -> Key:
    return str(entry["scene"]), int(entry["seed"]), int(entry["start"])


def _numbers(entry: Any) -> dict[str, float]:
    """What is known of named numbers."""
    return {name: float(number) for name, number in entry.items() if isinstance(number, int | float)}


def _rollout(entry: Any) -> Rollout:
    metrics, curve = _numbers(entry["metrics"]), tuple(float(share) for share in entry["coverage_curve"])
    return Rollout(entry["method"], entry["role"], _key(entry), metrics, curve, entry.get("map"))


def _reconstruction(entry: Any) -> Reconstruction:
    seen = entry.get("visibility")
    return Reconstruction(
        method=entry["method"],
        role=entry["role"],
        key=_key(entry),
        # An episode that stopped before has no more frames than it has.
        frames=min(int(entry["frames"]), round(entry["views"])),
        whole=bool(entry["whole"]),
        scores=_numbers(entry["scores"]),
        lpips_reason=entry.get("lpips_reason"),
        visibility=None if seen is None else float(seen),
        psnr_by_view=tuple(view.get("psnr") for view in entry["per_view"]),
    )
