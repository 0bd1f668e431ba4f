"""`python -m avp_experiment.report`: every table and figure of an experiment, and the page that holds them."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tyro.conf import Positional

from avp_experiment.claims import claims
from avp_experiment.configuration import TRAIN, UNSEEN
from avp_experiment.pictures import DEFAULT_MAPS, maps, same_views
from avp_experiment.plots import (
    Drawn,
    Missing,
    cpv_while_training,
    psnr_by_views,
    reward_while_training,
    visibility_and_psnr,
)
from avp_experiment.results import FILE, Results, read_results
from avp_experiment.tables import make_table
from avp_habitat import command
from avp_habitat.errors import AVPError, unknown_name

PAGE, CLAIMS, READING = "results.md", "claims.md", "reading.md"
_TABLES = {
    "table2": (TRAIN, "Table 2: scenes of training"),
    "table3": (UNSEEN, "Table 3: unseen scenes, no retraining"),
}
_SETTINGS = ("seeds", "starts", "budget", "observation", "steps", "steps_rooms", "width", "height", "reconstruction",
             "iterations")  # fmt: skip


def write_report(folder: Path, *, shown_maps: Sequence[str] = DEFAULT_MAPS) -> Path:
    """Write tables, figures (5 of some methods), claims and the page that holds them; gives the page.

    Raises:
        UsageError: no such folder.
        AVPError: the results are damaged, or the folder cannot be written.
    """
    results = read_results(folder)
    parts: dict[str, Callable[[], str]] = {
        title: partial(_table, results, name, role, title) for name, (role, title) in _TABLES.items()
    }
    parts |= {
        title: partial(_figure, results, name, title, draw) for name, (title, draw) in _figures(shown_maps).items()
    }
    sections, left_out = [], []
    try:
        for title, make in parts.items():
            try:
                sections.append(f"## {title}\n\n{make()}")
            except Missing as reason:
                left_out.append(f"- {title}: {reason}.")
        said = claims(results)
        (folder / CLAIMS).write_text(said, encoding="utf-8")
        reading = folder / READING
        read = [_below(reading.read_text(encoding="utf-8"))] if reading.is_file() else []
        end = "\n".join(["## Left out", "", *(left_out or ["Nothing."])])
        text = "\n\n".join(["# Results of the experiment", _origin(results), *read, *sections, _below(said), end])
        (folder / PAGE).write_text(f"{text}\n", encoding="utf-8")
    except OSError as error:
        raise AVPError(f"{folder}: cannot write there: {error.strerror or error}") from None
    return folder / PAGE


def _figures(shown_maps: Sequence[str]) -> dict[str, tuple[str, Callable[[Results], Drawn]]]:
    return {
        "figure3": ("Figure 3: coverage per view while training", cpv_while_training),
        "figure4": ("Figure 4: mean reward while training", reward_while_training),
        "figure5": ("Figure 5: episodes from above", partial(maps, methods=shown_maps)),
        "figure6": ("Figure 6: the same held-out views", partial(same_views, role=TRAIN)),
        "figure6_unseen": ("Figure 6, unseen scene", partial(same_views, role=UNSEEN)),
        "psnr_by_views": ("PSNR by views", psnr_by_views),
        "visibility": ("Visibility and PSNR", visibility_and_psnr),
    }


def _table(results: Results, name: str, role: str, title: str) -> str:
    table = make_table(results, role)
    paths = [results.folder / f"{name}.{suffix}" for suffix in ("md", "csv")]
    if table is None:
        for path in paths:
            path.unlink(missing_ok=True)
        raise Missing("no episode there is done" if results.scenes(role) else "no such scene in this experiment")
    markdown, numbers, counts = table
    for path, text in zip(paths, (f"# {title}\n\n{markdown}", numbers), strict=True):
        path.write_text(text, encoding="utf-8")
    episodes = " to ".join(str(count) for count in dict.fromkeys((min(counts), max(counts))))
    return (
        f"{', '.join(results.scenes(role))}: mean ± 95 % confidence interval over {results.seeds} (Student's t), "
        f"{episodes} episodes of each method. [CSV]({name}.csv)\n\n{markdown.rstrip()}"
    )


def _figure(results: Results, name: str, title: str, draw: Callable[[Results], Drawn]) -> str:
    path = results.folder / f"{name}.png"
    # One of an earlier state of the results would stand beside figures of this one.
    path.unlink(missing_ok=True)
    drawn = draw(results)
    drawn.save(path)
    return f"![{title}]({path.name})\n\n{drawn.caption}"


def _below(text: str) -> str:
    """A page as a part of another: its headings one level deeper."""
    return "\n".join(f"#{line}" if line.startswith("#") else line for line in text.strip().splitlines())


def _origin(results: Results) -> str:
    origin, configuration = results.origin, results.configuration
    machine = origin["machine"] | {"gpu": origin["machine"]["gpu"] or "no GPU"}
    settings = ", ".join(f"{name} {configuration[name]}" for name in _SETTINGS if name in configuration)
    about = {
        "command": f"`{origin['command']}`",
        "preset": f"{configuration.get('preset', 'not known')}: {settings}",
        "scenes": ", ".join(f"{scene['name']} ({scene['role']})" for scene in configuration["scenes"]),
        "commits": ", ".join(f"`{commit[:12]}`" for commit in origin["commits"]) or "not known",
        "machine": "{platform}, {processor}, {cores} cores, {gpu}".format(
            **machine | {"gpu": machine["gpu"] or "no GPU"}
        ),
        "versions": ", ".join(f"{name} {version}" for name, version in origin["versions"].items()),
        "finished": f"{origin['finished']}, {origin['hours']} hours of work in all cells",
        "failed cells": str(len(results.failed)) + (" (see below)" if results.failed else ""),
    }
    made = f"Made from [`{FILE}`]({FILE}) by `python -m avp_experiment.report FOLDER`; data and settings are all in it."
    return "\n".join([made, "", *(f"- {name}: {value}" for name, value in about.items())])


@dataclass(frozen=True)
class ReportOptions:
    """Make every table and figure of an experiment from its results.json, and the page that holds them, results.md.

    A file reading.md beside them, written by hand, becomes a part of the page. What cannot be made is left out; the
    page says why.
    """

    folder: Positional[Path]
    """Of an experiment: holds results.json."""
    maps: tuple[str, ...] = DEFAULT_MAPS
    """Methods of figure 5."""


def main(options: ReportOptions) -> None:
    """Make the tables and figures again."""
    if options.maps != DEFAULT_MAPS:
        known = read_results(options.folder).methods
        for name in options.maps:
            if name not in known:
                raise unknown_name("method of --maps", name, known)
    print(f"report: {write_report(options.folder, shown_maps=options.maps)}")


if __name__ == "__main__":
    sys.exit(command.run(main))
