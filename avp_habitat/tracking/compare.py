"""`python -m avp_habitat.tracking.compare`: the policies of an MLflow experiment in one table."""

import json
import math
import sys
import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import UseAppendAction, arg

from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError, unknown_name
from avp_habitat.files import atomic_folder, check_new
from avp_habitat.metrics import (
    FIGURES,
    METRICS_HELP,
    Figure,
    coverage_per_view,
    explained,
    figures,
    find_metrics,
    mean_and_half_width,
)
from avp_habitat.tables import table
from avp_habitat.tracking import names, stores
from avp_habitat.tracking.experiments import DEFAULT_HELP, chosen_experiment, find_experiment, search_tags
from avp_habitat.tracking.view import MODEL_TRAINING, prepare_experiment, run_colour

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Experiment

TABLE, MARKDOWN, PICTURE = "comparison.json", "comparison.md", "comparison.png"
_SEEN = ("visibility", "visibility_parallax")
_ALWAYS = [FIGURES[name] for name in ("views", "coverage", "cpv", *_SEEN, "psnr", "ssim", "lpips")]
_MOST_RUNS = 50_000  # that MLflow gives in one answer
_HOW_TO_READ = f"""
More PSNR and SSIM are better, less LPIPS; fewer views are better. Means over the runs; ± is half of the 95 % interval.

{explained("coverage", "CpV", "visibility", "parallax", "PSNR", "SSIM", "LPIPS")}.
"""


@dataclass(frozen=True)
class ComparedMethod:
    """One row: the runs of a policy in a scene, by one method."""

    policy: str
    scene: str
    method: str
    runs: int
    means: Mapping[str, float]
    """By name of the figure; what no run has is missing."""
    halves: Mapping[str, float]
    """Half of the 95 % interval, where more than one run or episode tells of the spread."""
    further: tuple[Figure, ...] = ()
    """A user's metrics among them."""


def compare(client: "MlflowClient", experiment_id: str, metrics: Sequence[str] = ()) -> list[ComparedMethod]:
    """What an experiment's reconstructions, rollouts and evaluations (of its first 50,000 runs) say of each method.

    Rows by scene; within it those with a reconstruction first, the best PSNR at the top, then by coverage. `metrics`
    are the user's that no distribution registers.
    """
    found = client.search_runs([experiment_id], "metrics.`eval/coverage` >= 0", max_results=_MOST_RUNS)
    # A reconstruction carries the figures of its rollout, which would otherwise count twice.
    rollouts = {run.data.tags.get(names.ROLLOUT_RUN_TAG) for run in found}
    groups: dict[tuple[str, str, str], list[dict[str, float]]] = defaultdict(list)
    for run in found:
        logged = {name: value for name, value in run.data.metrics.items() if math.isfinite(value)}
        tags = run.data.tags
        # A run without a policy is that of a training with evaluations in between.
        told = tags.get(names.POLICY_TAG) and {"eval/coverage", "eval/views"} <= logged.keys()
        if told and tags.get(names.KIND_TAG) != names.COMPARISON and run.info.run_id not in rollouts:
            method = tags.get(names.METHOD_TAG) or tags.get(names.KIND_TAG) or names.EVALUATION
            groups[tags[names.POLICY_TAG], tags.get(names.SCENE_TAG, "?"), method].append(logged)
    added = [figure for name, figure in figures(metrics).items() if name not in FIGURES]
    return sorted((_method(*key, group, added) for key, group in groups.items()), key=_rank)


def _method(
    policy: str, scene: str, method: str, runs: Sequence[Mapping[str, float]], added: Sequence[Figure]
) -> ComparedMethod:
    means, halves = {}, {"cpv": math.nan}
    for name in [figure.name for figure in (*_ALWAYS, *added) if figure.name != "cpv"]:
        values = [run[f"eval/{name}"] for run in runs if f"eval/{name}" in run]
        if values:
            mean, half = mean_and_half_width(values)
            means[name] = float(mean)
            # A single evaluation is itself a mean over episodes, and knows its interval.
            halves[name] = float(half) if len(values) > 1 else runs[0].get(f"eval/{name}_ci95", math.nan)
    coverages, views = ([run[name] for run in runs] for name in ("eval/coverage", "eval/views"))
    means["cpv"] = coverage_per_view(coverages, views)  # type: ignore[arg-type]
    further = tuple(figure for figure in added if figure.name in means)
    return ComparedMethod(policy, scene, method, len(runs), means, halves, further)


def _rank(one: ComparedMethod) -> tuple[Any, ...]:
    return one.scene, -one.means.get("psnr", -math.inf), -one.means["coverage"], one.policy, one.method


def rows(methods: Sequence[ComparedMethod]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the table; a user's metric has a column where a run has it."""
    shown = list(dict.fromkeys([*_ALWAYS, *(figure for method in methods for figure in method.further)]))
    found = []
    for one in methods:
        known, halves = one.means, one.halves
        texts = (each.text(known[each.name], halves[each.name]) if each.name in known else "–" for each in shown)
        found.append([one.policy, one.scene, one.method, str(one.runs), *texts])
    return ["policy", "scene", "method", "runs", *(figure.heading for figure in shown)], found


def markdown(methods: Sequence[ComparedMethod]) -> str:
    """The table."""
    return table(*rows(methods)) + "\n"


def picture(methods: Sequence[ComparedMethod], path: Path) -> None:
    """Draw PSNR against views, one point per method, where one has a reconstruction."""
    from matplotlib.figure import Figure as Drawing

    drawn = [method for method in methods if "psnr" in method.means]
    if not drawn:
        return
    drawing = Drawing(figsize=(6.4, 4), layout="constrained")
    axes = drawing.subplots()
    for method in drawn:
        # What tells a row from the others.
        parts = [name for name in ("scene", "method") if len({getattr(other, name) for other in drawn}) > 1]
        told = ", ".join(getattr(method, name) for name in parts)
        look = {"fmt": "o", "capsize": 3, "color": run_colour(method.policy)}
        look["label"] = f"{method.policy} ({told})" if told else method.policy
        means, halves = method.means, method.halves
        axes.errorbar(means["views"], means["psnr"], halves["psnr"], halves["views"], **look)
    axes.set(xlabel="views (fewer is better)", ylabel="PSNR [dB] on held-out views", title="up and left is better")
    axes.margins(0.12)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    drawing.savefig(path, dpi=120)


def keep(client: "MlflowClient", experiment_id: str, methods: Sequence[ComparedMethod]) -> str:
    """Make or renew the run that compares these methods, one for each set of scenes; its id."""
    scenes = ", ".join(sorted({method.scene for method in methods}))[: names.MAX_TAG]
    kept = search_tags(client, {names.KIND_TAG: names.COMPARISON}, experiment_id)
    run = next((run for run in kept if run.data.tags.get(names.SCENE_TAG) == scenes), None)
    if run is None:
        tags = {names.KIND_TAG: names.COMPARISON, names.SCENE_TAG: scenes}
        run = client.create_run(experiment_id, run_name=names.COMPARISON, tags=tags)
    run_id = run.info.run_id
    try:
        client.log_dict(run_id, dict(zip(("columns", "data"), rows(methods), strict=True)), TABLE)
        # As `log_table` does, which would append to a table that is there.
        client.set_tag(run_id, "mlflow.loggedArtifacts", json.dumps([{"path": TABLE, "type": "table"}]))
        with tempfile.TemporaryDirectory() as folder:
            _write(Path(folder), methods)
            client.log_artifacts(run_id, folder)
        # The page shows it above everything else.
        client.set_tag(run_id, names.NOTE_TAG, (markdown(methods) + _HOW_TO_READ)[: names.MAX_TAG])
    finally:
        client.set_terminated(run_id)
    return run_id


def _write(folder: Path, methods: Sequence[ComparedMethod]) -> None:
    (folder / MARKDOWN).write_text(markdown(methods) + _HOW_TO_READ, encoding="utf-8")
    picture(methods, folder / PICTURE)


@dataclass(frozen=True)
class CompareRuns:
    """Compare the policies of an MLflow experiment by their reconstructions and evaluations, and print the table.

    It is kept in the experiment as the run 'comparison', which is made once and then renewed.
    """

    experiment: Annotated[str | None, arg(help=f"Of MLflow (omitted: {DEFAULT_HELP}).")] = None
    mlflow: Annotated[str, arg(help=stores.ADDRESS_HELP)] = "auto"
    scene: UseAppendAction[tuple[str, ...]] = ()
    """Only this scene; give it again for more."""
    metrics: Annotated[tuple[str, ...], arg(help=f"{METRICS_HELP}; registered ones are shown without")] = ()
    out: Path | None = None
    """Write table and picture to this folder, too; must not exist."""

    def __post_init__(self) -> None:
        """Refuse no place, and metrics that there are not."""
        find_metrics(self.metrics)
        if self.mlflow == "off":
            raise UsageError("mlflow: expected an address or auto, got off: it is MLflow's runs that are compared")


def main(options: CompareRuns) -> None:
    """Collect, compare, print, keep."""
    from mlflow.exceptions import MlflowException

    address = str(stores.address_of(options.mlflow, default=stores.DEFAULT_ADDRESS))
    if options.out is not None:
        check_new(options.out, option="--out")
    # A misspelt name makes no database.
    client = stores.connect(address, make=False)
    try:
        experiment = find_experiment(client, *(chosen := chosen_experiment(options.experiment)))
        if experiment is None:
            known = [one.name for one in client.search_experiments()]
            raise UsageError(f"--experiment: {unknown_name('experiment', str(chosen[0]), known)}")
        methods = _methods(client, experiment, options)
        print(markdown(methods))
        run = keep(client, experiment.experiment_id, methods)
        prepare_experiment(client, experiment.experiment_id)
    except MlflowException as error:
        problem = f"does not answer: {stores.first_line(error)}"
        raise stores.TrackingError(f"MLflow at {stores.shown(address)} {problem}") from None
    if options.out is not None:
        with atomic_folder(options.out, failure=UsageError, option="--out") as folder:
            _write(folder, methods)
        print(f"files:   {options.out}")
    there = stores.how_to_look(address)
    there = there.rstrip("/") if address.startswith("http") else f"{there}, then http://127.0.0.1:5000"
    print(f"MLflow:  run {run} in experiment {experiment.name!r} at {stores.shown(address)}")
    print(f"look:    {there}/#/experiments/{experiment.experiment_id}/runs/{run}?{MODEL_TRAINING}")


def _methods(client: "MlflowClient", experiment: "Experiment", options: CompareRuns) -> list[ComparedMethod]:
    methods = compare(client, experiment.experiment_id, options.metrics)
    if not methods:
        raise AVPError(
            f"experiment {experiment.name!r} at {stores.shown(client.tracking_uri)} has no run with eval/coverage, "
            "eval/views and the tag avp.policy; such runs are made by python -m avp_sb3.evaluate, ns-train "
            "avp-nerfacto and python -m avp_nerfstudio.log"
        )
    known = {method.scene for method in methods}
    for scene in options.scene:
        if scene not in known:
            raise UsageError(f"--scene: {unknown_name('scene', scene, known)}")
    return [method for method in methods if not options.scene or method.scene in options.scene]


if __name__ == "__main__":
    sys.exit(command.run(main))
