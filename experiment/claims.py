"""The experiment's questions, each answered by figures of the results; which sentence is said, the figures decide."""

from collections.abc import Mapping, Sequence

import numpy as np

from experiment.prediction import POINT_NAMES, correlations, points_of
from experiment.statistics import Summary, paired, saved_share, summary
from experiment.stored import TRAIN, UNSEEN, Key, Results
from experiment.surface_claims import surface_against_proposed
from experiment.tables import aligned, figure

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
