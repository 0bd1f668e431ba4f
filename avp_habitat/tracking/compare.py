"""`python -m avp_habitat.tracking.compare`: one table of an MLflow experiment's methods, kept there as a run."""

import argparse
import os
import shlex
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError, unknown_name
from avp_habitat.metrics import explained
from avp_habitat.tracking.comparison import (
    KIND,
    KIND_TAG,
    SCENE_TAG,
    Method,
    collect_runs,
    columns,
    compare,
    markdown,
    picture,
)
from avp_habitat.tracking.experiments import DEFAULT_HELP, find_experiment, meant
from avp_habitat.tracking.stores import DEFAULT_ADDRESS, TrackingError, address_of, connect, first_line, shown
from avp_habitat.tracking.view import MODEL_TRAINING, prepare_experiment

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Experiment

TABLE, MARKDOWN, PICTURE = "comparison.json", "comparison.md", "comparison.png"
NAME = "comparison"
_NOTE = "mlflow.note.content"
_MAX_TAG = 5000
_HOW_TO_READ = f"""
More PSNR and SSIM are better, less LPIPS; fewer views are better. Means over the runs; ± is half of the 95 % interval.

{explained("coverage", "CpV", "visibility", "PSNR", "SSIM", "LPIPS")}.
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m avp_habitat.tracking.compare",
        description="Compare the policies of an MLflow experiment by their reconstructions and evaluations, print the "
        "table, and keep it in the experiment as the run 'comparison', which is made once and then renewed.",
    )
    add = parser.add_argument
    add("--experiment", metavar="NAME", help=f"of MLflow (default: {DEFAULT_HELP})")
    add(
        "--mlflow",
        default="auto",
        metavar="ADDRESS",
        help=f"an MLflow address such as {DEFAULT_ADDRESS}; auto: MLFLOW_TRACKING_URI, or else {DEFAULT_ADDRESS} "
        "(default: %(default)s)",
    )
    add("--scene", action="append", default=[], metavar="NAME", help="only this scene; give it again for more")
    add("--out", type=Path, metavar="FOLDER", help="write table and picture to this folder, too; must not exist")
    return parser


def _options(argv: Sequence[str]) -> argparse.Namespace:
    options = _parser().parse_args(argv)
    options.address = address_of(options.mlflow, default=DEFAULT_ADDRESS)
    if options.address is None:
        raise UsageError("--mlflow off: expected an address, for there is nothing to compare without MLflow's runs")
    if options.out is not None and (options.out.exists() or options.out.is_symlink()):
        raise UsageError(f"--out {options.out}: exists already; choose another name or remove it")
    return options


def main(argv: Sequence[str]) -> None:
    """Collect, compare, print, keep."""
    from mlflow.exceptions import MlflowException

    options = _options(argv)
    client = connect(options.address)
    try:
        experiment = _experiment(client, options.experiment)
        methods = _methods(client, experiment, options)
        table = markdown(methods)
        print(table)
        run = keep(client, experiment.experiment_id, methods)
        prepare_experiment(client, experiment.experiment_id)
    except MlflowException as error:
        raise TrackingError(f"MLflow at {shown(options.address)} does not answer: {first_line(error)}") from None
    if options.out is not None:
        _publish(options.out, methods)
        print(f"files:   {options.out}")
    print(f"MLflow:  run {run} in experiment {experiment.name!r} at {shown(options.address)}")
    print(f"look:    {_look(options.address, experiment.experiment_id, run)}")


def keep(client: "MlflowClient", experiment_id: str, methods: Sequence[Method]) -> str:
    """Make or renew the run that compares these methods; there is one for each set of scenes.

    Args:
        client: of the store.
        experiment_id: where the run lies.
        methods: at least one.

    Raises:
        MlflowException: the store refuses.

    Returns:
        The run's id.
    """
    scenes = ", ".join(sorted({method.scene for method in methods}))[:_MAX_TAG]
    run_id = _kept(client, experiment_id, scenes)
    made = run_id is None
    if run_id is None:
        tags = {KIND_TAG: KIND, SCENE_TAG: scenes}
        run_id = client.create_run(experiment_id, run_name=NAME, tags=tags).info.run_id
    try:
        _log(client, run_id, methods, made=made)
    finally:
        client.set_terminated(run_id)
    return run_id


def _log(client: "MlflowClient", run_id: str, methods: Sequence[Method], *, made: bool) -> None:
    by_column = columns(methods)
    if made:
        client.log_table(run_id, by_column, TABLE)
    else:
        # `log_table` would append to the table that is there.
        rows = list(map(list, zip(*by_column.values(), strict=True)))
        client.log_dict(run_id, {"columns": list(by_column), "data": rows}, TABLE)
    with tempfile.TemporaryDirectory() as name:
        for path in _write(Path(name), methods):
            client.log_artifact(run_id, os.fspath(path))
    # The page shows it above everything else.
    client.set_tag(run_id, _NOTE, (markdown(methods) + _HOW_TO_READ)[:_MAX_TAG])


def _kept(client: "MlflowClient", experiment_id: str, scenes: str) -> str | None:
    query = f"tags.`{KIND_TAG}` = '{KIND}'"
    found = client.search_runs([experiment_id], query)
    return next((run.info.run_id for run in found if run.data.tags.get(SCENE_TAG) == scenes), None)


def _experiment(client: "MlflowClient", option: str | None) -> "Experiment":
    name, identity = meant(option)
    found = find_experiment(client, name, identity)
    if found is None:
        known = [experiment.name for experiment in client.search_experiments()]
        raise UsageError(f"--experiment: {unknown_name('experiment', str(name), known)}")
    return found


def _methods(client: "MlflowClient", experiment: "Experiment", options: argparse.Namespace) -> list[Method]:
    runs = collect_runs(client, experiment.experiment_id)
    if not runs:
        raise AVPError(
            f"experiment {experiment.name!r} at {shown(options.address)} has no run with eval/coverage, eval/views "
            "and the tag avp.policy; such runs are made by python -m avp_sb3.evaluate, ns-train avp-nerfacto and "
            "python -m avp_nerfstudio.log"
        )
    known = {run.scene for run in runs}
    for scene in options.scene:
        if scene not in known:
            raise UsageError(f"--scene: {unknown_name('scene', scene, known)}")
    return compare(run for run in runs if not options.scene or run.scene in options.scene)


def _write(folder: Path, methods: Sequence[Method]) -> list[Path]:
    path = folder / MARKDOWN
    path.write_text(markdown(methods) + _HOW_TO_READ, encoding="utf-8")
    return [path, *([folder / PICTURE] if picture(methods, folder / PICTURE) else [])]


def _publish(folder: Path, methods: Sequence[Method]) -> None:
    """Write the folder; it appears only when it is whole."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as name:
            partial = Path(name) / "whole"
            partial.mkdir()
            _write(partial, methods)
            partial.rename(folder)
    except OSError as error:
        raise UsageError(f"--out {folder}: cannot write there: {error.strerror or error}") from None


def _look(address: str, experiment_id: str, run_id: str) -> str:
    page = f"#/experiments/{experiment_id}/runs/{run_id}?{MODEL_TRAINING}"
    if urlsplit(address).scheme in ("http", "https"):
        return f"{shown(address).rstrip('/')}/{page}"
    return f"mlflow ui --backend-store-uri {shlex.quote(shown(address))}, then http://127.0.0.1:5000/{page}"


if __name__ == "__main__":
    sys.exit(command.run(main))
