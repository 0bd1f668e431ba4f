"""The report of an evaluation: a table to print, and a folder with JSON, CSV and a plot of the curves."""

import csv
import json
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from avp_habitat import tables
from avp_habitat.errors import AVPError
from avp_habitat.files import atomic_folder
from avp_habitat.metrics import CONFIDENCE, Figure, coverage_per_view, explained, mean_and_half_width
from avp_habitat.provenance import git_commit, installed_versions
from avp_sb3.evaluation.policy import PolicyResult, figures_of

JSON_FILE, CSV_FILE, TABLE_FILE, PLOT_FILE = "evaluation.json", "episodes.csv", "table.md", "coverage.png"
FORMAT, FORMAT_VERSION = "avp-evaluation", 1
LEGEND = f"{explained('coverage', 'ANND', 'EI', 'CpV', 'redundant views', 'stop')}; ±: half of the 95 % interval"
"""One line to print below a table."""
_NONE = "–"
_VERSIONED = ("avp-suite", "stable-baselines3", "torch", "gymnasium", "numpy", "open3d", "scipy")


class ReportError(AVPError):
    """A report that cannot be written or read."""


def table(results: Sequence[PolicyResult], metrics: Iterable[Any] = ()) -> str:
    """Figures by policy as a Markdown table: mean ± half the 95 % confidence interval; no ± for one episode.

    The user's metrics, as of `TaskSettings.metrics`, say how their figures are shown.
    """
    head = ["figure", *(result.policy for result in results)]
    return tables.table(head, [[name, *row] for name, row in cells(results, metrics).items()])


def cells(results: Sequence[PolicyResult], metrics: Iterable[Any] = ()) -> dict[str, list[str]]:
    """By the heading of a figure, its text for each policy; arguments as of `table`."""
    present, known = names_of(results), figures_of(metrics)
    # Whoever reads a report may not have the metrics that its figures are of.
    known |= {name: Figure(name, name, digits=3) for name in present if name not in known}
    shown = {
        figure.heading: [
            figure.text(*map(float, mean_and_half_width(each.figures[name]))) if name in each.figures else _NONE
            for each in results
        ]
        for name, figure in known.items()
        if name in present
    }
    ratio = known["cpv"]
    episodes = [str(len(result.seeds)) for result in results]
    return shown | {ratio.heading: [ratio.text(cpv(result)) for result in results], "episodes": episodes}


def names_of(results: Sequence[PolicyResult]) -> list[str]:
    """The figures of all policies: some are known only under the reward by which one acts."""
    return list(dict.fromkeys(name for result in results for name in result.figures))


def cpv(result: PolicyResult) -> float:
    """Coverage per view in percent, of all episodes together."""
    return coverage_per_view(result.figures["coverage"], result.figures["views"])


def summary(result: PolicyResult) -> dict[str, dict[str, float | None]]:
    """Mean and half the 95 % confidence interval by figure; None where one episode tells nothing of the spread."""
    values = {name: mean_and_half_width(figures) for name, figures in result.figures.items()}
    return {name: {"mean": _number(mean), "half_width": _number(half)} for name, (mean, half) in values.items()}


def write_report(
    folder: Path, results: Sequence[PolicyResult], about: Mapping[str, Any], metrics: Iterable[Any] = ()
) -> Path:
    """Write the folder; it appears only when it is whole.

    `about` says what was evaluated (command, scene, settings, …), as JSON; machine, commit and versions are added.

    Raises:
        UsageError: the folder exists.
        ReportError: it cannot be written.
    """
    value = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        **about,
        "confidence": CONFIDENCE,
        "commit": git_commit(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "versions": installed_versions(_VERSIONED),
        "policies": [_entry(result) for result in results],
    }
    with atomic_folder(folder, failure=ReportError, option="--out") as made:
        text = json.dumps(value, indent=2, allow_nan=False)
        (made / JSON_FILE).write_text(f"{text}\n", encoding="utf-8")
        (made / TABLE_FILE).write_text(f"{table(results, metrics)}\n\n{LEGEND}\n", encoding="utf-8")
        _write_csv(made / CSV_FILE, results)
        _plot(made / PLOT_FILE, results)
    return folder


def read_report(folder: str | Path) -> list[PolicyResult]:
    """The results of a report, equal to those that were written; `ReportError` if there are none."""
    path = Path(folder) / JSON_FILE
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
        found = (value["format"], value["format_version"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ReportError(f"{path}: expected a report of avp_sb3.evaluate, could not read it: {error!r}") from None
    if found != (FORMAT, FORMAT_VERSION):
        raise ReportError(f"{path}: expected {FORMAT} version {FORMAT_VERSION}, found {found[0]} version {found[1]}")
    return [_result(entry) for entry in value["policies"]]


def _number(value: Any) -> float | None:
    """As JSON has it, which knows no nan."""
    return float(value) if np.isfinite(value) else None


def _entry(result: PolicyResult) -> dict[str, Any]:
    mean, half = mean_and_half_width(result.curve)
    episodes = [
        {
            "seed": int(seed),
            **{name: _number(values[row]) for name, values in result.figures.items()},
            "curve": result.curve[row].tolist(),
        }
        for row, seed in enumerate(result.seeds)
    ]
    return {
        "policy": result.policy,
        "observation": result.observation,
        "training_run": result.training_run,
        "summary": summary(result),
        "curve": {"mean": mean.tolist(), "half_width": [_number(value) for value in half]},
        "episodes": episodes,
    }


def _result(entry: Mapping[str, Any]) -> PolicyResult:
    episodes = entry["episodes"]
    names = [name for name in episodes[0] if name not in ("seed", "curve")]
    return PolicyResult(
        policy=entry["policy"],
        seeds=np.array([episode["seed"] for episode in episodes]),
        curve=np.array([episode["curve"] for episode in episodes]),
        figures={name: np.array([episode[name] for episode in episodes], dtype=np.float64) for name in names},
        training_run=entry["training_run"],
        observation=entry["observation"],
    )


def _write_csv(path: Path, results: Sequence[PolicyResult]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = names_of(results)
        writer.writerow(["policy", "seed", *names])
        for result in results:
            for row, seed in enumerate(result.seeds):
                values = [f"{result.figures[name][row]:.9g}" if name in result.figures else "" for name in names]
                writer.writerow([result.policy, seed, *values])


def _plot(path: Path, results: Sequence[PolicyResult]) -> None:
    """Mean coverage by view with its confidence band."""
    from matplotlib import figure

    picture = figure.Figure(figsize=(7, 4.5), layout="constrained")
    axes = picture.subplots()
    for result in results:
        mean, half = mean_and_half_width(100 * result.curve)
        views = np.arange(1, len(mean) + 1)
        (line,) = axes.plot(views, mean, label=f"{result.policy} ({len(result.seeds)} episodes)")
        axes.fill_between(views, mean - half, mean + half, color=line.get_color(), alpha=0.2, linewidth=0)
    axes.set(xlabel="views", ylabel="coverage [%]", ylim=(0, 100), xlim=(1, None))
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", title="mean, 95 % confidence of the mean")
    picture.savefig(path, dpi=150)
