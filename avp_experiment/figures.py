"""The figures that are curves and points: training, PSNR by views, visibility."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from avp_experiment.look import look_of, new_figure
from avp_experiment.statistics import POINT_NAMES, Point, correlations, per_seed, points_of
from avp_experiment.stored import Key, Results
from avp_habitat.metrics import mean_and_half_width

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CPV, REWARD = "avp/cpv", "rollout/ep_rew_mean"
_GRID = 200
_MILLION = 1e6
_ROLES = {"train": "scene of training", "unseen": "unseen scene"}


class Missing(Exception):
    """A figure that cannot be made; the text says why."""


@dataclass(frozen=True)
class Made:
    """A figure with what is to be said below it."""

    picture: "Figure"
    """Not written yet."""
    caption: str
    """What is plotted, of how many seeds and starts."""


Maker = Callable[[Results], Made]


def cpv_while_training(results: Results) -> Made:
    """Figure 3: coverage per view while training."""
    methods = _trained(results, CPV)
    picture = new_figure(4.4)
    axes = picture.subplots()
    for method in methods:
        _training_curve(axes, results, method, CPV)
    axes.set(xlabel="environment steps while training [millions]", ylabel="CpV [% coverage per view]")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", ncols=2, fontsize=9)
    return Made(
        picture, f"Coverage per view of the episodes finished while training. {_training_words(results, methods)}"
    )


def reward_while_training(results: Results) -> Made:
    """Figure 4: mean reward of an episode while training, each reward on its own scale."""
    methods = _trained(results, REWARD)
    columns = min(3, len(methods))
    rows = -(-len(methods) // columns)
    picture = new_figure(0.4 + 2.4 * rows)
    panels = np.atleast_1d(picture.subplots(rows, columns, squeeze=False)).ravel()
    for axes, method in zip(panels, methods, strict=False):
        _training_curve(axes, results, method, REWARD)
        axes.set_title(method, fontsize=10)
        axes.grid(alpha=0.3)
    for axes in panels[len(methods) :]:
        axes.set_axis_off()
    picture.supxlabel("environment steps while training [millions]", fontsize=10)
    picture.supylabel("mean reward of an episode", fontsize=10)
    caption = (
        "Mean reward of the episodes finished while training. Rewards differ in what they count, so each panel has its "
        "own scale, and heights cannot be compared between panels."
    )
    return Made(picture, f"{caption} {_training_words(results, methods)}")


def psnr_by_views(results: Results) -> Made:
    """PSNR of reconstructions from each episode's first k frames."""
    roles = [
        role for role in _ROLES if any(one.role == role and "psnr" in one.scores for one in results.reconstructions)
    ]
    if not roles:
        raise Missing("no reconstruction has a PSNR")
    picture = new_figure(4.9)
    panels = picture.subplots(1, len(roles), squeeze=False, sharey=False)[0]
    for axes, role in zip(panels, roles, strict=True):
        for method in results.methods:
            _psnr_curve(axes, results, method, role)
        axes.set(xlabel="views (frames used)", ylabel="PSNR on held-out views [dB]")
        axes.set_title(f"{_ROLES[role]}: {', '.join(results.scenes(role))}", fontsize=10)
        axes.grid(alpha=0.3)
    handles = {
        label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    picture.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6, fontsize=8)
    caption = (
        "PSNR of reconstructions from the first k frames of an episode; the last point of a line is the whole episode, "
        f"at its mean number of views. Means over {_count(results, 'seeds')}, of the episodes that were also "
        "reconstructed in part; bars: 95 % confidence interval over seeds (Student's t). A "
        "point is left out where some of these episodes ended before."
    )
    return Made(picture, caption)


def visibility_and_psnr(results: Results) -> Made:
    """Visibility against PSNR of all reconstructions, beside coverage against PSNR."""
    points = points_of(results)
    if not points:
        raise Missing("no reconstruction has both a visibility and a PSNR")
    picture = new_figure(5.4)
    panels = picture.subplots(1, 2, sharey=True)
    for axes, name in zip(panels, POINT_NAMES, strict=True):
        for method in results.methods:
            _scatter(axes, [point for point in points if point.method == method], name)
        axes.set_xlabel(f"{name} [%]")
        axes.grid(alpha=0.3)
        axes.set_title(_correlation_title(points, name), fontsize=10)
    panels[0].set_ylabel("PSNR on held-out views [dB]")
    handles, labels = panels[0].get_legend_handles_labels()
    picture.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=8)
    whole = sum(point.whole for point in points)
    caption = (
        f"All {len(points)} reconstructions, of {_count(results, 'seeds')}: large points are the {whole} of whole "
        f"episodes, small pale ones the {len(points) - whole} of first frames. Left: share of the held-out pixels that "
        "the frames have seen; right: share of the floor cells observed. ρ is Spearman's, with a 95 % interval "
        "(bootstrap over rollouts)."
    )
    return Made(picture, caption)


def _trained(results: Results, metric: str) -> list[str]:
    found = {training.method for training in results.trainings if len(training.curves.get(metric, [])) > 1}
    if not found:
        raise Missing(f"no training has a curve of {metric}")
    return [method for method in results.methods if method in found]


def _training_words(results: Results, methods: Sequence[str]) -> str:
    counts = {len({one.seed for one in results.trainings if one.method == method}) for method in methods}
    seeds = f"{min(counts)}" if len(counts) == 1 else f"{min(counts)} to {max(counts)}"
    return f"Lines: mean over {seeds} seeds; bands: from the lowest seed to the highest."


def _training_curve(axes: "Axes", results: Results, method: str, metric: str) -> None:
    """Mean over seeds at common steps, with a band from the lowest to the highest."""
    curves = [
        np.array(one.curves[metric])
        for one in results.trainings
        if one.method == method and len(one.curves.get(metric, [])) > 1
    ]
    first, last = max(curve[0, 0] for curve in curves), min(curve[-1, 0] for curve in curves)
    steps = np.linspace(first, last, _GRID)
    values = np.array([np.interp(steps, curve[:, 0], curve[:, 1]) for curve in curves])
    look = look_of(method)
    axes.plot(steps / _MILLION, values.mean(axis=0), look.line, color=look.colour, label=method, linewidth=1.8)
    if len(values) > 1:
        axes.fill_between(
            steps / _MILLION, values.min(axis=0), values.max(axis=0), color=look.colour, alpha=0.18, linewidth=0
        )


def _psnr_curve(axes: "Axes", results: Results, method: str, role: str) -> None:
    points = _psnr_points(results, method, role)
    if not points:
        return
    found = [mean_and_half_width(list(per_seed(values).values())) for _, values in points]
    look = look_of(method)
    style: dict[str, Any] = {"markerfacecolor": look.colour if look.filled else "white", "markersize": 5.5}
    bars = axes.errorbar(
        [views for views, _ in points],
        [mean for mean, _ in found],
        yerr=_bars([half for _, half in found]),
        fmt=look.marker + look.line,
        color=look.colour,
        label=method,
        linewidth=1.6,
        elinewidth=0.8,
        **style,
    )
    for bar in bars[2]:
        bar.set_alpha(0.45)


def _psnr_points(results: Results, method: str, role: str) -> list[tuple[float, dict[Key, float]]]:
    """Number of views, and PSNR by episode: of the first frames where all episodes have so many, and of all frames."""
    episodes = results.reconstruction_curves(method, role)
    scored = [(key, one) for key, curve in episodes.items() for one in curve.values() if "psnr" in one.scores]
    first: dict[int, dict[Key, float]] = {}
    for key, one in scored:
        if not one.whole:
            first.setdefault(one.frames, {})[key] = one.scores["psnr"]
    points = [(float(views), first[views]) for views in sorted(first) if len(first[views]) == len(episodes)]
    whole = [(key, one) for key, one in scored if one.whole]
    if whole:
        views = float(np.mean([one.frames for _, one in whole]))
        points.append((views, {key: one.scores["psnr"] for key, one in whole}))
    return points


def _bars(halves: Iterable[Any]) -> NDArray[np.float64] | None:
    """Half widths of bars; none where nothing is known of the spread."""
    widths = np.array(list(halves), dtype=np.float64)
    return None if np.isnan(widths).all() else np.nan_to_num(widths)


def _scatter(axes: "Axes", points: Sequence[Point], name: str) -> None:
    for whole in (False, True):
        chosen = [point for point in points if point.whole is whole]
        if not chosen:
            continue
        look = look_of(chosen[0].method)
        axes.scatter(
            [100 * point.share(name) for point in chosen],
            [point.psnr for point in chosen],
            s=46 if whole else 16,
            marker=look.marker,
            facecolors=look.colour if look.filled else "none",
            edgecolors=look.colour,
            alpha=0.9 if whole else 0.4,
            linewidths=1.1,
            label=chosen[0].method if whole or len(chosen) == len(points) else None,
        )


def _correlation_title(points: Sequence[Point], name: str) -> str:
    found = {entry.where: entry.found for entry in correlations(points, name)}
    lines = [
        f"{where}: {one.text() if one else 'too few points'}"
        for where, one in found.items()
        if where in ("all", "whole episodes")
    ]
    return "\n".join([f"{name} and PSNR", *lines])


def _count(results: Results, name: str) -> str:
    count = results.configuration.get(name, "?")
    return f"{count} {name if count != 1 else name.removesuffix('s')}"
