"""`python -m avp_habitat.seen`: how much of what a rollout's held-out views show its captured frames have seen."""

import json
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from avp_habitat import command
from avp_habitat.command import progress
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.metrics import FIGURES, METRICS_HELP, explained, figure_of, find_metrics, measured
from avp_habitat.rollout.format import name_of, read_rollout
from avp_habitat.rollout.seen import visibility_of
from avp_habitat.tables import table

_ABOUT = ("rollout", "scene", "policy", "views")
_SHARES = ("coverage", *(name for name in FIGURES if name.startswith("visibility")))
_MEANING = "In percent. " + explained(*(FIGURES[name].title for name in _SHARES))


def report_on(folder: Path, *, stride: int | None = None, metrics: Sequence[str] = ()) -> dict[str, Any]:
    """What a rollout's frames have seen of its held-out views, as JSON: shares within [0, 1], None where unknown.

    The stride is that of `visibility_of`, the metrics are those of `metrics.find_metrics`.

    Raises:
        UsageError: no such metric.
        RolloutError: the rollout is damaged, or no held-out view shows a surface.
    """
    rollout = read_rollout(folder)
    found = visibility_of(rollout.frames, rollout.heldout, rollout.intrinsics, stride=stride)
    if not len(found.view):
        raise RolloutError(
            f"{folder}: expected held-out views that show a surface, found {len(rollout.heldout)} held-out views "
            "without any depth; collect it with held-out views"
        )
    coverage = rollout.meta.get("metrics", {}).get("coverage")
    return {
        "rollout": str(folder),
        "scene": name_of(rollout.meta, "scene"),
        "policy": name_of(rollout.meta, "policy"),
        "views": len(rollout.frames),
        "coverage": None if coverage is None else float(coverage),
        **found.figures(),
        **measured(metrics, "rollout", rollout),
        "pixels": len(found.view),
        "per_view": [None if math.isnan(share) else share for share in found.per_view().tolist()],
        "curve": found.curve().tolist(),
    }


def as_row(report: dict[str, Any], further: Iterable[str] = ()) -> list[str]:
    """What `report_on` gave in words and in percent, then the figures of further metrics."""
    shown = ["" if report[name] is None else figure_of(name).text(report[name]) for name in (*_SHARES, *further)]
    return [*(str(report[name]) for name in _ABOUT), *shown]


@dataclass(frozen=True)
class Seen:
    """How much of what the held-out views show the captured frames have seen.

    From depth alone, a predictor of the reconstruction's quality. Takes some seconds for each rollout.
    """

    rollouts: Positional[tuple[Path, ...]]
    """Rollout folders."""
    every: int | None = None
    """Test every N-th row and column of the held-out views; 1 tests all pixels, in about a minute (omitted: about 1,200
    pixels of each view)."""
    metrics: Annotated[tuple[str, ...], arg(help=METRICS_HELP)] = ()
    json: bool = False
    """Print JSON, with the shares per held-out view and after each frame."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        if not self.rollouts:
            raise UsageError("rollouts: expected at least one rollout folder")
        find_metrics(self.metrics)
        if self.every is not None and self.every < 1:
            raise UsageError(f"every: expected a whole number from 1, got {self.every}")


def main(options: Seen) -> None:
    """Print a line for each rollout."""
    several = len(options.rollouts) > 1
    waiting = progress(options.rollouts, desc="reading", unit="rollout") if several else options.rollouts
    reports = [report_on(folder, stride=options.every, metrics=options.metrics) for folder in waiting]
    if options.json:
        print(json.dumps(reports, indent=2, allow_nan=False))
        return
    further = [function.figure for function in find_metrics(options.metrics) if function.of == "rollout"]
    head = [*_ABOUT, *(FIGURES[name].title for name in _SHARES), *(figure.heading for figure in further)]
    rows = [as_row(report, [figure.name for figure in further]) for report in reports]
    print(table(head, rows, words=3, markdown=False))
    print(f"\n{_MEANING}")


if __name__ == "__main__":
    sys.exit(command.run(main))
