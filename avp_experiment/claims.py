"""The experiment's questions, each answered by figures of the results; which sentence is said, the figures decide."""

from collections.abc import Mapping, Sequence

import numpy as np

from avp_experiment import statistics
from avp_experiment.configuration import ROOMS, TRAIN, UNSEEN
from avp_experiment.results import Key, Results
from avp_experiment.statistics import NOTHING, PREDICTORS, Summary
from avp_habitat.metrics import FIGURES
from avp_habitat.tables import table

PAIRS = (("surface", "proposed"), (f"surface{ROOMS}", f"proposed{ROOMS}"))
"""Compared: the same training, another reward."""
OURS, OTHERS = "pretrained", ("coverage", f"coverage{ROOMS}", "greedy", "nbv")
"""Compared: the views that the former needs for what the others have in the end."""
FEWER_VIEWS, WORSE_DB, GOOD_RHO = 0.25, 0.3, 0.8
"""What the paper's method is held to: at least so many fewer views at no more than so much lower PSNR; and what a
predictor of PSNR is held to."""
VIEWS, COVERAGE, PSNR = (FIGURES[name] for name in ("views", "coverage", "psnr"))
_WHERE = {TRAIN: "in the scenes of training", UNSEEN: "in unseen scenes"}
Curves = dict[Key, dict[int, float]]
"""PSNR in dB by number of views, ascending, by episode."""


def claims(results: Results) -> str:
    """All answers as Markdown."""
    sections = {
        "Heuristic against learned policies": _heuristic(results),
        "`proposed` against `coverage`: fewer views at equal PSNR": _fewer_views(results),
        "`surface` against `proposed`": _surface_against_proposed(results),
        f"Views that `{OURS}` needs": _views_needed(results),
        "What predicts PSNR": _prediction(results),
        "Unseen scenes against those of training": _transfer(results),
        "Cells that failed": _failures(results),
    }
    head = (
        "# Claims\n\nEvery figure below is computed from `results.json`: mean ± 95 % confidence interval over seeds "
        "(Student's t); differences are paired by scene, seed and start."
    )
    parts = ["\n\n".join([f"## {title}", *paragraphs]) for title, paragraphs in sections.items()]
    return "\n\n".join([head, *parts]) + "\n"


def _failures(results: Results) -> list[str]:
    named = [(one, f" of {one['label']}" if "label" in one else "") for one in results.failed]
    lines = [f"- `{one['cell']}`{whose}: {one['reason']} (`{one['log']}`)" for one, whose in named]
    return ["\n".join(lines) or "None."]


def _heuristic(results: Results) -> list[str]:
    # By the trainings that are there; a training that failed has no episodes to compare.
    trained = {one.method for one in results.training} | {OURS}
    names, lines = ("coverage", "psnr"), []
    for role, where in _WHERE.items():
        found = {}
        for method in results.methods:
            pairs = [[results.values(one, role, name) for one in (method, "heuristic")] for name in names]
            both = [statistics.paired(*pair) for pair in pairs]
            if method in trained and any(both):
                found[method] = both
        if not found:
            lines.append(f"{where.capitalize()}: nothing to compare (no episodes of `heuristic` and a learned policy).")
            continue
        rows = [[method, *map(_difference, both, names)] for method, both in found.items()]
        lines.append(f"{where.capitalize()} the heuristic is {_below(list(found.values()))}.")
        lines.append(table(["learned − heuristic", *map(_heading, names)], rows, words=1))
    return lines


def _below(found: Sequence[Sequence[Summary | None]]) -> str:
    differences = [one for both in found for one in both if one is not None]
    missing = "" if len(differences) == 2 * len(found) else ", as far as there are figures"
    both = "coverage and PSNR" if any(psnr for _, psnr in found) else "coverage"
    if any(one.mean <= 0 for one in differences):
        return f"**not** below every learned policy in {both}{missing}"
    if known := [one for one in differences if not np.isnan(one.half_width)]:
        few = "" if len(known) == len(differences) else f" ({len(differences) - len(known)} of one seed have none)"
        if all(one.interval[0] > 0 for one in known):
            return f"clearly below every learned policy in {both}: no interval reaches 0{few}{missing}"
    return f"below every learned policy in {both} on average, but not every difference has an interval above 0{missing}"


def _fewer_views(results: Results) -> list[str]:
    lines = []
    pairs = [(f"proposed{ending}", f"coverage{ending}") for ending in ("", ROOMS)]
    for both in [pair for pair in pairs if set(pair) <= set(results.methods)] or pairs[:1]:
        lines += [_fewer_views_in(results, role, *both) for role in _WHERE if results.scenes(role)]
    return lines


def _fewer_views_in(results: Results, role: str, less: str, more: str) -> str:
    views, psnr = ([results.values(method, role, name) for method in (less, more)] for name in ("views", "psnr"))
    saved, difference = statistics.saved_share(*views), statistics.paired(*psnr)
    where = _WHERE[role].capitalize()
    if saved is None or difference is None:
        missing = "episodes" if saved is None else "reconstructions"
        return f"{where}: cannot be said, `{less}` and `{more}` have no {missing} in common."
    taken = " against ".join(map(_mean, views))
    return (
        f"{where} `{less}` takes {saved.text(COVERAGE)} % fewer views than `{more}` ({taken}); its PSNR "
        f"differs by {difference.text(PSNR, sign=True)} dB. At least {100 * FEWER_VIEWS:.0f} % fewer views at a "
        f"PSNR no more than {WORSE_DB} dB lower: {_holds(saved, difference)}"
    )


def _holds(saved: Summary, difference: Summary) -> str:
    if saved.mean < FEWER_VIEWS or difference.mean < -WORSE_DB:
        return "**does not hold** (by the means)."
    if np.isnan(saved.half_width) or np.isnan(difference.half_width):
        return "**holds** by the means (of one seed: no interval)."
    if saved.interval[0] >= FEWER_VIEWS and difference.interval[0] >= -WORSE_DB:
        return "**holds**, also at the unfavourable ends of both intervals."
    return "**holds** by the means, not over the whole intervals."


def _surface_against_proposed(results: Results) -> list[str]:
    lines = []
    for left, right in PAIRS:
        if not {left, right} <= set(results.methods):
            if (left, right) == PAIRS[0]:
                lines.append(f"Cannot be said: `{left}` and `{right}` are not both in this experiment.")
            continue
        for role in _WHERE:
            if results.scenes(role):
                lines += _compared(results, left, right, role)
    return lines


def _compared(results: Results, left: str, right: str, role: str) -> list[str]:
    where = _WHERE[role].capitalize()
    first, second = (_curves(results, method, role) for method in (left, right))
    common = [key for key in first if key in second]
    if not common:
        return [f"{where}: `{left}` and `{right}` have no reconstructed episodes in common."]
    first, second = {key: first[key] for key in common}, {key: second[key] for key in common}
    head, rows = ["views", f"{left} − {right} [dB]", "episodes"], []
    # A number of views that only some episodes reach compares others than the rest of the table does.
    placed = [
        {key: {results.place(key, views): psnr for views, psnr in curve.items()} for key, curve in curves.items()}
        for curves in (first, second)
    ]
    unit = "" if results.one_budget else " %"
    for place in sorted(set.intersection(*(set(curve) for curves in placed for curve in curves.values()))):
        both = [{key: curve[place] for key, curve in curves.items()} for curves in placed]
        rows.append([f"{place:.0f}{unit}", _difference(statistics.paired(*both), "psnr"), str(len(common))])
    shorter = {key: min(max(first[key]), max(second[key])) for key in common}
    both = []
    for curves in (first, second):
        at = {key: statistics.at_views(curve, shorter[key]) for key, curve in curves.items()}
        both.append({key: psnr for key, psnr in at.items() if psnr is not None})
    difference = statistics.paired(*both)
    rows.append(["the shorter episode's", _difference(difference, "psnr"), str(len(set.intersection(*map(set, both))))])
    said = _equal_views(difference) if difference else "no common range of views."
    return [
        f"{where}, `{left}` against `{right}`: {said}",
        table(head, rows, words=1),
        _equal(first, second, left, right),
        _equal(second, first, right, left),
    ]


def _curves(results: Results, method: str, role: str) -> Curves:
    """Of the episodes that were also reconstructed as a whole: only those say what all their views gave."""
    return {
        key: {views: one.scores["psnr"] for views, one in curve.items() if "psnr" in one.scores}
        for key, curve in results.reconstruction_curves(method, role).items()
        if any(one.whole and "psnr" in one.scores for one in curve.values())
    }


def _equal_views(difference: Summary) -> str:
    by = difference.text(PSNR, sign=True)
    shown = f"at the smaller of their numbers of views its PSNR differs by {by} dB"
    higher = "higher" if difference.mean > 0 else "not higher"
    if np.isnan(difference.half_width):
        return f"{shown}, {higher} (one seed: no interval)."
    if difference.interval[0] > 0:
        return f"{shown}: higher, the whole interval too."
    if difference.interval[1] < 0:
        return f"{shown}: lower, the whole interval too."
    return f"{shown}: {higher} on average, but the interval holds 0."


def _views_needed(results: Results) -> list[str]:
    lines = []
    for role, where in _WHERE.items():
        for other in OTHERS:
            for figure, curves in (("PSNR", _curves), ("completion ratio", _completion)):
                ours, theirs = (curves(results, method, role) for method in (OURS, other))
                common = [key for key in ours if key in theirs]
                # Of whole episodes alone there is nothing to say.
                if common and any(len(ours[key]) > 1 for key in common):
                    ours, theirs = ({key: found[key] for key in common} for found in (ours, theirs))
                    lines.append(f"- {where.capitalize()}: {_equal(ours, theirs, OURS, other, figure)}")
    return ["\n".join(lines) or f"Nothing to compare: no episodes of `{OURS}` and another method in common."]


def _completion(results: Results, method: str, role: str) -> Curves:
    """Completion ratio of the captured depth by number of views, by episode."""
    found = [one for one in results.rollouts if (one.method, one.role) == (method, role)]
    return {one.key: dict(sorted(curve.items())) for one in found if (curve := one.curves.get("completion_ratio"))}


def _equal(left: Curves, right: Curves, name: str, other: str, figure: str = "PSNR") -> str:
    """How many views the left method needs for the final PSNR, or another figure, of the right one."""
    taken = {key: float(max(curve)) for key, curve in right.items()}
    needed = {key: statistics.views_to_reach(curve, right[key][max(right[key])]) for key, curve in left.items()}
    reached = {key: views for key, views in needed.items() if views is not None}
    head = f"The final {figure} of `{other}` is reached by `{name}`"
    if not reached:
        return f"{head} in none of {len(needed)} episodes: never reached."
    if len(reached) < len(needed):
        head += f" in {len(reached)} of {len(needed)} episodes (never reached in the others),"
    have = {key: taken[key] for key in reached}
    least = sum(views == min(left[key]) for key, views in reached.items())
    note = f" (in {least} already at the fewest views measured, so that it may need fewer still)" if least else ""
    return (
        f"{head} after {_mean(reached)} views where `{other}` took {_mean(have)}: "
        f"{_difference(statistics.paired(have, reached), 'views')} views saved{note}."
    )


def _prediction(results: Results) -> list[str]:
    points = statistics.points_of(results)
    known = [name for name in PREDICTORS if points and name in points[0].shares]
    found = {name: statistics.correlations(points, name) for name in known}
    overall = {name: one["all"] for name, one in found.items() if one["all"]}
    if not overall:
        return ["Cannot be said: fewer than three reconstructions with a visibility and a PSNR, or all alike."]
    best = max(overall, key=lambda name: overall[name].rho)
    others = ", ".join(f"{FIGURES[name].title} {one}" for name, one in overall.items() if name != best)
    reached = f"at least {GOOD_RHO}" if overall[best].rho >= GOOD_RHO else f"below {GOOD_RHO}"
    also = f"; over whole episodes only {whole}" if (whole := found[best]["whole episodes"]) else ""
    head = ["Spearman's ρ with PSNR", *(FIGURES[name].title for name in known), "reconstructions", "rollouts"]
    rows = []
    for where in found[best]:
        one = found[best][where]
        counts = [str(one.points), str(one.rollouts)] if one else [NOTHING, NOTHING]
        rows.append([where, *(str(found[name].get(where) or NOTHING) for name in known), *counts])
    return [
        f"Over all reconstructions {FIGURES[best].title} predicts PSNR best: {overall[best]}, {reached}{also}"
        + (f"; {others}" if others else "")
        + ". In brackets: 95 % interval, bootstrap over rollouts.",
        table(head, rows, words=1),
    ]


def _transfer(results: Results) -> list[str]:
    for role, name in ((UNSEEN, "unseen scene"), (TRAIN, "scene of training")):
        if not results.scenes(role):
            return [f"No {name} in this experiment."]
    names = ("views", "coverage", "psnr")
    head, rows = ["unseen − train", *map(_heading, names)], []
    for method in results.methods:
        # The scenes differ, so only seed and start pair them.
        both = [[_over_scenes(results.values(method, role, name)) for role in (UNSEEN, TRAIN)] for name in names]
        cells = [_difference(statistics.paired(*values), name) for values, name in zip(both, names, strict=True)]
        if set(cells) != {NOTHING}:
            rows.append([method, *cells])
    if not rows:
        return ["Nothing to compare: no method has episodes both in scenes of training and in unseen ones."]
    return [
        "Nothing was trained again. PSNR depends on the scene as well as on the views, so methods compare within a "
        "column, not with 0.",
        table(head, rows, words=1),
    ]


def _over_scenes(values: Mapping[Key, float]) -> dict[Key, float]:
    """Means over scenes, by seed and start."""
    found: dict[Key, list[float]] = {}
    for (_, seed, start), value in values.items():
        found.setdefault(("", seed, start), []).append(value)
    return {key: float(np.mean(several)) for key, several in found.items()}


def _heading(name: str) -> str:
    """Of a column of differences: those of percentages are in points."""
    figure = FIGURES[name]
    return f"{figure.title} [points]" if figure.unit == "%" else figure.heading


def _difference(found: Summary | None, name: str) -> str:
    return found.text(FIGURES[name], sign=True) if found else NOTHING


def _mean(views: Mapping[Key, float]) -> str:
    found = statistics.summary(views)
    return found.text(VIEWS) if found else NOTHING
