"""What methods know after parts of the budget: tables of a figure by part and by scene, and its curves."""

import numpy as np

from avp_experiment.configuration import TRAIN, UNSEEN
from avp_experiment.plots import Drawn, Missing, legend, new_figure, style_of
from avp_experiment.results import Results
from avp_experiment.statistics import NOTHING, Summary, summary
from avp_habitat.metrics import FIGURES
from avp_habitat.tables import table

PARTS = (0.25, 0.5, 0.75, 1.0)
"""Of the budget."""
SHOWN = ("visibility", "visibility_parallax", "completion_ratio")
_ROLE = {UNSEEN: "unseen scenes", TRAIN: "scenes of training"}


def by_budget(results: Results) -> str:
    """A table of each figure by part of the budget, over all scenes of a role.

    Raises:
        Missing: no figure is known after a part of the budget.
    """
    heads = [_part(results, part) for part in PARTS]
    parts = []
    for role, where in _ROLE.items():
        for name in SHOWN:
            rows = {
                method: [summary(results.after(method, role, name, part)) for part in PARTS]
                for method in results.methods
            }
            # Of one part alone, that of all views, other tables tell.
            if any(len(list(filter(None, row))) > 1 for row in rows.values()):
                parts.append(f"{FIGURES[name].heading}, {where}:\n\n{_table(heads, rows, name)}")
    if not parts:
        raise Missing("no figure is known after a part of the budget")
    return "\n\n".join(parts)


def by_scene(results: Results) -> str:
    """Completion ratio in each unseen scene, after half and after all of the budget.

    Raises:
        Missing: it is not known.
    """
    scenes, parts = results.scenes(UNSEEN), []
    for part in (0.5, 1.0):
        rows = {method: [_in(results, method, scene, part) for scene in scenes] for method in results.methods}
        if any(map(any, rows.values())):
            head = "half of the budget" if part < 1 else "all of it"
            parts.append(f"After {head}:\n\n{_table(scenes, rows, 'completion_ratio')}")
    if not parts:
        raise Missing("no completion ratio is known")
    return "\n\n".join(parts)


def curves(results: Results) -> Drawn:
    """Visibility, parallax and completion ratio by part of the budget, in unseen scenes."""
    known = [name for name in SHOWN if any(results.after(method, UNSEEN, name, 0.5) for method in results.methods)]
    if not known:
        raise Missing("no figure is known after a part of the budget")
    picture = new_figure(4.4)
    panels = picture.subplots(1, len(known), squeeze=False)[0]
    for axes, name in zip(panels, known, strict=True):
        for method in results.methods:
            means = [found.mean if (found := _over_all(results, method, name, part)) else np.nan for part in PARTS]
            if not np.isnan(means).all():
                colour, marker, line = style_of(method)
                look = {"color": colour, "markerfacecolor": colour if line == "-" else "white", "linewidth": 1.5}
                at = [100 * part for part in PARTS]
                axes.plot(at, FIGURES[name].scale * np.array(means), marker + line, markersize=5, label=method, **look)
        axes.set(xlabel="share of the budget [%]", title=FIGURES[name].heading)
        axes.grid(alpha=0.3)
    legend(picture, panels)
    said = "Means over all unseen scenes; an episode that has ended by then counts with all that it had. "
    return Drawn(picture, said + f"Whole budgets: {_budgets(results)} views.")


def _over_all(results: Results, method: str, name: str, part: float) -> Summary | None:
    return summary(results.after(method, UNSEEN, name, part))


def _in(results: Results, method: str, scene: str, part: float) -> Summary | None:
    found = results.after(method, UNSEEN, "completion_ratio", part)
    return summary({key: value for key, value in found.items() if key[0] == scene})


def _part(results: Results, part: float) -> str:
    """Of a column: the number of views where all scenes have the same."""
    budgets = {results.budget(scene["name"]) for scene in results.configuration["scenes"]}
    return f"{100 * part:.0f} % of the views" if len(budgets) > 1 else f"{round(part * budgets.pop())} views"


def _budgets(results: Results) -> str:
    return ", ".join(f"{scene} {results.budget(scene)}" for scene in results.scenes(UNSEEN))


def _table(heads: list[str], rows: dict[str, list[Summary | None]], name: str) -> str:
    cells = [
        [method, *(found.text(FIGURES[name]) if found else NOTHING for found in row)]
        for method, row in rows.items()
        if any(row)
    ]
    return table(["method", *heads], cells, words=1)
