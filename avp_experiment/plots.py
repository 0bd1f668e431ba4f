"""The figures that are curves and points: training, PSNR by views, visibility; and how all figures look."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from avp_experiment.configuration import ROOMS, TRAIN, TUNED, UNSEEN, without_label
from avp_experiment.results import Key, Results, Training
from avp_experiment.statistics import PREDICTORS, Point, correlations, points_of, summary
from avp_habitat.metrics import FIGURES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CPV, REWARD = "avp/cpv", "rollout/ep_rew_mean"
WIDTH_IN = 9.6
_MILLION, _DPI = 1e6, 100
_ROLES = {TRAIN: "scene of training", UNSEEN: "unseen scene"}


class Missing(Exception):
    """A figure that cannot be made; the text says why."""


@dataclass(frozen=True)
class Drawn:
    """A figure, not written yet, with what is to be said below it."""

    picture: "Figure"
    caption: str

    def save(self, path: Path) -> None:
        """Write a PNG of 256 colours, which keeps photographs small."""
        drawn = io.BytesIO()
        self.picture.savefig(drawn, dpi=_DPI, format="png")
        Image.open(drawn).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


# Colours of Okabe and Ito (https://jfly.uni-koeln.de/color/), which people with colour blindness can tell apart, with a
# dark purple and greys beside them; markers differ too.
_STYLES = {
    "heuristic": ("#000000", "X"),
    "random": ("#8C8C8C", "v"),
    "spin": ("#BBBBBB", "<"),
    "survey": ("#5F5F5F", ">"),
    "frontier": ("#E69F00", "s"),
    "greedy": ("#CC79A7", "D"),
    "nbv": ("#999933", "X"),
    "oracle": ("#009E73", "P"),
    "coverage": ("#56B4E9", "^"),
    "coverage_redundancy": ("#0072B2", "p"),
    "proposed": ("#D55E00", "o"),
    "surface": ("#661F77", "h"),
    "multiview": ("#117733", "H"),
    "survey-multiview": ("#332288", "d"),
    "pretrained": ("#C1121F", "*"),
}
_OTHERS = [(colour, marker) for marker in "8dp<" for colour in ("#A08060", "#44AA99", "#882255", "#6699CC")]
"""Of methods of others, in the order in which they are first drawn."""


def style_of(method: str) -> tuple[str, str, str]:
    """Colour, marker and line of a method; in rooms, tuned, or another's of merged results: those of it, dashed."""
    plain = without_label(method).removesuffix(ROOMS).removesuffix(TUNED)
    if plain not in _STYLES:
        _STYLES[plain] = _OTHERS[len(_STYLES) % len(_OTHERS)]
    return *_STYLES[plain], "-" if plain == method else "--"


def new_figure(height_in: float) -> "Figure":
    """An empty picture of the common width."""
    from matplotlib.figure import Figure

    return Figure(figsize=(WIDTH_IN, height_in), layout="constrained")


def span(counts: Sequence[int]) -> str:
    """As 3, or as 2 to 3."""
    return " to ".join(map(str, sorted({min(counts), max(counts)})))


def cpv_while_training(results: Results) -> Drawn:
    """Figure 3: coverage per view while training."""
    trained = _trained(results, CPV)
    picture = new_figure(4.4)
    axes = picture.subplots()
    for method, trainings in trained.items():
        _training_curve(axes, method, trainings, CPV)
    axes.set(xlabel="environment steps while training [millions]", ylabel="CpV [% coverage per view]")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", ncols=2, fontsize=9)
    return Drawn(picture, f"Coverage per view of the episodes finished while training. {_bands(trained)}")


def reward_while_training(results: Results) -> Drawn:
    """Figure 4: mean reward of an episode while training, each reward on its own scale."""
    trained = _trained(results, REWARD)
    columns = min(3, len(trained))
    rows = -(-len(trained) // columns)
    picture = new_figure(0.4 + 2.4 * rows)
    for place, (method, trainings) in enumerate(trained.items()):
        axes = picture.add_subplot(rows, columns, place + 1)
        _training_curve(axes, method, trainings, REWARD)
        axes.set_title(method, fontsize=10)
        axes.grid(alpha=0.3)
    picture.supxlabel("environment steps while training [millions]", fontsize=10)
    picture.supylabel("mean reward of an episode", fontsize=10)
    return Drawn(
        picture,
        "Mean reward of the episodes finished while training. Rewards differ in what they count, so each panel has its "
        f"own scale, and heights cannot be compared between panels. {_bands(trained)}",
    )


def psnr_by_views(results: Results) -> Drawn:
    """PSNR of reconstructions from each episode's first k frames."""
    scored = {one.role for one in results.reconstructions if "psnr" in one.scores}
    roles = [role for role in _ROLES if role in scored]
    if not roles:
        raise Missing("no reconstruction has a PSNR")
    picture = new_figure(4.9)
    panels = picture.subplots(1, len(roles), squeeze=False, sharey=False)[0]
    for axes, role in zip(panels, roles, strict=True):
        for method in results.methods:
            _psnr_curve(axes, method, _psnr_points(results, method, role))
        used = "views (frames used)" if results.one_budget else "views (frames used) [% of the budget]"
        axes.set(xlabel=used, ylabel="PSNR on held-out views [dB]")
        axes.set_title(f"{_ROLES[role]}: {', '.join(results.scenes(role))}", fontsize=10)
        axes.grid(alpha=0.3)
    legend(picture, panels)
    return Drawn(
        picture,
        "PSNR of reconstructions from the first k frames of an episode; the last point of a line is the whole episode, "
        f"at its mean number of views. Means over {results.seeds}, of the episodes that were also "
        "reconstructed in part; bars: 95 % confidence interval over seeds (Student's t). A "
        "point is left out where some of these episodes ended before.",
    )


def predictors_and_psnr(results: Results) -> Drawn:
    """What may predict PSNR against the PSNR of all reconstructions."""
    points = points_of(results)
    if not points:
        raise Missing("no reconstruction has both a visibility and a PSNR")
    known = [name for name in PREDICTORS if name in points[0].shares]
    rows = -(-len(known) // 2)
    picture = new_figure(0.9 + 4.5 * rows)
    panels = picture.subplots(rows, 2, sharey=True, squeeze=False).ravel()
    for axes in panels[len(known) :]:
        axes.set_axis_off()
    for axes, name in zip(panels, known, strict=False):
        for method in results.methods:
            _scatter(axes, [point for point in points if point.method == method], name)
        axes.set_xlabel(FIGURES[name].heading)
        axes.grid(alpha=0.3)
        found = correlations(points, name)
        lines = [f"{where}: {found[where] or 'too few points'}" for where in ("all", "whole episodes")]
        axes.set_title("\n".join([f"{FIGURES[name].title} and PSNR", *lines]), fontsize=10)
    for axes in panels[::2]:
        axes.set_ylabel("PSNR on held-out views [dB]")
    legend(picture, panels[:1])
    whole = sum(point.whole for point in points)
    meanings = "; ".join(f"{FIGURES[name].title}: {FIGURES[name].meaning}" for name in known)
    return Drawn(
        picture,
        f"All {len(points)} reconstructions, of {results.seeds}: large points are the {whole} of whole "
        f"episodes, small pale ones the {len(points) - whole} of first frames. {meanings}. ρ is Spearman's, with a "
        "95 % interval (bootstrap over rollouts).",
    )


def _trained(results: Results, metric: str) -> dict[str, list[Training]]:
    """By method in the tables' order: the trainings that have a curve."""
    having = [one for one in results.training if len(one.curves.get(metric, [])) > 1]
    if not having:
        raise Missing(f"no training has a curve of {metric}")
    found = {method: [one for one in having if one.method == method] for method in results.methods}
    return {method: trainings for method, trainings in found.items() if trainings}


def _bands(trained: dict[str, list[Training]]) -> str:
    seeds = span([len(trainings) for trainings in trained.values()])
    return f"Lines: mean over {seeds} seeds; bands: from the lowest seed to the highest."


def _training_curve(axes: "Axes", method: str, trainings: Sequence[Training], metric: str) -> None:
    """Mean over seeds at common steps, with a band from the lowest to the highest."""
    curves = [one.curves[metric] for one in trainings]
    steps = np.linspace(max(curve[0, 0] for curve in curves), min(curve[-1, 0] for curve in curves), 200)
    values = np.array([np.interp(steps, curve[:, 0], curve[:, 1]) for curve in curves])
    colour, _, line = style_of(method)
    axes.plot(steps / _MILLION, values.mean(axis=0), line, color=colour, label=method, linewidth=1.8)
    if len(values) > 1:
        low, high = values.min(axis=0), values.max(axis=0)
        axes.fill_between(steps / _MILLION, low, high, color=colour, alpha=0.18, linewidth=0)


def _psnr_points(results: Results, method: str, role: str) -> list[tuple[float, dict[Key, float]]]:
    """Place on the axis (`results.place`), and PSNR by episode: of first frames that all episodes have, and of all."""
    episodes = results.reconstruction_curves(method, role)
    scored = [(key, one) for key, curve in episodes.items() for one in curve.values() if "psnr" in one.scores]
    points = []
    for place in sorted({results.place(key, one.frames) for key, one in scored if not one.whole}):
        first = {
            key: one.scores["psnr"] for key, one in scored if not one.whole and results.place(key, one.frames) == place
        }
        if len(first) == len(episodes):
            points.append((place, first))
    if whole := {key: one for key, one in scored if one.whole}:
        place = float(np.mean([results.place(key, one.frames) for key, one in whole.items()]))
        points.append((place, {key: one.scores["psnr"] for key, one in whole.items()}))
    return points


def _psnr_curve(axes: "Axes", method: str, points: Sequence[tuple[float, dict[Key, float]]]) -> None:
    found = {views: over_seeds for views, values in points if (over_seeds := summary(values))}
    if not found:
        return
    halves = np.array([one.half_width for one in found.values()])
    colour, marker, line = style_of(method)
    look: dict[str, Any] = {"color": colour, "linewidth": 1.6, "elinewidth": 0.8, "markersize": 5.5, "label": method}
    look["markerfacecolor"] = colour if line == "-" else "white"
    spread = None if np.isnan(halves).all() else np.nan_to_num(halves)
    means = [one.mean for one in found.values()]
    for bar in axes.errorbar(list(found), means, yerr=spread, fmt=marker + line, **look)[2]:
        bar.set_alpha(0.45)


def _scatter(axes: "Axes", points: Sequence[Point], name: str) -> None:
    for whole in (False, True):
        chosen = [point for point in points if point.whole is whole]
        if not chosen:
            continue
        colour, marker, line = style_of(chosen[0].method)
        look: dict[str, Any] = {"marker": marker, "edgecolors": colour, "facecolors": colour if line == "-" else "none"}
        look |= {"s": 46, "alpha": 0.9} if whole else {"s": 16, "alpha": 0.4}
        shares = [FIGURES[name].scale * point.shares[name] for point in chosen]
        label = chosen[0].method if whole or len(chosen) == len(points) else None
        axes.scatter(shares, [point.psnr for point in chosen], label=label, linewidths=1.1, **look)


def legend(picture: "Figure", panels: Any) -> None:
    """One for all panels, below them."""
    handles = {label: one for axes in panels for one, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    picture.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6, fontsize=8)
