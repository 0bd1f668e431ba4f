"""`python -m avp_habitat.seen`: how much of what a rollout's held-out views show its captured frames have seen."""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_habitat import command
from avp_habitat.command import progress
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.metrics import TERMS, explained
from avp_habitat.rollout.format import name_of, read_rollout
from avp_habitat.rollout.seen import visibility_of
from avp_habitat.sight.visibility import Visibility

_COLUMNS = {
    "rollout": "rollout",
    "scene": "scene",
    "policy": "policy",
    "views": "views",
    "coverage": "coverage",
    "visibility": "visibility",
    "visibility_2_frames": "2 frames",
    "visibility_3_frames": "3 frames",
    "visibility_alike": "alike",
    "visibility_parallax": "parallax",
    "visibility_weighted": "weighted",
}
_WORDS = 3
_MEANING = "In percent. " + explained(*(name for name in _COLUMNS.values() if name in TERMS and name != "views"))


@dataclass(frozen=True)
class Report:
    """What was found of one rollout."""

    about: dict[str, Any]
    """Folder, scene, policy, views; coverage as the rollout says it, None where it does not."""
    found: Visibility
    """Of its held-out pixels."""

    def as_json(self) -> dict[str, Any]:
        """For programs: shares within [0, 1], also per held-out view and after each frame."""
        per_view = [None if share != share else share for share in self.found.per_view().tolist()]
        curve = self.found.curve().tolist()
        return (
            self.about | self.found.figures() | {"pixels": len(self.found.view), "per_view": per_view, "curve": curve}
        )

    def as_row(self) -> list[str]:
        """For people: shares in percent."""
        values = self.about | self.found.figures()
        words = [str(values[name]) for name in list(_COLUMNS)[: _WORDS + 1]]
        shares = [values[name] for name in list(_COLUMNS)[_WORDS + 1 :]]
        return words + ["" if share is None else f"{100 * share:.1f}" for share in shares]


def report_on(folder: Path, *, stride: int | None = None) -> Report:
    """Read a rollout and measure what its frames have seen of its held-out views.

    Args:
        folder: of the rollout.
        stride: as `rollout_visibility.visibility_of` takes it.

    Raises:
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
    about = {
        "rollout": str(folder),
        "scene": name_of(rollout.meta, "scene"),
        "policy": name_of(rollout.meta, "policy"),
        "views": len(rollout.frames),
        "coverage": None if coverage is None else float(coverage),
    }
    return Report(about, found)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m avp_habitat.seen",
        description="How much of what the held-out views show the captured frames have seen: from depth alone, a "
        "predictor of the reconstruction's quality. Takes some seconds for each rollout.",
        epilog=_MEANING,
    )
    add = parser.add_argument
    add("rollouts", nargs="+", type=Path, metavar="ROLLOUT", help="rollout folders")
    add(
        "--every",
        type=int,
        metavar="N",
        help="test every N-th row and column of the held-out views; 1 tests all pixels, in about a minute "
        "(default: about 1,200 pixels of each view)",
    )
    add("--json", action="store_true", help="print JSON, with the shares per held-out view and after each frame")
    return parser


def _table(rows: Sequence[Sequence[str]]) -> str:
    rows = [list(_COLUMNS.values()), *rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    cells = [
        [text.ljust(width) if column < _WORDS else text.rjust(width) for column, (text, width) in enumerate(pairs)]
        for pairs in (zip(row, widths, strict=True) for row in rows)
    ]
    return "\n".join("  ".join(row).rstrip() for row in cells)


def main(argv: Sequence[str]) -> None:
    """Print a line for each rollout."""
    options = _parser().parse_args(argv)
    if options.every is not None and options.every < 1:
        raise UsageError(f"--every: expected a whole number from 1, got {options.every}")
    several = len(options.rollouts) > 1
    waiting = progress(options.rollouts, desc="reading", unit="rollout") if several else options.rollouts
    reports = [report_on(folder, stride=options.every) for folder in waiting]
    if options.json:
        print(json.dumps([report.as_json() for report in reports], indent=2, allow_nan=False))
        return
    print(_table([report.as_row() for report in reports]))
    print(f"\n{_MEANING}")


if __name__ == "__main__":
    sys.exit(command.run(main))
