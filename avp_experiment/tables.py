"""Tables 2 and 3: every method's figures in the scenes of training, and in scenes that no training has seen."""

import csv
import io
from collections.abc import Mapping, Sequence

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


Rows = dict[str, dict[str, Summary | None]]


def make_table(results: Results, role: str) -> tuple[str, str, list[int]] | None:
    """The table of the scenes of a role; None where no method has an episode there.

    Returns:
        Markdown with mean ± half the 95 % interval over seeds and notes below, CSV, and the numbers of episodes.
    """
    figures = {name: FIGURES[name] for name in COLUMNS} | dict(results.figures)
    found = {method: {name: results.values(method, role, name) for name in figures} for method in results.methods}
    found = {method: values for method, values in found.items() if values["coverage"]}
    if not found:
        return None
    shown = [figure for name, figure in figures.items() if any(values[name] for values in found.values())]
    rows = {method: {one.name: summary(values[one.name]) for one in shown} for method, values in found.items()}
    missing = [figure for figure in figures.values() if figure not in shown]
    notes = [f"No {figure.heading}: {_why_missing(results, figure.name)}." for figure in missing]
    cells = [
        [method, *(mean.text(one) if (mean := row[one.name]) else NOTHING for one in shown)]
        for method, row in rows.items()
    ]
    markdown = table(["method", *(figure.heading for figure in shown)], cells, words=1)
    episodes = {method: len(values["coverage"]) for method, values in found.items()}
    text = "\n".join([markdown, *(f"\n{note}" for note in (*notes, *_notes(results, role, found)))])
    return f"{text}\n", _csv(rows, shown, episodes), list(episodes.values())


def _csv(rows: Rows, shown: Sequence[Figure], episodes: Mapping[str, int]) -> str:
    """The same in the same units, mean and half width in columns of their own, with more digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    titles = [title for figure in shown for title in (figure.heading, f"± {figure.heading}")]
    writer.writerow(["method", "seeds", "episodes", *titles])
    for method, row in rows.items():
        line = [method, max((mean.seeds for mean in row.values() if mean), default=0), episodes[method]]
        for figure in shown:
            mean = row[figure.name]
            both = (mean.mean, mean.half_width) if mean else (np.nan, np.nan)
            line += ["" if np.isnan(number) else f"{figure.scale * number:.6g}" for number in both]
        writer.writerow(line)
    return text.getvalue()


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
