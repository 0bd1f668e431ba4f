"""Means over seeds, differences between methods, and how well what the frames have seen predicts the reconstruction."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from avp_experiment.results import Key, Results
from avp_habitat.metrics import CONFIDENCE, Figure, mean_and_half_width

NOTHING = "–"
"""What tables show where there is no figure."""
PREDICTORS = ("visibility", "visibility_parallax", "completion_ratio", "coverage")
"""What may predict PSNR."""
_NEARLY_ALL = 0.9
"""A predictor that fewer of the reconstructions have is left out, not the reconstructions."""
RESAMPLES = 2000
_BOOTSTRAP_SEED = 0


@dataclass(frozen=True)
class Summary:
    """A mean over seeds with its 95 % confidence interval."""

    mean: float
    """Over seeds; each counts with its mean over scenes and starts."""
    half_width: float
    """Of the interval (Student's t over seeds); nan for one seed."""
    seeds: int

    @property
    def interval(self) -> tuple[float, float]:
        """Its ends; nan for one seed."""
        return self.mean - self.half_width, self.mean + self.half_width

    def text(self, figure: Figure, *, sign: bool = False) -> str:
        """Mean ± half the interval as a figure is shown, without the unit."""
        shown = figure.text(self.mean, self.half_width)
        return f"+{shown}" if sign and not shown.startswith("-") else shown


@dataclass(frozen=True)
class Correlation:
    """Spearman's rank correlation ρ with a bootstrap interval."""

    rho: float
    low: float
    """Lower end of the 95 % interval; nan where there is one rollout only."""
    high: float
    points: int
    rollouts: int
    """What the bootstrap draws."""

    def __str__(self) -> str:
        """As ρ = 0.91 [0.85, 0.95]."""
        interval = "" if np.isnan(self.low) else f" [{self.low:.2f}, {self.high:.2f}]"
        return f"ρ = {self.rho:.2f}{interval}"


def per_seed(values: Mapping[Key, float]) -> dict[int, float]:
    """Means over scenes, of the means over starts, by seed, in the seeds' order."""
    found: dict[int, dict[str, list[float]]] = {}
    for (scene, seed, _), value in sorted(values.items()):
        found.setdefault(seed, {}).setdefault(scene, []).append(value)
    return {seed: float(np.mean([np.mean(of) for of in scenes.values()])) for seed, scenes in sorted(found.items())}


def summary(values: Mapping[Key, float]) -> Summary | None:
    """Mean over seeds of a figure by episode; None without any."""
    seeds = list(per_seed(values).values())
    if not seeds:
        return None
    mean, half = mean_and_half_width(seeds)
    return Summary(float(mean), float(half), len(seeds))


def paired(left: Mapping[Key, float], right: Mapping[Key, float]) -> Summary | None:
    """Left minus right, over the episodes that both have; None where they have none in common."""
    return summary({key: left[key] - right[key] for key in left if key in right})


def saved_share(less: Mapping[Key, float], more: Mapping[Key, float]) -> Summary | None:
    """By how much `less` lies below `more`, as a share of `more`: of the means of each seed over common episodes."""
    common = [key for key in less if key in more]
    first, second = per_seed({key: less[key] for key in common}), per_seed({key: more[key] for key in common})
    return summary({("", seed, 0): 1 - first[seed] / second[seed] for seed in first})


def at_views(curve: Mapping[int, float], views: float) -> float | None:
    """A figure at a number of views, of those measured (ascending) or between; None outside of them."""
    measured = list(curve)
    if not measured or not measured[0] <= views <= measured[-1]:
        return None
    return float(np.interp(views, measured, list(curve.values())))


def views_to_reach(curve: Mapping[int, float], target: float) -> float | None:
    """The least number of views, of those measured or between, at which a figure reaches a target; None for never."""
    measured, values = list(curve), list(curve.values())
    for place, value in enumerate(values):
        if value >= target:
            both = slice(max(place - 1, 0), place + 1)
            return float(np.interp(target, values[both], measured[both]))
    return None


def spearman(x: ArrayLike, y: ArrayLike, rollout: Sequence[object]) -> Correlation | None:
    """Spearman's ρ of `(n,)` and `(n,)`; its interval draws whole rollouts, `(n,)`, whose points are not independent.

    None for fewer than three points, or where one of the two does not vary.
    """
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    names = list(dict.fromkeys(rollout))
    low = high = np.nan
    if len(names) > 1:
        # A rollout that is drawn k times counts k times.
        rng = np.random.default_rng(_BOOTSTRAP_SEED)
        times = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), size=RESAMPLES).astype(np.float64)
        drawn = _rho(x, y, times[:, [names.index(name) for name in rollout]])
        low, high = np.nanquantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Correlation(float(_rho(x, y, np.ones((1, len(x))))[0]), float(low), float(high), len(x), len(names))


def _rho(x: NDArray, y: NDArray, times: NDArray) -> NDArray:
    """`(r,)` ρ of `(n,)` points that count `(r, n)` times; nan where one of the two does not vary."""
    ranks = [_ranks(values, times) for values in (x, y)]
    total = times.sum(axis=1, keepdims=True)
    first, second = (rank - (times * rank).sum(axis=1, keepdims=True) / total for rank in ranks)
    with np.errstate(invalid="ignore", divide="ignore"):
        both, left, right = ((times * product).sum(axis=1) for product in (first * second, first**2, second**2))
        return both / np.sqrt(left * right)


def _ranks(values: NDArray, times: NDArray) -> NDArray:
    """`(r, n)` ranks of `(n,)` values that count `(r, n)` times; equal values share their mean rank."""
    _, place = np.unique(values, return_inverse=True)
    order = np.argsort(place, kind="stable")
    starts = np.flatnonzero(np.diff(place[order], prepend=-1))
    together = np.add.reduceat(times[:, order], starts, axis=1)
    return (np.cumsum(together, axis=1) - together / 2)[:, place]


@dataclass(frozen=True)
class Point:
    """One reconstruction."""

    method: str
    rollout: tuple[str, str, int, int]
    """Method, scene, seed and start."""
    whole: bool
    """Of all frames of its episode."""
    shares: Mapping[str, float]
    """`PREDICTORS` of its frames, as far as they are known, within [0, 1]."""
    psnr: float
    """In dB."""


def points_of(results: Results) -> list[Point]:
    """All reconstructions with a PSNR and those predictors that nearly all of them have, so that these compare."""
    curves = {(one.method, *one.key): one.curves for one in results.rollouts}
    points = []
    for one in results.reconstructions:
        rollout = (one.method, *one.key)
        known = {name: curves.get(rollout, {}).get(name, {}) for name in PREDICTORS}
        shares = {name: curve[one.frames] for name, curve in known.items() if one.frames in curve}
        if shares and "psnr" in one.scores:
            points.append(Point(one.method, rollout, one.whole, shares, one.scores["psnr"]))
    kept = {name for name in PREDICTORS if sum(name in one.shares for one in points) >= _NEARLY_ALL * len(points)}
    return [
        replace(point, shares={name: point.shares[name] for name in PREDICTORS if name in kept})
        for point in points
        if kept and kept <= set(point.shares)
    ]


def correlations(points: Sequence[Point], name: str) -> dict[str, Correlation | None]:
    """Spearman's ρ of a predictor with PSNR: over all, of whole episodes, of first frames, in each scene."""
    groups = {
        "all": list(points),
        "whole episodes": [point for point in points if point.whole],
        "first frames": [point for point in points if not point.whole],
    }
    scenes = list(dict.fromkeys(point.rollout[1] for point in points))
    for scene in scenes if len(scenes) > 1 else []:
        groups[f"all in {scene}"] = [point for point in points if point.rollout[1] == scene]
        groups[f"whole episodes in {scene}"] = [point for point in groups[f"all in {scene}"] if point.whole]
    return {
        where: spearman([p.shares[name] for p in group], [p.psnr for p in group], [p.rollout for p in group])
        for where, group in groups.items()
    }
