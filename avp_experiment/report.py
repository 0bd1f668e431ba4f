"""`python -m avp_experiment.report`: every table and figure of an experiment, and the page that holds them."""

import csv
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from avp_experiment import budgets, plots
from avp_experiment.claims import claims
from avp_experiment.configuration import ROOMS, TRAIN, UNSEEN, without_label
from avp_experiment.merging import merge
from avp_experiment.pictures import maps, same_views
from avp_experiment.results import FILE, Key, Results, read_results
from avp_experiment.statistics import NOTHING, Summary, summary
from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError, unknown_name
from avp_habitat.metrics import FIGURES, GEOMETRY, Figure
from avp_habitat.tables import table

PAGE, CLAIMS, READING = "results.md", "claims.md", "reading.md"
SCORES = ("psnr", "ssim", "lpips")
COLUMNS = ("views", "coverage", "annd_m", "ei", "path_length_m", "visibility", "visibility_parallax", *SCORES)
"""The suite's figures that tables 2 and 3 show; those that users added follow."""
_DEPTH, _MODEL = "geometry: the captured depth, fused", "geometry of the reconstructions"
_TABLES = {
    "table2": (TRAIN, "Table 2: scenes of training", COLUMNS, Results.values),
    "table2_geometry": (TRAIN, f"Table 2, {_DEPTH}", GEOMETRY, Results.values),
    "table2_model": (TRAIN, f"Table 2, {_MODEL}", GEOMETRY, Results.model_geometry),
    "table3": (UNSEEN, "Table 3: unseen scenes, no retraining", COLUMNS, Results.values),
    "table3_geometry": (UNSEEN, f"Table 3, {_DEPTH}", GEOMETRY, Results.values),
    "table3_model": (UNSEEN, f"Table 3, {_MODEL}", GEOMETRY, Results.model_geometry),
}
_PARTS = {
    "by_budget": ("By part of the budget", budgets.by_budget),
    "by_scene": ("By scene", budgets.by_scene),
}
"""Tables that the page alone holds."""
Values = Callable[[Results, str, str, str], Mapping[Key, float]]
"""A figure of a method in scenes of a role, by episode."""
Rows = Mapping[str, Mapping[str, Summary | None]]
_SETTINGS = ("seeds", "starts", "budget", "observation", "steps", "steps_rooms", "width", "height", "reconstruction",
             "iterations")  # fmt: skip
_VERSIONS = ("python", "torch", "nerfstudio", "open3d", "habitat-sim")
"""Told of every row, beside those that differ."""


def write_report(folder: Path, *, shown_maps: Sequence[str] = ()) -> Path:
    """Write tables, figures (5 of some methods), claims and the page that holds them; gives the page."""
    results = read_results(folder)
    parts: list[tuple[str, Callable[[Results, str, str], str], str]] = [
        (title, partial(_table, role=role, columns=columns, values=values), name)
        for name, (role, title, columns, values) in _TABLES.items()
    ]
    parts += [(title, partial(_only_here, make=make), name) for name, (title, make) in _PARTS.items()]
    parts += [(title, partial(_figure, draw=draw), name) for name, (title, draw) in _figures(shown_maps).items()]
    sections, left_out = [], []
    try:
        for title, make, name in parts:
            try:
                sections.append(f"## {title}\n\n{make(results, name, title)}")
            except plots.Missing as reason:
                left_out.append(f"- {title}: {reason}.")
        said = claims(results)
        (folder / CLAIMS).write_text(said, encoding="utf-8")
        reading = folder / READING
        read = [_below(reading.read_text(encoding="utf-8"))] if reading.is_file() else []
        end = "\n".join(["## Left out", "", *(left_out or ["Nothing."])])
        sections += [_below(said), f"## Where each row comes from\n\n{_sources(results)}", end]
        text = "\n\n".join(["# Results of the experiment", _about(results), *read, *sections])
        (folder / PAGE).write_text(f"{text}\n", encoding="utf-8")
    except OSError as error:
        raise AVPError(f"{folder}: cannot write there: {error.strerror or error}") from None
    return folder / PAGE


def _figures(shown_maps: Sequence[str]) -> dict[str, tuple[str, Callable[[Results], plots.Drawn]]]:
    return {
        "figure3": ("Figure 3: coverage per view while training", plots.cpv_while_training),
        "figure4": ("Figure 4: mean reward while training", plots.reward_while_training),
        "figure5": ("Figure 5: episodes from above", partial(maps, methods=shown_maps)),
        "figure6": ("Figure 6: the same held-out views", partial(same_views, role=TRAIN)),
        "figure6_unseen": ("Figure 6, unseen scene", partial(same_views, role=UNSEEN)),
        "psnr_by_views": ("PSNR by views", plots.psnr_by_views),
        "budgets": ("By part of the budget", budgets.curves),
        "visibility": ("What predicts PSNR", plots.predictors_and_psnr),
    }


def _only_here(results: Results, name: str, title: str, make: Callable[[Results], str]) -> str:
    return make(results)


def _table(results: Results, name: str, title: str, role: str, columns: Sequence[str], values: Values) -> str:
    """Write the table of the scenes of a role, as Markdown and as CSV; what the page holds of it."""
    paths = [results.folder / f"{name}.{suffix}" for suffix in ("md", "csv")]
    # One of an earlier state of the results would stand beside figures of this one.
    for path in paths:
        path.unlink(missing_ok=True)
    figures = {name: FIGURES[name] for name in columns} | (dict(results.figures) if columns is COLUMNS else {})
    found = {method: {name: values(results, method, role, name) for name in figures} for method in results.methods}
    found = {method: known for method, known in found.items() if any(known.values())}
    if not found:
        nothing = "no episode there is done" if columns is COLUMNS else "no episode has such figures"
        raise plots.Missing(nothing if results.scenes(role) else "no such scene in this experiment")
    shown = [figure for name, figure in figures.items() if any(values[name] for values in found.values())]
    if not shown:
        raise plots.Missing("no episode has such figures")
    rows = {method: {one.name: summary(values[one.name]) for one in shown} for method, values in found.items()}
    missing = [figure for figure in figures.values() if figure not in shown]
    notes = [f"No {figure.heading}: {_why_missing(results, figure.name)}." for figure in missing]
    cells = [
        [method, *(mean.text(one) if (mean := row[one.name]) else NOTHING for one in shown)]
        for method, row in rows.items()
    ]
    lines = table(["method", *(figure.heading for figure in shown)], cells, words=1)
    markdown = "\n".join([lines, *(f"\n{note}" for note in (*notes, *_notes(results, role, found)))])
    episodes = {method: max(map(len, known.values())) for method, known in found.items()}
    paths[0].write_text(f"# {title}\n\n{markdown}\n", encoding="utf-8")
    _write_csv(paths[1], rows, shown, episodes)
    return (
        f"{', '.join(results.scenes(role))}: mean ± 95 % confidence interval over {results.seeds} (Student's t), "
        f"{plots.span(list(episodes.values()))} episodes of each method. [CSV]({name}.csv)\n\n{markdown}"
    )


def _write_csv(path: Path, rows: Rows, shown: Sequence[Figure], episodes: Mapping[str, int]) -> None:
    """The same in the same units, mean and half width in columns of their own, with more digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        titles = [title for figure in shown for title in (figure.heading, f"± {figure.heading}")]
        writer.writerow(["method", "seeds", "episodes", *titles])
        for method, row in rows.items():
            line = [method, max((mean.seeds for mean in row.values() if mean), default=0), episodes[method]]
            for figure in shown:
                mean = row[figure.name]
                both = (mean.mean, mean.half_width) if mean else (np.nan, np.nan)
                line += ["" if np.isnan(number) else f"{figure.scale * number:.6g}" for number in both]
            writer.writerow(line)


def _notes(results: Results, role: str, found: Mapping[str, Mapping[str, Mapping[Key, float]]]) -> list[str]:
    missing = [method for method in results.methods if method not in found]
    notes = [f"No episode of {', '.join(missing)}."] if missing else []
    for name, what in (("coverage", "episodes"), ("psnr", "reconstructions"), ("completion_ratio", "shapes")):
        counts = {method: len(values[name]) for method, values in found.items() if values.get(name)}
        most = max(counts.values(), default=0)
        if fewer := [f"{method} {count}" for method, count in counts.items() if count < most]:
            notes.append(f"Of fewer than {most} {what}: {', '.join(fewer)}.")
    notes += results.unvisited(role)
    if role == TRAIN and any(without_label(method).endswith(ROOMS) for method in found):
        notes.append(f"Methods whose name ends in `{ROOMS}` were trained in generated rooms, never in these scenes.")
    return notes


def _why_missing(results: Results, name: str) -> str:
    if name not in SCORES:
        return "no episode has it"
    reasons = {one.lpips_reason for one in results.reconstructions if name == "lpips" and one.lpips_reason}
    whole = any(one.whole for one in results.reconstructions)
    nothing = "no reconstruction has it" if whole or name == "lpips" else "no whole episode was reconstructed"
    return "; ".join(sorted(reasons)) or nothing


def _figure(results: Results, name: str, title: str, draw: Callable[[Results], plots.Drawn]) -> str:
    path = results.folder / f"{name}.png"
    # One of an earlier state of the results would stand beside figures of this one.
    path.unlink(missing_ok=True)
    drawn = draw(results)
    drawn.save(path)
    return f"![{title}]({path.name})\n\n{drawn.caption}"


def _below(text: str) -> str:
    """A page as a part of another: its headings one level deeper."""
    return "\n".join(f"#{line}" if line.startswith("#") else line for line in text.strip().splitlines())


def _about(results: Results) -> str:
    configuration = results.configuration
    settings = ", ".join(f"{name} {configuration[name]}" for name in _SETTINGS if name in configuration)
    about = {
        "preset": f"{configuration.get('preset', 'not known')}: {settings}",
        "scenes": ", ".join(f"{scene['name']} ({scene['role']})" for scene in configuration["scenes"]),
        "failed cells": str(len(results.failed)) + (" (see below)" if results.failed else ""),
    }
    for label, origin in results.origins.items():
        versions = ", ".join(f"{name} {version}" for name, version in origin["versions"].items())
        done = f"finished {origin['finished']}, {origin['hours']} hours of work in all cells"
        about[f"results of {label}"] = f"`{origin['command']}`, {done}; {versions}"
    made = f"Made from [`{FILE}`]({FILE}) by `python -m avp_experiment.report FOLDER`; data and settings are all in it."
    return "\n".join([made, "", *(f"- {name}: {value}" for name, value in about.items())])


def _sources(results: Results) -> str:
    """A table with a line for each method and each experiment that measured it."""
    versions = [origin["versions"] for origin in results.origins.values()]
    known = dict.fromkeys(name for one in versions for name in one)
    shown = [name for name in known if name in _VERSIONS or len({one.get(name) for one in versions}) > 1]
    rows = []
    for method in results.methods:
        for label in results.sources[method]:
            origin = results.origins[label]
            machine = origin["machine"] | {"gpu": origin["machine"]["gpu"] or "no GPU"}
            rows.append(
                [
                    method,
                    label,
                    ", ".join(f"`{commit[:12]}`" for commit in results.commits[method]) or "not known",
                    ", ".join(f"{name} {origin['versions'].get(name, NOTHING)}" for name in shown),
                    "{platform}, {processor}, {cores} cores, {gpu}".format(**machine),
                    f"`{origin['command']}`",
                ]
            )
    return table(["method", "results", "commits", "versions", "machine", "command"], rows)


@dataclass(frozen=True)
class ReportOptions:
    """Make every table and figure of an experiment from its results.json, and the page that holds them, results.md.

    Those of several experiments of the same settings are merged first. A file reading.md beside them, written by hand,
    becomes a part of the page. What cannot be made is left out; the page says why.
    """

    folders: Positional[tuple[Path, ...]]
    """Of experiments: each holds results.json."""
    out: Path | None = None
    """Folder for the merged results and their report: new, empty, or of an earlier merge, which is replaced."""
    maps: tuple[str, ...] = ()
    """Methods of figure 5 (omitted: three that most ask for)."""

    def __post_init__(self) -> None:
        """One folder, or several and one to merge them into."""
        if not self.folders:
            raise UsageError("expected the folder of an experiment, or several and --out FOLDER, got none")
        if self.out is None and len(self.folders) > 1:
            raise UsageError(f"out: {len(self.folders)} folders are merged into another: expected --out FOLDER")


def main(options: ReportOptions) -> None:
    """Make the tables and figures again."""
    merged = merge(options.folders, options.out) if options.out else None
    known = merged.content["methods"] if merged else read_results(options.folders[0]).methods
    for name in options.maps:
        if name not in known:
            raise unknown_name("method of --maps", name, known)
    if merged:
        merged.write()
    print(f"report: {write_report(options.out or options.folders[0], shown_maps=options.maps)}")


if __name__ == "__main__":
    sys.exit(command.run(main))
