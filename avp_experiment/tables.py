"""Tables 2 and 3: every method's figures in the scenes of training, and in scenes that no training has seen."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from avp_experiment.statistics import Summary, summary
from avp_experiment.stored import Key, Results


@dataclass(frozen=True)
class Column:
    """A figure of a table."""

    name: str
    """In the results."""
    title: str
    """With its unit."""
    digits: int
    """After the point."""
    scale: float = 1.0
    """The shown number by the results' own."""
    of_reconstruction: bool = False
    """Whether it belongs to the reconstruction of the whole episode rather than to the episode."""


COLUMNS = (
    Column("views", "views", 1),
    Column("coverage", "coverage [%]", 1, 100),
    Column("annd_m", "ANND [m]", 3),
    Column("ei", "EI [%/view]", 2, 100),
    Column("path_length_m", "path [m]", 2),
    Column("visibility", "visibility [%]", 1, 100),
    Column("psnr", "PSNR [dB]", 2, of_reconstruction=True),
    Column("ssim", "SSIM", 3, of_reconstruction=True),
    Column("lpips", "LPIPS", 3, of_reconstruction=True),
)
_MARKDOWN_EMPTY = "–"


@dataclass(frozen=True)
class Table:
    """One of the tables."""

    columns: tuple[Column, ...]
    """Those for which there are values."""
    rows: dict[str, dict[str, Summary | None]]
    """By method and column."""
    episodes: dict[str, int]
    """By method."""
    notes: tuple[str, ...]
    """What is not in it, and why."""

    def markdown(self) -> str:
        """With mean ± half the 95 % confidence interval over seeds, and the notes below."""
        body = [[method, *(self._cell(method, column) for column in self.columns)] for method in self.rows]
        lines = aligned([["method", *(column.title for column in self.columns)], *body])
        return "\n".join([lines, *(f"\n{note}" for note in self.notes)]) + "\n"

    def csv(self) -> str:
        """The same in the same units, mean and half width in columns of their own, with more digits."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        titles = [title for column in self.columns for title in (column.title, f"± {column.title}")]
        writer.writerow(["method", "seeds", "episodes", *titles])
        for method, cells in self.rows.items():
            seeds = max((cell.seeds for cell in cells.values() if cell), default=0)
            numbers = [number for column in self.columns for number in _numbers(column, cells[column.name])]
            writer.writerow([method, seeds, self.episodes[method], *numbers])
        return text.getvalue()

    def _cell(self, method: str, column: Column) -> str:
        found = self.rows[method][column.name]
        return found.text(digits=column.digits, scale=column.scale) if found else _MARKDOWN_EMPTY


def make_table(results: Results, role: str) -> Table | None:
    """The table of one kind of scenes; None where no method has an episode there.

    Args:
        results: of the experiment.
        role: of the scenes: train or unseen.
    """
    found = {
        method: {column.name: figure(results, method, role, column.name) for column in COLUMNS}
        for method in results.methods
    }
    found = {method: values for method, values in found.items() if values["coverage"]}
    if not found:
        return None
    columns = tuple(column for column in COLUMNS if any(values[column.name] for values in found.values()))
    rows = {
        method: {column.name: summary(values[column.name]) for column in columns} for method, values in found.items()
    }
    episodes = {method: len(values["coverage"]) for method, values in found.items()}
    return Table(columns, rows, episodes, tuple(_notes(results, role, columns, found)))


def figure(results: Results, method: str, role: str, name: str) -> dict[Key, float]:
    """A figure of a method by episode, as far as it is known.

    Args:
        results: of the experiment.
        method: its name.
        role: of the scenes: train or unseen.
        name: of a column; of reconstructions, those of whole episodes count.
    """
    if any(column.name == name and column.of_reconstruction for column in COLUMNS):
        whole = [one for one in results.reconstructions if one.whole and (one.method, one.role) == (method, role)]
        return {one.key: one.scores[name] for one in whole if name in one.scores}
    episodes = [one for one in results.rollouts if (one.method, one.role) == (method, role)]
    return {one.key: one.metrics[name] for one in episodes if name in one.metrics}


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first row is its head, the first column stands left, all others right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = [
        [
            cell.rjust(width) if number else cell.ljust(width)
            for number, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        for row in rows
    ]
    padded.insert(1, ["-" * (width - 1) + ":" if number else "-" * width for number, width in enumerate(widths)])
    return "\n".join(f"| {' | '.join(row)} |" for row in padded)


def _numbers(column: Column, found: Summary | None) -> list[str]:
    if found is None:
        return ["", ""]
    half = "" if np.isnan(found.half_width) else f"{column.scale * found.half_width:.6g}"
    return [f"{column.scale * found.mean:.6g}", half]


def _notes(
    results: Results, role: str, columns: Sequence[Column], found: Mapping[str, Mapping[str, Mapping[Key, float]]]
) -> list[str]:
    notes = [f"No {column.title}: {_why_missing(results, column)}." for column in COLUMNS if column not in columns]
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
    if role == "train" and any(method.endswith("_rooms") for method in found):
        notes.append("Methods whose name ends in `_rooms` were trained in generated rooms, never in these scenes.")
    return notes


def _why_missing(results: Results, column: Column) -> str:
    if not column.of_reconstruction:
        return "no episode has it"
    if column.name == "lpips":
        reasons = {one.lpips_reason for one in results.reconstructions if one.lpips_reason}
        return "; ".join(sorted(reasons)) or "no reconstruction has it"
    return (
        "no whole episode was reconstructed"
        if not any(one.whole for one in results.reconstructions)
        else "no reconstruction has it"
    )
