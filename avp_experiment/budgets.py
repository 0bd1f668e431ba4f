"""What methods know after parts of the budget: tables of a figure by part and by scene, and its curves."""

from functools import partial

from avp_experiment.configuration import TRAIN, UNSEEN
from avp_experiment.plots import Drawn, Missing, legend, new_figure, style_of
from avp_experiment.results import Key, Results
from avp_experiment.statistics import NOTHING, Summary, summary
from avp_habitat.metrics import FIGURES
from avp_habitat.tables import table

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Of the budget."""
SHOWN = ("coverage", "visibility", "visibility_parallax", "completion_ratio")
_ROLE = {UNSEEN: "unseen scenes", TRAIN: "scenes of training"}


def by_budget(results: Results) -> str:
    """A table of each figure by part of the budget, over all scenes of a role.

    Raises:
        Missing: no figure is known after a part of the budget.
    """
    parts = []
    for role, where in _ROLE.items():
        for name in SHOWN:
            shares = _known(results, role, name)
            # Of all views alone other tables tell.
            if len(shares) > 1:
                rows = {
                    method: [summary(results.after(method, role, name, share)) for share in shares]
                    for method in results.methods
                }
                heads = [_head(results, share) for share in shares]
                parts.append(f"{FIGURES[name].heading}, {where}:\n\n{_table(heads, rows, name)}")
    if not parts:
        raise Missing("no figure is known after a part of the budget")
    return "\n\n".join([*parts, *(note for role in _ROLE for note in results.unvisited(role))])


def by_scene(results: Results) -> str:
    """In each unseen scene: completion ratio of the captured depth after half and all of the budget, and PSNR.

    Raises:
        Missing: neither is known.
    """
    scenes, parts = results.scenes(UNSEEN), []
    for title, name, find in (
        ("completion ratio [%] after half of the budget", "completion_ratio", partial(_after, share=0.5)),
        ("completion ratio [%] after all of it", "completion_ratio", partial(_after, share=1.0)),
        ("PSNR [dB] of reconstructions from all views", "psnr", _psnr),
    ):
        rows = {method: [summary(_of(scene, find(results, method))) for scene in scenes] for method in results.methods}
        if any(map(any, rows.values())):
            parts.append(f"{title}:\n\n{_table(scenes, rows, name)}")
    if not parts:
        raise Missing("neither completion ratio nor PSNR is known")
    return "\n\n".join(parts)


def _after(results: Results, method: str, *, share: float) -> dict[Key, float]:
    return results.after(method, UNSEEN, "completion_ratio", share)


def _psnr(results: Results, method: str) -> dict[Key, float]:
    return results.values(method, UNSEEN, "psnr")


def _of(scene: str, values: dict[Key, float]) -> dict[Key, float]:
    return {key: value for key, value in values.items() if key[0] == scene}


def curves(results: Results) -> Drawn:
    """Visibility, parallax and completion ratio by part of the budget, in unseen scenes."""
    known = {name: shares for name in SHOWN if len(shares := _known(results, UNSEEN, name)) > 1}
    if not known:
        raise Missing("no figure is known after a part of the budget")
    picture = new_figure(4.2)
    panels = picture.subplots(1, len(known), squeeze=False)[0]
    for axes, (name, shares) in zip(panels, known.items(), strict=True):
        for method in results.methods:
            means = [summary(results.after(method, UNSEEN, name, share)) for share in shares]
            if all(means):
                colour, marker, line = style_of(method)
                look = {"color": colour, "markerfacecolor": colour if line == "-" else "white", "linewidth": 1.5}
                shown = [FIGURES[name].scale * mean.mean for mean in means if mean]
                axes.plot([100 * share for share in shares], shown, marker + line, markersize=5, label=method, **look)
        axes.set(xlabel="share of the budget [%]", title=FIGURES[name].heading)
        axes.grid(alpha=0.3)
    legend(picture, panels)
    said = "Means over all unseen scenes; an episode that has ended by then counts with all that it had. "
    return Drawn(picture, said + f"Whole budgets: {_budgets(results)} views.")


def _known(results: Results, role: str, name: str) -> list[float]:
    """The shares after which a figure is known of every method that has it at all."""
    having = [method for method in results.methods if results.after(method, role, name, 1.0)]
    return [share for share in SHARES if having and all(results.after(one, role, name, share) for one in having)]


def _head(results: Results, share: float) -> str:
    """Of a column: the number of views where all scenes have the same budget."""
    budget = results.one_budget
    return f"{100 * share:.0f} % of the views" if budget is None else f"{round(share * budget)} views"


def _budgets(results: Results) -> str:
    return ", ".join(f"{scene} {results.budget(scene)}" for scene in results.scenes(UNSEEN))


def _table(heads: list[str], rows: dict[str, list[Summary | None]], name: str) -> str:
    cells = [
        [method, *(found.text(FIGURES[name]) if found else NOTHING for found in row)]
        for method, row in rows.items()
        if any(row)
    ]
    return table(["method", *heads], cells, words=1)
