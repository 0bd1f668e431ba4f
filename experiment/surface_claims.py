"""What the reward `surface` gains over `proposed`: PSNR at equal views, and views at equal PSNR."""

from collections.abc import Mapping

import numpy as np

from experiment.statistics import Summary, at_views, paired, summary, views_to_reach
from experiment.stored import TRAIN, UNSEEN, Key, Results
from experiment.tables import aligned

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
