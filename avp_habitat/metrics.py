"""Figures of episodes and rollouts, what their names mean, and means with their confidence intervals."""

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from numbers import Real
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from avp_habitat import plugins
from avp_habitat.errors import UsageError

Float = NDArray[np.floating]

ALIKE_DEG = 60.0
"""A frame sees a surface as the held-out view does when its ray is turned by no more than this, degrees."""
ALIKE_DISTANCE = 2.0
"""And when it stands no more than this many times as far away."""
PARALLAX_DEG = 10.0
"""Rays this far apart show how far away a surface is, degrees."""
NEAR_M = 0.05
"""Surfaces that lie this near count as the same, metres."""


@dataclass(frozen=True)
class Figure:
    """How a figure of an episode, a rollout or a reconstruction is called and shown, wherever it is shown."""

    name: str
    """Its key in `info["avp_episode"]` and rollout.json; MLflow has it as `eval/NAME`, SB3's logger as `avp/NAME`."""
    title: str
    """For people, without the unit."""
    unit: str = ""
    """Of the shown number."""
    scale: float = 1.0
    """The shown number by the stored one: 100 for percent."""
    digits: int = 1
    """After the point."""
    better: Literal["higher", "lower"] | None = None
    """Which direction is the better one; None where there is no saying."""
    meaning: str = ""
    """In one line."""

    @property
    def heading(self) -> str:
        """Title with unit, as `coverage [%]`."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def text(self, value: float, half_width: float = math.nan) -> str:
        """A stored value as shown, with ± half an interval where that is known, without the unit."""
        shown = f"{self.scale * value:.{self.digits}f}"
        return shown if math.isnan(half_width) else f"{shown} ± {abs(self.scale) * half_width:.{self.digits}f}"


def _visibility(name: str, title: str, meaning: str) -> Figure:
    return Figure(f"visibility{name}", title, "%", 100, better="higher", meaning=meaning)


_ALIKE = f"that, within {ALIKE_DEG:g} degrees of the held-out ray and at most {ALIKE_DISTANCE:g} times as far away"
_PARALLAX = f"that, along two rays at least {PARALLAX_DEG:g} degrees apart, which fixes the depth"
_SEEN = "share of the held-out views' pixels whose surface a captured picture shows"
_SHARE = "share of the navigable floor that some picture shows"
_NEAREST = "mean distance from each camera to the nearest other one, small where places repeat"
_NEAR = f"that lies within {100 * NEAR_M:g} cm of the shape"
_NEAR_IT = f"that lies within {100 * NEAR_M:g} cm of the scene"
_REPEATED = "like an earlier one in place and direction"
_ALL = (
    Figure("coverage", "coverage", "%", 100, better="higher", meaning=_SHARE),
    Figure("coverage_area", "coverage, mean over views", "%", 100, better="higher"),
    Figure("views", "views", better="lower", meaning="pictures taken, one for each step"),
    Figure("stopped", "stop", "%", 100, meaning="the policy itself ended the episode"),
    Figure("cpv", "CpV", "%/view", 1, 2, "higher", "coverage per view, mean coverage over mean number of views"),
    Figure("annd_m", "ANND", "m", 1, 3, meaning=_NEAREST),
    Figure("ei", "EI", "%/view", 100, 2, "higher", "efficiency index, coverage over the number of pictures"),
    Figure("path_length_m", "path length", "m", 1, 2, meaning="metres walked"),
    Figure("collisions", "collisions", better="lower", meaning="forward moves that were blocked"),
    Figure("redundant_views", "redundant views", better="lower", meaning=_REPEATED),
    Figure("redundant_share", "redundant views", "%", 100, better="lower", meaning=_REPEATED),
    Figure("surface", "surface", "%", 100, better="higher", meaning="how well the scene's surface was seen"),
    _visibility("", "visibility", _SEEN),
    _visibility("_2_frames", "2 frames", "that, by at least two pictures"),
    _visibility("_3_frames", "3 frames", "that, by at least three pictures"),
    _visibility("_alike", "alike", _ALIKE),
    _visibility("_parallax", "parallax", _PARALLAX),
    _visibility("_weighted", "weighted", "that, weighted by how much the best ray is like the held-out one"),
    Figure("completion_ratio", "completion ratio", "%", 100, 1, "higher", f"share of what can be seen {_NEAR}"),
    Figure("completion_m", "completion", "cm", 100, 2, "lower", "mean distance from what can be seen to the shape"),
    Figure("precision", "precision", "%", 100, 1, "higher", f"share of the shape {_NEAR_IT}"),
    Figure("accuracy_m", "accuracy", "cm", 100, 2, "lower", "mean distance from the shape to the scene"),
    Figure("f_score", "F-score", "%", 100, 1, "higher", "harmonic mean of precision and completion ratio"),
    Figure("chamfer_m", "Chamfer-L1", "cm", 100, 2, "lower", "mean of accuracy and completion"),
    Figure("depth_l1_m", "depth L1", "cm", 100, 1, "lower", "mean error of the shape's depth in the held-out views"),
    Figure("psnr", "PSNR", "dB", 1, 2, "higher", "likeness of rendered and true held-out views in dB"),
    Figure("ssim", "SSIM", "", 1, 3, "higher", "likeness of their structure, 1 is equal"),
    Figure("lpips", "LPIPS", "", 1, 3, "lower", "difference as a network sees it, 0 is equal"),
)
FIGURES = {figure.name: figure for figure in _ALL}
"""The suite's own figures by name, in the order in which tables show them."""
GEOMETRY = ("completion_ratio", "completion_m", "precision", "accuracy_m", "f_score", "chamfer_m", "depth_l1_m")
"""The figures of `geometry.scores`, in the tables' order."""
TERMS = {figure.title: figure.meaning for figure in _ALL if figure.meaning} | {
    "held-out views": "pictures of the room that no reconstruction is trained on"
}
"""What the titles mean, in one line each: tables, pages and options say it with these words."""


def explained(*terms: str) -> str:
    """One line that says what some of `TERMS` mean."""
    return "; ".join(f"{term}: {TERMS[term]}" for term in terms)


METRICS_HELP = "further metrics: names that other distributions register, or MODULE:FUNCTION"
"""What a command line says of its option for metrics."""
Of = Literal["episode", "rollout"]
MetricFunction = Callable[[Any], float]
"""A figure of an episode's `Trajectory` or of a `Rollout`, with what `metric` declares about it."""


def metric(figure: Figure, *, of: Of = "episode") -> Callable[[MetricFunction], MetricFunction]:
    """Decorator of a function that computes one more figure, whose name may not be one of `FIGURES`.

    It takes the `Trajectory` of a finished episode, or a `Rollout` with its pictures.
    """
    return plugins.declares(figure=figure, of=of)


def find_metrics(chosen: Sequence[str | MetricFunction]) -> list[Any]:
    """The functions behind the names of metrics.

    Raises:
        UsageError: there is no such metric, it declares no figure, or two figures have one name.
    """
    found = [plugins.find("avp.metrics", name, {}) for name in chosen]
    taken = set(FIGURES)
    for name, function in zip(chosen, found, strict=True):
        said = plugins.name_of(name)
        figure = getattr(function, "figure", None)
        if not (callable(function) and isinstance(figure, Figure)):
            raise UsageError(f"metric {said!r}: expected a function decorated by `metric(Figure(…))`, got {function!r}")
        if figure.name in taken:
            raise UsageError(f"metric {said!r}: there is a figure named {figure.name!r} already; choose another name")
        taken.add(figure.name)
    return found


def measured(chosen: Iterable[str | MetricFunction], of: Of, thing: Any) -> dict[str, float]:
    """What the chosen metrics of an episode or of a rollout give, by the figures' names.

    Raises:
        UsageError: as `find_metrics`, or a metric gives no finite number.
    """
    values = {}
    for function in find_metrics(tuple(chosen)):
        if function.of == of:
            value = function(thing)
            if not isinstance(value, Real) or not math.isfinite(value):
                raise UsageError(f"metric {function.figure.name!r}: expected one finite number, got {value!r}")
            values[function.figure.name] = float(value)
    return values


def figures(chosen: Sequence[str | MetricFunction] = ()) -> dict[str, Figure]:
    """All figures by name: the suite's, those that other distributions register, and those of the chosen metrics.

    A registered metric that cannot be imported is left out: what it measured is then shown by its key.
    """
    found = []
    for name in plugins.names("avp.metrics", ()):
        with suppress(UsageError):
            found += find_metrics((name,))
    return FIGURES | {function.figure.name: function.figure for function in [*found, *find_metrics(tuple(chosen))]}


def figure_of(name: str) -> Figure:
    """How a figure is called and shown; one that nobody registers, by its key."""
    return figures().get(name) or Figure(name, name.replace("_", " "), digits=3)


def coverage(observed: NDArray[np.bool_], navigable: NDArray[np.bool_]) -> float:
    """Share of the navigable cells, at least one, that were observed (C, Eq. 17); both arrays have the same shape."""
    return float(np.sum(observed & navigable) / np.sum(navigable))


def nearest_neighbour_distance(positions: Float) -> float:
    """Mean distance in metres from each of `(n, 3)` camera centres to its nearest other one (ANND, Eq. 18).

    0.0 for fewer than two cameras.
    """
    positions = np.asarray(positions, dtype=np.float64)
    if len(positions) < 2:
        return 0.0
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    return float(distance.min(axis=1).mean())


def efficiency_index(coverage: float, images: int) -> float:
    """Coverage, within [0, 1], per captured image (EI = C / N_images); 0.0 without images."""
    return coverage / images if images else 0.0


def coverage_per_view(coverages: Float, lengths: Float) -> float:
    """Percent of coverage per step (CpV = 100 · mean C / mean episode length) of n episodes; 0.0 without any.

    Their final coverages are `(n,)` within [0, 1], their lengths `(n,)` steps.
    """
    return float(100 * np.mean(coverages) / np.mean(lengths)) if len(lengths) else 0.0


def path_length(start: Float, positions: Float) -> float:
    """Length in metres of the way from `(3,)` start through `(n, 3)` positions."""
    points = np.concatenate([np.asarray(start)[None], np.asarray(positions).reshape(-1, 3)])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


CONFIDENCE = 0.95


def mean_and_half_width(values: ArrayLike) -> tuple[NDArray, NDArray]:
    """Mean of `(n, ...)` values over n episodes or runs, and half the width of its confidence interval, `(...)` each.

    By Student's t with n - 1 degrees; nan for one episode, of whose spread nothing is known.
    """
    from scipy import stats

    values = np.asarray(values, dtype=np.float64)
    n = len(values)
    mean = values.mean(axis=0)
    if n < 2:
        return mean, np.full_like(mean, np.nan)
    error = values.std(axis=0, ddof=1) / np.sqrt(n)
    return mean, stats.t.ppf((1 + CONFIDENCE) / 2, n - 1) * error
