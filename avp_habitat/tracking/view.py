"""What an MLflow experiment's page shows: prepared views with the suite's columns and charts, and how to read them."""

import base64
import hashlib
import json
import logging
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from avp_habitat.metrics import TERMS

if TYPE_CHECKING:
    from mlflow import MlflowClient

VERSION = "1"
VERSION_TAG = "avp.views"
"""Tag of an experiment that has been prepared; with it, what people change or delete there stays as they left it."""
VIEW_TAG = "mlflow.sharedViewState."
NOTE_TAG = "mlflow.note.content"
KIND_TAG = "mlflow.experimentKind"
COLOUR_TAG = "mlflow.runColor"
FIGURES = ("eval/psnr", "eval/views", "eval/coverage", "eval/visibility", "eval/ssim", "eval/lpips")
"""What answers which policy gives the better reconstruction for fewer views."""

_COLOURS = {
    "heuristic": "#7f7f7f",
    "random": "#bcbd22",
    "spin": "#8c564b",
    "frontier": "#17becf",
    "greedy": "#1f77b4",
    "oracle": "#9467bd",
    "survey": "#e377c2",
}
_MODEL_COLOURS = ("#d62728", "#ff7f0e", "#2ca02c", "#a55194", "#637939", "#843c39", "#e7969c", "#e7ba52")
_LOG = logging.getLogger(__name__)
_TERM_OF = (
    ("views", "views", "; fewer is better"),
    ("coverage", "coverage", ", 0 to 1"),
    ("cpv", "CpV", ", in percent"),
    ("ei", "EI", ""),
    ("annd_m", "ANND", ", in metres"),
    ("redundant_views", "redundant views", ""),
    ("visibility", "visibility", ", 0 to 1"),
    ("psnr", "PSNR", ""),
    ("ssim", "SSIM", ""),
    ("lpips", "LPIPS", ""),
)
"""Metric, its term, and what else there is to say of the number."""
MODEL_TRAINING = "workflowType=machine_learning"
"""Parameter of an address: MLflow 3.17 shows pages of traces first to a browser that has never been there."""


@dataclass(frozen=True)
class Chart:
    """A chart of the page: a bar per run, unless it says otherwise; one colour per run."""

    metric: str
    """On its y axis, or the name of its pictures."""
    by: str | None = None
    """Metric on its x axis, for a point per run."""
    line: bool = False
    """Whether it shows the course of the metric by step."""
    pictures: bool = False
    """Whether it shows pictures side by side."""

    def state(self, section: str, number: int) -> dict[str, Any]:
        """As MLflow's page keeps it."""
        place = {"uuid": f"{section}-{number}", "metricSectionId": section, "deleted": False, "isGenerated": False}
        return {**place, "runsCountToCompare": 100, **self._kind()}

    def _kind(self) -> dict[str, Any]:
        if self.pictures:
            return {"type": "IMAGE", "imageKeys": [self.metric], "step": 0}
        if self.by is not None:
            axes = {"xaxis": {"key": self.by, "type": "METRIC"}, "yaxis": {"key": self.metric, "type": "METRIC"}}
            return {"type": "SCATTER", **axes}
        if not self.line:
            return {"type": "BAR", "metricKey": self.metric}
        steps = {
            "xAxisKey": "step",
            "selectedXAxisMetricKey": "",
            "useGlobalXaxisKey": False,
            "xAxisScaleType": "linear",
        }
        values = {"yAxisKey": "metric", "yAxisExpressions": [], "scaleType": "linear", "range": {}, "lineSmoothness": 0}
        keys = {"metricKey": self.metric, "selectedMetricKeys": [self.metric], "useGlobalLineSmoothing": True}
        return {"type": "LINE", **keys, **steps, **values}


@dataclass(frozen=True)
class View:
    """A view of the runs page."""

    key: str
    """Names it in addresses."""
    title: str
    """In the page's menu of views."""
    runs: str
    """MLflow's search filter of the runs that it shows."""
    columns: tuple[str, ...]
    """Of its table, from left to right."""
    sections: tuple[tuple[str, tuple[Chart, ...]], ...]
    """Titled groups of charts, from top to bottom."""
    order: str = "attributes.start_time"
    """Column by which runs are sorted, the largest first."""

    def state(self) -> dict[str, Any]:
        """As MLflow's page keeps it."""
        ids = [f"{self.key}-{number}" for number in range(len(self.sections))]
        places = list(zip(ids, self.sections, strict=True))
        shown = {"display": True, "isReordered": True, "deleted": False, "isGenerated": False}
        return {
            "searchFilter": self.runs,
            "orderByKey": self.order,
            "orderByAsc": False,
            "startTime": "ALL",
            "lifecycleFilter": "Active",
            "datasetsFilter": [],
            "modelVersionFilter": "All Runs",
            "selectedColumns": list(self.columns),
            "columnOrder": list(self.columns),
            "columnWidths": {column: _WIDTHS.get(column, _WIDTH) for column in self.columns},
            "runsExpanded": {},
            "runsPinned": [],
            "runsHidden": [],
            "runsVisibilityMap": {},
            "runsHiddenMode": "SHOW_ALL",
            "viewMaximized": False,
            "runListHidden": False,
            "isAccordionReordered": True,
            "useGroupedValuesInCharts": True,
            "hideEmptyCharts": True,
            "groupBy": None,
            "groupsExpanded": {},
            "autoRefreshEnabled": True,
            "globalLineChartConfig": {"xAxisKey": "step", "lineSmoothness": 0, "selectedXAxisMetricKey": ""},
            "chartsSearchFilter": "",
            "compareRunSections": [{"uuid": key, "name": name, **shown} for key, (name, _) in places],
            "compareRunCharts": [
                chart.state(key, number) for key, (_, charts) in places for number, chart in enumerate(charts)
            ],
        }

    def tag(self, created_ms: int) -> str:
        """Value of the experiment's tag that holds it."""
        state = json.dumps(self.state(), separators=(",", ":")).encode()
        packed = "deflate;" + base64.b64encode(zlib.compress(state, 9)).decode("ascii")
        return json.dumps({"name": self.title, "createdAt": created_ms, "state": packed})


def _metric(name: str) -> str:
    return f"metrics.`{name}`"


def _tag(name: str) -> str:
    return f"tags.`{name}`"


def _param(name: str) -> str:
    return f"params.`{name}`"


_WIDTH = 110
_WIDTHS = {
    _tag("avp.policy"): 150,
    _tag("avp.scene"): 130,
    _tag("avp.method"): 120,
    _metric("eval/coverage"): 125,
    _metric("eval/coverage_ci95"): 160,
    _metric("avp/coverage"): 125,
    _metric("rollout/ep_rew_mean"): 170,
    _param("env.reward"): 130,
    _param("env.observation"): 140,
}
"""Pixels that hold a column's name."""
RECONSTRUCTIONS = View(
    key="avp-reconstructions",
    title="Reconstructions by policy",
    runs="metrics.`eval/psnr` > -1000",
    columns=(_tag("avp.policy"), *map(_metric, FIGURES), _tag("avp.scene"), _tag("avp.method")),
    sections=(
        ("Up and left is better", (Chart("eval/psnr", by="eval/views"), Chart("eval/psnr", by="eval/coverage"))),
        ("A bar per run", tuple(map(Chart, FIGURES))),
    ),
    order=_metric("eval/psnr"),
)
EVALUATIONS = View(
    key="avp-evaluations",
    title="Evaluations by policy",
    runs="metrics.`eval/curve` >= 0",
    columns=(
        _tag("avp.policy"),
        *map(_metric, ("eval/coverage", "eval/coverage_ci95", "eval/views", "eval/cpv", "eval/stopped")),
        _metric("eval/episodes"),
        _tag("avp.scene"),
    ),
    sections=(
        ("Coverage by view", (Chart("eval/curve", line=True), Chart("eval/trajectory", pictures=True))),
        ("A bar per policy", (Chart("eval/coverage"), Chart("eval/views"), Chart("eval/cpv"))),
    ),
    order=_metric("eval/coverage"),
)
TRAININGS = View(
    key="avp-trainings",
    title="Trainings by environment step",
    runs="metrics.`avp/coverage` >= 0",
    columns=(
        _tag("avp.scene"),
        *map(_metric, ("avp/coverage", "avp/views", "avp/cpv", "rollout/ep_rew_mean", "time/fps")),
        *map(_param, ("env.reward", "env.observation", "seed")),
    ),
    sections=(
        (
            "By environment step",
            tuple(
                Chart(name, line=True)
                for name in (
                    "avp/coverage",
                    "avp/views",
                    "avp/cpv",
                    "rollout/ep_rew_mean",
                    "avp/stop_share",
                    "avp/redundant_views",
                )
            ),
        ),
        (
            "Evaluations by environment step",
            tuple(Chart(name, line=True) for name in ("eval/coverage", "eval/views", "eval/cpv")),
        ),
    ),
)
VIEWS: Sequence[View] = (RECONSTRUCTIONS, EVALUATIONS, TRAININGS)
"""In the order of the page's menu."""


def path_of(experiment_id: str, view: View = RECONSTRUCTIONS, *, charts: bool = False) -> str:
    """What follows the server's address, to open a view as a table or as `charts`."""
    mode = "&compareRunsMode=CHART" if charts else ""
    return f"#/experiments/{experiment_id}/runs?{MODEL_TRAINING}&viewStateShareKey={view.key}{mode}"


def run_colour(policy: str) -> str:
    """The colour (`#rrggbb`) of a policy's runs on the page: the same in each run, its own for each baseline."""
    place = hashlib.sha256(policy.encode()).digest()[0] % len(_MODEL_COLOURS)
    return _COLOURS.get(policy, _MODEL_COLOURS[place])


def prepare_experiment(client: "MlflowClient", experiment_id: str) -> str:
    """Give an experiment its description and its views, once; later changes by people stay.

    A store that refuses is a logged warning, because a training does not need its page; a version of MLflow that has
    no such views leaves them alone.

    Args:
        client: of the store.
        experiment_id: of an existing experiment.

    Returns:
        What follows the server's address, to open the reconstructions.
    """
    try:
        present = client.get_experiment(experiment_id).tags
        if present.get(VERSION_TAG) != VERSION:
            for key, value in _tags(experiment_id, present).items():
                client.set_experiment_tag(experiment_id, key, value)
    except Exception as error:
        _LOG.warning("MLflow experiment %s: its page could not be prepared: %s", experiment_id, error)
    return path_of(experiment_id)


def _tags(experiment_id: str, present: dict[str, str]) -> dict[str, str]:
    """All tags that are wanted; the version comes last, so that a cut connection is made good by the next run."""
    now = int(1000 * time.time())
    # The menu shows the latest first.
    views = {VIEW_TAG + view.key: view.tag(now - age) for age, view in enumerate(VIEWS)}
    once = {NOTE_TAG: _note(experiment_id), KIND_TAG: "custom_model_development"}
    return views | {key: value for key, value in once.items() if not present.get(key)} | {VERSION_TAG: VERSION}


def _note(experiment_id: str) -> str:
    table, charts = (path_of(experiment_id, charts=charts) for charts in (False, True))
    return f"""\
Which policy gives the better reconstruction for fewer views? [**Table**]({table}), [**charts**]({charts}).

More views: [evaluations, coverage by view]({path_of(experiment_id, EVALUATIONS, charts=True)}), \
[trainings by environment step]({path_of(experiment_id, TRAININGS, charts=True)}). All are in the menu *Views*, too.

{_terms()}
- `avp.policy`, `avp.scene`: who took the pictures, and where.

A table of the means by policy: `python -m avp_habitat.tracking.compare`, then the run *comparison*.
"""


def _terms() -> str:
    """A line for each metric that has a term."""
    return "\n".join(f"- `eval/{name}`: {TERMS[term]}{more}" for name, term, more in _TERM_OF)
