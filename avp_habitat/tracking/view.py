"""What an MLflow experiment's page shows: prepared views with the suite's columns and charts, and how to read them."""

import base64
import hashlib
import json
import logging
import time
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from avp_habitat.metrics import FIGURES, Figure
from avp_habitat.tracking.names import NOTE_TAG, PAGE_TAG, VIEW_TAG, VIEWS_TAG

if TYPE_CHECKING:
    from mlflow import MlflowClient

VERSION = "2"
"""Of the tag `avp.views`; with it, what people change or delete on the page stays as they left it."""
MODEL_TRAINING = "workflowType=machine_learning"
"""Parameter of an address: MLflow 3.17 shows pages of traces first to a browser that has never been there."""
_COLOURS = {
    "heuristic": "#7f7f7f",
    "random": "#bcbd22",
    "spin": "#8c564b",
    "frontier": "#17becf",
    "greedy": "#1f77b4",
    "nbv": "#98df8a",
    "oracle": "#9467bd",
    "survey": "#e377c2",
    "survey-multiview": "#d6278f",
}
_MODEL_COLOURS = ("#d62728", "#ff7f0e", "#2ca02c", "#a55194", "#637939", "#843c39", "#e7969c", "#e7ba52")
_LOG = logging.getLogger(__name__)

Chart = dict[str, Any]
"""A chart as MLflow's page keeps it, with one colour per run."""
_CHART: Chart = {"deleted": False, "isGenerated": False, "runsCountToCompare": 100}


def _bar(metric: str) -> Chart:
    return {"type": "BAR", "metricKey": metric}


def _scatter(x: str, y: str) -> Chart:
    return {"type": "SCATTER", "xaxis": {"key": x, "type": "METRIC"}, "yaxis": {"key": y, "type": "METRIC"}}


def _line(metric: str) -> Chart:
    x = {"xAxisKey": "step", "selectedXAxisMetricKey": "", "useGlobalXaxisKey": False, "xAxisScaleType": "linear"}
    y = {"yAxisKey": "metric", "yAxisExpressions": [], "scaleType": "linear", "range": {}, "lineSmoothness": 0}
    keys = {"metricKey": metric, "selectedMetricKeys": [metric], "useGlobalLineSmoothing": True}
    return {"type": "LINE", **keys, **x, **y}


# What the page keeps beside, as MLflow 3.17 writes it.
_ALWAYS = json.loads("""{
    "orderByAsc": false, "startTime": "ALL", "lifecycleFilter": "Active", "datasetsFilter": [],
    "modelVersionFilter": "All Runs", "runsExpanded": {}, "runsPinned": [], "runsHidden": [], "runsVisibilityMap": {},
    "runsHiddenMode": "SHOW_ALL", "viewMaximized": false, "runListHidden": false, "isAccordionReordered": true,
    "useGroupedValuesInCharts": true, "hideEmptyCharts": true, "groupBy": null, "groupsExpanded": {},
    "autoRefreshEnabled": true, "chartsSearchFilter": "",
    "globalLineChartConfig": {"xAxisKey": "step", "lineSmoothness": 0, "selectedXAxisMetricKey": ""}
}""")


@dataclass(frozen=True)
class RunsView:
    """A view of the runs page: its name in addresses, and its title in the page's menu."""

    key: str
    title: str
    runs: str
    """MLflow's filter of the runs that it shows."""
    columns: str
    """Metrics as `eval/psnr`, tags as `avp.policy`, parameters as `env.reward`."""
    order: str
    """The column by which runs are sorted, the largest first."""
    charts: dict[str, list[Chart]]
    """Groups by title, from top to bottom."""

    def tag(self, created_ms: int) -> str:
        """Value of the experiment's tag that holds it."""
        columns = list(map(_column, self.columns.split()))
        shown = {"display": True, "isReordered": True, "deleted": False, "isGenerated": False}
        ids = {name: f"{self.key}-{number}" for number, name in enumerate(self.charts)}
        state = _ALWAYS | {
            "searchFilter": self.runs,
            "orderByKey": _column(self.order),
            "selectedColumns": columns,
            "columnOrder": columns,
            "columnWidths": {_column(name): max(120, 40 + 7 * len(name)) for name in self.columns.split()},  # pixels
            "compareRunSections": [{"uuid": ids[name], "name": name, **shown} for name in self.charts],
            "compareRunCharts": [
                {"uuid": f"{ids[name]}-{number}", "metricSectionId": ids[name], **_CHART, **chart}
                for name, charts in self.charts.items()
                for number, chart in enumerate(charts)
            ],
        }
        packed = base64.b64encode(zlib.compress(json.dumps(state, separators=(",", ":")).encode(), 9))
        return json.dumps({"name": self.title, "createdAt": created_ms, "state": f"deflate;{packed.decode('ascii')}"})


def _column(name: str) -> str:
    if name == "start_time":
        return "attributes.start_time"
    kind = "metrics" if "/" in name else "tags" if name.startswith("avp.") else "params"
    return f"{kind}.`{name}`"


_COMPARED = "eval/psnr eval/views eval/coverage eval/visibility eval/visibility_parallax eval/ssim eval/lpips"
_COURSE = "avp/coverage avp/views avp/cpv rollout/ep_rew_mean avp/stop_share avp/redundant_views"
RECONSTRUCTIONS = RunsView(
    key="avp-reconstructions",
    title="Reconstructions by policy",
    runs="metrics.`eval/psnr` > -1000",
    columns=f"avp.policy {_COMPARED} avp.scene avp.method",
    order="eval/psnr",
    charts={
        "Up and left is better": [_scatter("eval/views", "eval/psnr"), _scatter("eval/coverage", "eval/psnr")],
        "A bar per run": list(map(_bar, _COMPARED.split())),
    },
)
EVALUATIONS = RunsView(
    key="avp-evaluations",
    title="Evaluations by policy",
    runs="metrics.`eval/curve` >= 0",
    columns="avp.policy eval/coverage eval/coverage_ci95 eval/views eval/cpv eval/stopped eval/episodes avp.scene",
    order="eval/coverage",
    charts={
        "Coverage by view": [_line("eval/curve"), {"type": "IMAGE", "imageKeys": ["eval/trajectory"], "step": 0}],
        "A bar per policy": [_bar("eval/coverage"), _bar("eval/views"), _bar("eval/cpv")],
    },
)
TRAININGS = RunsView(
    key="avp-trainings",
    title="Trainings by environment step",
    runs="metrics.`avp/coverage` >= 0",
    columns="avp.scene avp/coverage avp/views avp/cpv rollout/ep_rew_mean time/fps env.reward env.observation seed",
    order="start_time",
    charts={
        "By environment step": list(map(_line, _COURSE.split())),
        "Evaluations by environment step": [_line("eval/coverage"), _line("eval/views"), _line("eval/cpv")],
    },
)
VIEWS = (RECONSTRUCTIONS, EVALUATIONS, TRAININGS)
"""In the order of the page's menu."""


def path_of(experiment_id: str, view: RunsView = RECONSTRUCTIONS, *, charts: bool = False) -> str:
    """What follows the server's address, to open a view as a table or as `charts`."""
    mode = "&compareRunsMode=CHART" if charts else ""
    return f"#/experiments/{experiment_id}/runs?{MODEL_TRAINING}&viewStateShareKey={view.key}{mode}"


def run_colour(policy: str) -> str:
    """The colour (`#rrggbb`) of a policy's runs on the page: the same in each run, its own for each baseline."""
    place = hashlib.sha256(policy.encode()).digest()[0] % len(_MODEL_COLOURS)
    return _COLOURS.get(policy, _MODEL_COLOURS[place])


def prepare_experiment(client: "MlflowClient", experiment_id: str) -> None:
    """Give an experiment its description and its views, once; later changes by people stay. Failing is a warning."""
    now = int(1000 * time.time())
    try:
        present = client.get_experiment(experiment_id).tags
        if present.get(VIEWS_TAG) == VERSION:
            return
        once = {NOTE_TAG: _note(experiment_id), PAGE_TAG: "custom_model_development"}
        tags = {key: value for key, value in once.items() if not present.get(key)}
        # The menu shows the latest first.
        tags |= {VIEW_TAG + view.key: view.tag(now - age) for age, view in enumerate(VIEWS)}
        # The version comes last, so that a cut connection is made good by the next run.
        for key, value in (*tags.items(), (VIEWS_TAG, VERSION)):
            client.set_experiment_tag(experiment_id, key, value)
    except Exception as error:
        _LOG.warning("MLflow experiment %s: its page could not be prepared: %s", experiment_id, error)


_EXPLAINED = ("views", "coverage", "cpv", "ei", "annd_m", "redundant_views")
_EXPLAINED += ("visibility", "visibility_parallax", "psnr", "ssim", "lpips")


def _explained(figure: Figure) -> str:
    unit = f" [{figure.unit}]" if figure.unit and figure.scale == 1 else ""
    better = f"; {figure.better} is better" if figure.better else ""
    return f"- `eval/{figure.name}`{unit}: {figure.meaning}{better}"


def _note(experiment_id: str) -> str:
    table, charts = (path_of(experiment_id, charts=charts) for charts in (False, True))
    lines = "\n".join(_explained(FIGURES[name]) for name in _EXPLAINED)
    return f"""\
Which policy gives the better reconstruction for fewer views? [**Table**]({table}), [**charts**]({charts}).

More views: [evaluations, coverage by view]({path_of(experiment_id, EVALUATIONS, charts=True)}), \
[trainings by environment step]({path_of(experiment_id, TRAININGS, charts=True)}). All are in the menu *Views*, too.

{lines}
- `avp.policy`, `avp.scene`: who took the pictures, and where.

A table of the means by policy: `python -m avp_habitat.tracking.compare`, then the run *comparison*.
"""
