"""Tables 2 and 3: every method's figures in the scenes of training, and in scenes that no training has seen."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from avp_experiment.configuration import ROOMS, TRAIN
from avp_experiment.results import Key, Results
from avp_experiment.statistics import Summary, summary
from avp_habitat.metrics import FIGURES, Figure
from avp_habitat.tables import table

SCORES = ("psnr", "ssim", "lpips")
COLUMNS = ("views", "coverage", "annd_m", "ei", "path_length_m", "visibility", *SCORES)
"""The suite's figures that the tables show; those that users added follow."""
NOTHING = "–"


@dataclass(frozen=True)
class Table:
    """One of the tables."""

    columns: tuple[Figure, ...]
    """Those for which there are values."""
    rows: dict[str, dict[str, Summary | None]]
    """By method and column."""
    episodes: dict[str, int]
    """By method."""
    notes: tuple[str, ...]
    """What is not in it, and why."""

    def markdown(self) -> str:
        """With mean ± half the 95 % confidence interval over seeds, and the notes below."""
        head = ["method", *(column.heading for column in self.columns)]
        rows = [
            [method, *(found.text(column) if (found := cells[column.name]) else NOTHING for column in self.columns)]
            for method, cells in self.rows.items()
        ]
        return "\n".join([table(head, rows, words=1), *(f"\n{note}" for note in self.notes)]) + "\n"

    def csv(self) -> str:
        """The same in the same units, mean and half width in columns of their own, with more digits."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        titles = [title for column in self.columns for title in (column.heading, f"± {column.heading}")]
        writer.writerow(["method", "seeds", "episodes", *titles])
        for method, found in self.rows.items():
            seeds = max((cell.seeds for cell in found.values() if cell), default=0)
            numbers = [number for column in self.columns for number in _numbers(found[column.name], column)]
            writer.writerow([method, seeds, self.episodes[method], *numbers])
        return text.getvalue()


def make_table(results: Results, role: str) -> Table | None:
    """The table of the scenes of a role; None where no method has an episode there."""
    figures = {name: FIGURES[name] for name in COLUMNS} | dict(results.figures)
    found = {method: {name: results.values(method, role, name) for name in figures} for method in results.methods}
    found = {method: values for method, values in found.items() if values["coverage"]}
    if not found:
        return None
    shown = [name for name in figures if any(values[name] for values in found.values())]
    rows = {method: {name: summary(values[name]) for name in shown} for method, values in found.items()}
    missing = [name for name in figures if name not in shown]
    return Table(
        columns=tuple(figures[name] for name in shown),
        rows=rows,
        episodes={method: len(values["coverage"]) for method, values in found.items()},
        notes=(
            *(f"No {figures[name].heading}: {_why_missing(results, name)}." for name in missing),
            *_notes(results, role, found),
        ),
    )


def _numbers(found: Summary | None, figure: Figure) -> list[str]:
    if found is None:
        return ["", ""]
    half = "" if np.isnan(found.half_width) else f"{figure.scale * found.half_width:.6g}"
    return [f"{figure.scale * found.mean:.6g}", half]


def _notes(results: Results, role: str, found: Mapping[str, Mapping[str, Mapping[Key, float]]]) -> list[str]:
    notes = []
    if missing := [method for method in results.methods if method not in found]:
        notes.append(f"No episode of {', '.join(missing)}.")
    most = max(len(values["coverage"]) for values in found.values())
    fewer = [
        f"{method} {len(values['coverage'])} episodes, {len(values['psnr'])} reconstructions"
        for method, values in found.items()
        if min(len(values["coverage"]), len(values["psnr"])) < most and values["psnr"]
    ]
    if fewer:
        notes.append(f"Of fewer than {most} episodes or reconstructions: {'; '.join(fewer)}.")
    if role == TRAIN and any(method.endswith(ROOMS) for method in found):
        notes.append(f"Methods whose name ends in `{ROOMS}` were trained in generated rooms, never in these scenes.")
    return notes


def _why_missing(results: Results, name: str) -> str:
    if name not in SCORES:
        return "no episode has it"
    reasons = {one.lpips_reason for one in results.reconstructions if name == "lpips" and one.lpips_reason}
    whole = any(one.whole for one in results.reconstructions)
    nothing = "no reconstruction has it" if whole or name == "lpips" else "no whole episode was reconstructed"
    return "; ".join(sorted(reasons)) or nothing
