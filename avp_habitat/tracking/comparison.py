"""Methods compared by their runs in MLflow: which policy gives the better reconstruction for fewer views."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avp_habitat.metrics import coverage_per_view, mean_and_half_width
from avp_habitat.tracking.view import run_colour

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

KIND_TAG, KIND = "avp.kind", "comparison"
ROLLOUT_RUN_TAG = "avp.rollout_run"
"""Of a reconstruction: the run of the rollout that it was made from."""
METHOD_TAG, POLICY_TAG, SCENE_TAG = "avp.method", "avp.policy", "avp.scene"
EVALUATION = "evaluation"
"""Method of a run that has no reconstruction."""
_PSNR, _COVERAGE, _VIEWS = "eval/psnr", "eval/coverage", "eval/views"
_PAGE = 1000


@dataclass(frozen=True)
class _Figure:
    """A figure of the comparison."""

    title: str
    """Of its column, with the unit."""
    scale: float
    """The shown number by the metric."""
    digits: int
    """After the point."""


_FIGURES = {
    _VIEWS: _Figure("views", 1, 1),
    _COVERAGE: _Figure("coverage [%]", 100, 1),
    "cpv": _Figure("CpV [%/view]", 1, 2),
    "eval/visibility": _Figure("visibility [%]", 100, 1),
    _PSNR: _Figure("PSNR [dB]", 1, 2),
    "eval/ssim": _Figure("SSIM", 1, 3),
    "eval/lpips": _Figure("LPIPS", 1, 3),
}


@dataclass(frozen=True)
class RunFigures:
    """What a run says of its method."""

    run_id: str
    """MLflow's."""
    policy: str
    """Who took the views."""
    scene: str
    """Where."""
    method: str
    """nerfstudio's method, or `evaluation`."""
    metrics: Mapping[str, float]
    """The last value of each metric; all finite."""

    @property
    def reconstruction(self) -> bool:
        """Whether there is a reconstruction."""
        return _PSNR in self.metrics


@dataclass(frozen=True)
class Method:
    """One row: the runs of a policy in a scene, by one method."""

    policy: str
    """Who took the views."""
    scene: str
    """Where."""
    method: str
    """nerfstudio's method, or `evaluation`."""
    runs: tuple[str, ...]
    """MLflow ids."""
    means: Mapping[str, float] = field(default_factory=dict)
    """By metric, and `cpv` in percent per view; what no run has is missing."""
    halves: Mapping[str, float] = field(default_factory=dict)
    """Half of the 95 % interval, where more than one run or episode tells of the spread."""

    def cells(self) -> list[str]:
        """As `COLUMNS` says."""
        figures = [_cell(figure, self.means.get(name), self.halves.get(name)) for name, figure in _FIGURES.items()]
        return [self.policy, self.scene, self.method, str(len(self.runs)), *figures]


COLUMNS = ("policy", "scene", "method", "runs", *(figure.title for figure in _FIGURES.values()))
"""Of the table."""


def collect_runs(client: "MlflowClient", experiment_id: str, scenes: Sequence[str] = ()) -> list[RunFigures]:
    """The runs that say something of a policy: reconstructions, rollouts and evaluations.

    Args:
        client: of the store.
        experiment_id: where to look.
        scenes: names; all when empty.
    """
    found = list(_search(client, experiment_id, "metrics.`eval/coverage` >= 0"))
    # A reconstruction carries the figures of its rollout, which would otherwise count twice.
    rollouts = {run.data.tags.get(ROLLOUT_RUN_TAG) for run in found}
    figures = [_figures(run) for run in found if run.info.run_id not in rollouts]
    return [one for one in figures if one is not None and (not scenes or one.scene in scenes)]


def compare(runs: Iterable[RunFigures]) -> list[Method]:
    """Rows by scene; within it those with a reconstruction first, the best PSNR at the top, then by coverage."""
    groups: dict[tuple[str, str, str], list[RunFigures]] = {}
    for run in runs:
        groups.setdefault((run.policy, run.scene, run.method), []).append(run)
    return sorted((_method(*key, group) for key, group in groups.items()), key=_rank)


def markdown(methods: Sequence[Method]) -> str:
    """The table."""
    rows = [list(COLUMNS), *(method.cells() for method in methods)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = [[cell.ljust(width) for cell, width in zip(row, widths, strict=True)] for row in rows]
    padded.insert(1, ["-" * width for width in widths])
    return "\n".join(f"| {' | '.join(row)} |" for row in padded) + "\n"


def columns(methods: Sequence[Method]) -> dict[str, list[str]]:
    """The table by column."""
    rows = [method.cells() for method in methods]
    return {title: [row[place] for row in rows] for place, title in enumerate(COLUMNS)}


def picture(methods: Sequence[Method], path: Path) -> bool:
    """Draw PSNR against views, one point per method; False where none has a reconstruction."""
    from matplotlib.figure import Figure

    shown = [method for method in methods if {_PSNR, _VIEWS} <= method.means.keys()]
    if not shown:
        return False
    drawing = Figure(figsize=(6.4, 4), layout="constrained")
    axes = drawing.subplots()
    for method in shown:
        views, psnr = method.means[_VIEWS], method.means[_PSNR]
        spread = method.halves.get(_PSNR), method.halves.get(_VIEWS)
        colour = run_colour(method.policy)
        axes.errorbar(views, psnr, *spread, fmt="o", capsize=3, color=colour, label=_label(method, shown))
    axes.set(xlabel="views (fewer is better)", ylabel="PSNR [dB] on held-out views", title="up and left is better")
    axes.margins(0.12)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    drawing.savefig(path, dpi=120)
    return True


def _label(method: Method, others: Sequence[Method]) -> str:
    """The policy, with what tells it from the other rows."""
    scenes, kinds = {other.scene for other in others}, {other.method for other in others}
    more = [name for name, among in ((method.scene, scenes), (method.method, kinds)) if len(among) > 1]
    return f"{method.policy} ({', '.join(more)})" if more else method.policy


def _search(client: "MlflowClient", experiment_id: str, query: str) -> "Iterator[Run]":
    token = None
    while True:
        page = client.search_runs([experiment_id], query, max_results=_PAGE, page_token=token)
        yield from page
        token = page.token
        if not token:
            return


def _figures(run: "Run") -> RunFigures | None:
    """None for a run that says nothing of one policy, such as a training with evaluations in between."""
    tags = run.data.tags
    metrics = {name: value for name, value in run.data.metrics.items() if math.isfinite(value)}
    if not tags.get(POLICY_TAG) or not {_COVERAGE, _VIEWS} <= metrics.keys() or tags.get(KIND_TAG) == KIND:
        return None
    method = tags.get(METHOD_TAG) or tags.get(KIND_TAG) or EVALUATION
    return RunFigures(run.info.run_id, tags[POLICY_TAG], tags.get(SCENE_TAG, "?"), method, metrics)


def _method(policy: str, scene: str, method: str, runs: Sequence[RunFigures]) -> Method:
    means: dict[str, float] = {}
    halves: dict[str, float] = {}
    for name in _FIGURES:
        values = [run.metrics[name] for run in runs if name in run.metrics]
        if values:
            mean, half = mean_and_half_width(values)
            means[name] = float(mean)
            # A single evaluation is itself a mean over episodes, and knows its interval.
            own = runs[0].metrics.get(f"{name}_ci95", math.nan) if len(runs) == 1 else math.nan
            width = own if math.isnan(half) else float(half)
            if math.isfinite(width):
                halves[name] = width
    coverages, views = ([run.metrics[name] for run in runs] for name in (_COVERAGE, _VIEWS))
    means["cpv"] = coverage_per_view(coverages, views)  # type: ignore[arg-type]
    return Method(policy, scene, method, tuple(run.run_id for run in runs), means, halves)


def _rank(method: Method) -> tuple[Any, ...]:
    psnr = method.means.get(_PSNR, -math.inf)
    return method.scene, -psnr, -method.means[_COVERAGE], method.policy, method.method


def _cell(figure: _Figure, mean: float | None, half: float | None) -> str:
    if mean is None:
        return "–"
    text = f"{figure.scale * mean:.{figure.digits}f}"
    return text if half is None else f"{text} ± {figure.scale * half:.{figure.digits}f}"
