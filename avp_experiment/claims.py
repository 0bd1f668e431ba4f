"""The experiment's questions, each answered by figures of the results; which sentence is said, the figures decide."""

from collections.abc import Mapping, Sequence

import numpy as np

from avp_experiment.statistics import (
    POINT_NAMES,
    Summary,
    at_views,
    correlations,
    paired,
    points_of,
    saved_share,
    summary,
    views_to_reach,
)
from avp_experiment.stored import TRAIN, UNSEEN, Key, Results
from avp_experiment.tables import aligned, figure

PAIRS = (("surface", "proposed"), ("surface_rooms", "proposed_rooms"))
"""Compared: the same training, another reward."""
_WHERE = {TRAIN: "in the scenes of training", UNSEEN: "in unseen scenes"}
Curves = dict[Key, dict[int, float]]
"""PSNR in dB by number of views, ascending, by episode."""


def surface_against_proposed(results: Results) -> list[str]:
    """Paragraphs for each pair of methods and each kind of scenes."""
    lines = []
    for left, right in PAIRS:
        if not {left, right} <= set(results.methods):
            if (left, right) == PAIRS[0]:
                lines.append(f"Cannot be said: `{left}` and `{right}` are not both in this experiment.")
            continue
        for role, where in _WHERE.items():
            if results.scenes(role):
                lines += _compared(results, left, right, role, where)
    return lines


def _compared(results: Results, left: str, right: str, role: str, where: str) -> list[str]:
    first, second = (_curves(results, method, role) for method in (left, right))
    common = [key for key in first if key in second]
    if not common:
        return [f"{where.capitalize()}: `{left}` and `{right}` have no reconstructed episodes in common."]
    first, second = {key: first[key] for key in common}, {key: second[key] for key in common}
    rows = [["views", f"{left} − {right} [dB]", "episodes"]]
    for views in sorted({views for curve in (*first.values(), *second.values()) for views in curve}):
        both = [{key: curve[views] for key, curve in curves.items() if views in curve} for curves in (first, second)]
        # A number of views that only some episodes reach compares others than the rest of the table does.
        if all(len(values) == len(common) for values in both):
            rows.append(_row(str(views), *both))
    shorter = {key: min(max(first[key]), max(second[key])) for key in common}
    both = [_at(curves, shorter) for curves in (first, second)]
    rows.append(_row("the shorter episode's", *both))
    difference = paired(*both)
    head = f"{where.capitalize()}, `{left}` against `{right}`"
    sentence = f"{head}: {_equal_views(difference)}" if difference else f"{head}: no common range of views."
    return [sentence, aligned(rows), _equal_psnr(first, second, left, right), _equal_psnr(second, first, right, left)]


def _curves(results: Results, method: str, role: str) -> Curves:
    """Of the episodes that were also reconstructed as a whole: only those say what all their views gave."""
    found = {
        key: {views: one.scores["psnr"] for views, one in curve.items() if "psnr" in one.scores}
        for key, curve in results.reconstruction_curves(method, role).items()
        if any(one.whole and "psnr" in one.scores for one in curve.values())
    }
    return {key: curve for key, curve in found.items() if curve}


def _at(curves: Curves, views: Mapping[Key, int]) -> dict[Key, float]:
    found = {key: at_views(curve, views[key]) for key, curve in curves.items()}
    return {key: psnr for key, psnr in found.items() if psnr is not None}


def _row(views: str, left: Mapping[Key, float], right: Mapping[Key, float]) -> list[str]:
    found = paired(left, right)
    common = sum(key in right for key in left)
    return [views, found.text(digits=2, sign=True) if found else "–", str(common)]


def _equal_views(difference: Summary) -> str:
    by = difference.text(digits=2, sign=True, unit="dB")
    shown = f"at the smaller of their numbers of views its PSNR differs by {by}"
    if np.isnan(difference.half_width):
        return f"{shown}, {'higher' if difference.mean > 0 else 'not higher'} (one seed: no interval)."
    if difference.low > 0:
        return f"{shown}: higher, the whole interval too."
    if difference.high < 0:
        return f"{shown}: lower, the whole interval too."
    return f"{shown}: {'higher' if difference.mean > 0 else 'not higher'} on average, but the interval holds 0."


def _equal_psnr(left: Curves, right: Curves, name: str, other: str) -> str:
    """How many views the left method needs for the final PSNR of the right one."""
    targets = {key: (max(curve), curve[max(curve)]) for key, curve in right.items()}
    needed = {key: views_to_reach(curve, targets[key][1]) for key, curve in left.items()}
    reached = {key: views for key, views in needed.items() if views is not None}
    head = f"The final PSNR of `{other}` is reached by `{name}`"
    if not reached:
        return f"{head} in none of {len(needed)} episodes: never reached."
    least = sum(views == min(left[key]) for key, views in reached.items())
    spent, have = summary(reached), summary({key: float(targets[key][0]) for key in reached})
    fewer = paired({key: float(targets[key][0]) for key in reached}, reached)
    assert spent is not None
    assert have is not None
    assert fewer is not None
    text = (
        f"{head} after {spent.text(digits=1)} views where `{other}` took {have.text(digits=1)}: "
        f"{fewer.text(digits=1, sign=True)} views saved"
    )
    if len(reached) < len(needed):
        text = text.replace(head, f"{head} in {len(reached)} of {len(needed)} episodes (never reached in the others),")
    if least:
        text += f" (in {least} already at the fewest views measured, so that it may need fewer still)"
    return text + "."


FEWER_VIEWS, WORSE_DB, GOOD_RHO = 0.25, 0.3, 0.8
"""What the paper's method is held to: at least so many fewer views at no more than so much lower PSNR; and what a
predictor of PSNR is held to."""
ROLE_WORDS = {TRAIN: "in the scenes of training", UNSEEN: "in unseen scenes"}
_NOTHING = "–"


def claims(results: Results) -> str:
    """All answers as Markdown."""
    parts = [
        "# Claims\n\nEvery figure below is computed from `results.json`: mean ± 95 % confidence interval over seeds "
        "(Student's t); differences are paired by scene, seed and start.",
        _section("Heuristic against learned policies", _heuristic(results)),
        _section("`proposed` against `coverage`: fewer views at equal PSNR", _fewer_views(results)),
        _section("`surface` against `proposed`", surface_against_proposed(results)),
        _section("Visibility as a predictor of PSNR", _prediction(results)),
        _section("Unseen scenes against those of training", _transfer(results)),
        _section("Cells that failed", failures(results)),
    ]
    return "\n\n".join(parts) + "\n"


def failures(results: Results) -> list[str]:
    """A line for each failed cell."""
    if not results.failed:
        return ["None."]
    return ["\n".join(f"- `{one.cell}`: {one.reason} (`{one.log}`)" for one in results.failed)]


def _section(title: str, paragraphs: Sequence[str]) -> str:
    return "\n\n".join([f"## {title}", *paragraphs])


def _heuristic(results: Results) -> list[str]:
    lines = []
    for role, where in ROLE_WORDS.items():
        base = {name: figure(results, "heuristic", role, name) for name in ("coverage", "psnr")}
        others = [method for method in results.methods if _is_learned(results, method)]
        found = {
            method: tuple(paired(figure(results, method, role, name), base[name]) for name in ("coverage", "psnr"))
            for method in others
        }
        found = {method: both for method, both in found.items() if any(both)}
        if not found:
            lines.append(f"{where.capitalize()}: nothing to compare (no episodes of `heuristic` and a learned policy).")
            continue
        rows = [["learned − heuristic", "coverage [points]", "PSNR [dB]"]]
        rows += [[method, _cell(coverage, 1, 100), _cell(psnr, 2)] for method, (coverage, psnr) in found.items()]
        sentence = f"{where.capitalize()} the heuristic is {_below(list(found.values()))}."
        lines += [sentence, aligned(rows)]
    return lines


def _is_learned(results: Results, method: str) -> bool:
    """By the trainings that are there; a training that failed has no episodes to compare."""
    return any(one.method == method for one in results.trainings)


def _below(found: Sequence[tuple[Summary | None, ...]]) -> str:
    """How far below all learned policies the heuristic is."""
    differences = [one for both in found for one in both if one is not None]
    missing = "" if all(one is not None for both in found for one in both) else ", as far as there are figures"
    both = "coverage and PSNR" if any(psnr for _, psnr in found) else "coverage"
    if any(one.mean <= 0 for one in differences):
        return f"**not** below every learned policy in {both}{missing}"
    if all(one.low > 0 for one in differences):
        return f"clearly below every learned policy in {both}: no interval reaches 0{missing}"
    return f"below every learned policy in {both} on average, but not every difference has an interval above 0{missing}"


def _fewer_views(results: Results) -> list[str]:
    lines = []
    for role, where in ROLE_WORDS.items():
        views = [figure(results, method, role, "views") for method in ("proposed", "coverage")]
        psnr = [figure(results, method, role, "psnr") for method in ("proposed", "coverage")]
        saved, difference = saved_share(*views), paired(*psnr)
        if saved is None or difference is None:
            missing = "episodes" if saved is None else "reconstructions"
            lines.append(
                f"{where.capitalize()}: cannot be said, `proposed` and `coverage` have no {missing} in common."
            )
            continue
        holds = saved.mean >= FEWER_VIEWS and difference.mean >= -WORSE_DB
        sure = saved.low >= FEWER_VIEWS and difference.low >= -WORSE_DB
        lines.append(
            f"{where.capitalize()} `proposed` takes {_scaled(saved, 100).text(digits=1)} % fewer views than `coverage` "
            f"({_mean(views[0])} against {_mean(views[1])}); its PSNR differs by "
            f"{difference.text(digits=2, sign=True, unit='dB')}. At least {100 * FEWER_VIEWS:.0f} % fewer views at a "
            f"PSNR no more than {WORSE_DB} dB lower: {_holds(holds, sure, one_seed=bool(np.isnan(saved.half_width)))}"
        )
    return lines


def _holds(holds: bool, sure: bool, *, one_seed: bool) -> str:
    if not holds:
        return "**does not hold** (by the means)."
    if one_seed:
        return "**holds** (one seed: no interval)."
    return (
        "**holds**, also at the unfavourable ends of both intervals."
        if sure
        else "**holds** by the means, not over the whole intervals."
    )


def _prediction(results: Results) -> list[str]:
    points = points_of(results)
    found = {name: {entry.where: entry.found for entry in correlations(points, name)} for name in POINT_NAMES}
    overall = found["visibility"]["all"]
    if overall is None:
        return ["Cannot be said: fewer than three reconstructions with a visibility and a PSNR, or all alike."]
    reached = f"at least {GOOD_RHO}" if overall.rho >= GOOD_RHO else f"below {GOOD_RHO}"
    rows = [["Spearman's ρ with PSNR", *POINT_NAMES, "reconstructions", "rollouts"]]
    for where, one in found["visibility"].items():
        other = found["coverage"][where]
        rows.append(
            [
                where,
                one.text() if one else _NOTHING,
                other.text() if other else _NOTHING,
                str(one.points) if one else _NOTHING,
                str(one.rollouts) if one else _NOTHING,
            ]
        )
    whole = found["visibility"]["whole episodes"]
    also = f"; over whole episodes only {whole.text()}" if whole else ""
    return [
        f"Over all reconstructions visibility and PSNR have {overall.text()}, {reached}{also}. In brackets: 95 % "
        "interval, bootstrap over rollouts.",
        aligned(rows),
    ]


def _transfer(results: Results) -> list[str]:
    if not results.scenes(UNSEEN):
        return ["No unseen scene in this experiment."]
    rows = [["unseen − train", "views", "coverage [points]", "PSNR [dB]"]]
    for method in results.methods:
        cells = [
            _cell(_between_roles(results, method, name), digits, scale)
            for name, digits, scale in (("views", 1, 1.0), ("coverage", 1, 100.0), ("psnr", 2, 1.0))
        ]
        if set(cells) != {_NOTHING}:
            rows.append([method, *cells])
    if len(rows) == 1:
        return ["Nothing to compare: no method has episodes both in scenes of training and in unseen ones."]
    return [
        "Nothing was trained again. PSNR depends on the scene as well as on the views, so methods compare within a "
        "column, not with 0.",
        aligned(rows),
    ]


def _between_roles(results: Results, method: str, name: str) -> Summary | None:
    """Unseen minus train; the scenes differ, so only the seed pairs them."""
    by_role = [_over_scenes(figure(results, method, role, name)) for role in (UNSEEN, TRAIN)]
    return paired(*by_role)


def _over_scenes(values: Mapping[Key, float]) -> dict[Key, float]:
    """Means over scenes, by seed and start."""
    found: dict[Key, list[float]] = {}
    for (_, seed, start), value in values.items():
        found.setdefault(("", seed, start), []).append(value)
    return {key: float(np.mean(several)) for key, several in found.items()}


def _cell(found: Summary | None, digits: int, scale: float = 1.0) -> str:
    return found.text(digits=digits, scale=scale, sign=True) if found else _NOTHING


def _scaled(found: Summary, scale: float) -> Summary:
    return Summary(scale * found.mean, scale * found.half_width, found.seeds)


def _mean(values: Mapping[Key, float]) -> str:
    found = summary(values)
    return found.text(digits=1) if found else _NOTHING
