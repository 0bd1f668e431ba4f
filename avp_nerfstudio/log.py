"""`python -m avp_nerfstudio.log`: score and picture a finished training's held-out views, and log them."""

import argparse
import contextlib
import json
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from avp_habitat import command
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.metrics import TERMS, explained
from avp_habitat.tracking.experiments import DEFAULT_HELP
from avp_habitat.tracking.stores import DEFAULT_ADDRESS, about_run, address_of, open_store
from avp_nerfstudio.tracking.mlflow import open_again
from avp_nerfstudio.tracking.trained_run import TrainedRun, config_path, open_trained, read_config

if TYPE_CHECKING:
    from avp_habitat.tracking.run import TrackedRun as MLflowRun
    from avp_nerfstudio.data.heldout import HeldoutView
    from avp_nerfstudio.tracking.rerun import ReconstructionRecording

TABLE = "heldout.json"
_ARTIFACTS = "heldout"


@dataclass(frozen=True)
class Request:
    """What to log, and where."""

    config: Path
    """config.yml of the training."""
    output: Path
    """Folder of the table and the pictures."""
    mlflow: str | None
    """MLflow address, None for none."""
    experiment: str | None = None
    """MLflow experiment of a new run."""
    rerun: Path | None = None
    """Recording to write."""
    pictures: int | None = None
    """How many views to keep as pictures, evenly spread; None for all."""


@dataclass(frozen=True)
class Logged:
    """What came of it."""

    scores: dict[str, float]
    """Means over the held-out views."""
    table: Path
    """Scores by view, JSON."""
    run_id: str | None
    """MLflow run."""
    delivered: bool = True
    """Whether MLflow has all of it."""


def log(request: Request) -> Logged:
    """Render the held-out views of a training once, and log them.

    Raises:
        TrainedRunError: the training cannot be opened.
        RolloutError: its rollout cannot be used.
        TrackingError: MLflow cannot be reached or refuses.
        UsageError: the recording or the output folder cannot be written.
    """
    # nerfstudio's scripts come first: its modules import each other in circles, and this way round is its own.
    import nerfstudio.scripts.eval  # noqa: F401

    if request.mlflow:
        open_store(request.mlflow)  # before anything is rendered, which takes long
    config = read_config(request.config)
    _make_folder(request.output)
    trained = open_trained(config)
    with _recording(request.rerun, trained) as recording:
        rows, pictures = _render(request, trained, recording)
    table = request.output / TABLE
    scores = _write_table(table, request, trained, rows)
    if not request.mlflow:
        return Logged(scores, table, None)
    run_id, delivered = _track(request, request.mlflow, trained, scores, [table, *pictures])
    return Logged(scores, table, run_id, delivered)


def _render(
    request: Request, trained: TrainedRun, recording: "ReconstructionRecording | None"
) -> tuple[list[dict[str, Any]], list[Path]]:
    """The table's rows, and the pictures' files."""
    from avp_nerfstudio.data.heldout import heldout_count, render_views

    count = heldout_count(trained.pipeline)
    if not count:
        raise RolloutError(f"{request.config}: its data has no held-out views to score")
    chosen = _spread(count, count if request.pictures is None else request.pictures)
    rows, pictures = [], []
    with tqdm(total=count, unit="view", desc="rendering held-out views", disable=None) as progress:
        for view in render_views(trained.pipeline):
            rows.append({"view": view.index, "name": view.name, **view.scores, "seconds": round(view.seconds, 3)})
            if view.index in chosen:
                pictures.append(_write_picture(request.output, view))
            if recording is not None:
                recording.view(view)
            progress.set_postfix_str(f"PSNR {view.scores['psnr']:.2f} dB", refresh=False)
            progress.update()
    return rows, pictures


def _write_picture(folder: Path, view: "HeldoutView") -> Path:
    from avp_habitat.rollout.images import write_rgb
    from avp_nerfstudio.data.heldout import triptych

    path = folder / f"view_{view.index:05d}.png"
    write_rgb(path, triptych(view))
    return path


def _write_table(path: Path, request: Request, trained: TrainedRun, rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    from avp_nerfstudio.data.heldout import mean_scores

    scores = mean_scores([{key: row[key] for key in row if key not in ("view", "name")} for row in rows])
    seconds = scores.pop("seconds")
    about = {
        "method": trained.config.method_name,
        "checkpoint": trained.checkpoint.name,
        "step": trained.step,
        "mean": scores,
        "seconds_per_view": seconds,
        "views": rows,
    }
    path.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    return scores


def _track(
    request: Request, address: str, trained: TrainedRun, scores: dict[str, float], files: list[Path]
) -> tuple[str, bool]:
    """The run's id, and whether MLflow has all of it."""
    from avp_nerfstudio.tracking.facts import facts_of
    from avp_nerfstudio.tracking.logger import read_events

    folder = request.config.parent
    facts = facts_of(trained.config)
    run, had_one = open_again(address, facts, folder=folder, experiment=request.experiment)
    with _closing(run) as done:
        if not had_one:
            for scalar in read_events(folder / trained.config.logging.relative_log_dir, _every(trained.config)):
                run.metrics({scalar.name: scalar.value}, scalar.step, timestamp_ms=int(1000 * scalar.timestamp))
        run.metrics({f"eval/{name}": value for name, value in scores.items()}, trained.step)
        for path in (request.config, *folder.glob("dataparser_transforms.json")):
            run.file(path)
        for path in files:
            run.file(path, f"{_ARTIFACTS}/{path.name}")
    return run.run_id, done.delivered


def _every(config: Any) -> int:
    return max(int(config.logging.steps_per_log), 1)


@dataclass
class _Done:
    """How a run was closed."""

    delivered: bool = False
    """Whether MLflow has all of it."""


@contextlib.contextmanager
def _closing(run: "MLflowRun") -> Iterator[_Done]:
    done = _Done()
    try:
        yield done
    except BaseException as error:
        run.close("KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED")
        raise
    done.delivered = run.close("FINISHED")


@contextlib.contextmanager
def _recording(path: Path | None, trained: TrainedRun) -> "Iterator[ReconstructionRecording | None]":
    if path is None:
        yield None
        return
    from avp_nerfstudio.tracking.logger import read_events, start_recording

    recording = start_recording(path, trained.pipeline)
    try:
        folder = trained.config.relative_model_dir.parent / trained.config.logging.relative_log_dir
        for scalar in read_events(folder, _every(trained.config)):
            recording.scalar(scalar.name, scalar.value, scalar.step)
        yield recording
    finally:
        recording.close()


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--output {folder}: cannot make this folder: {error.strerror}") from None


def _spread(count: int, at_most: int) -> set[int]:
    """At most `at_most` of 0 … count - 1, evenly spread."""
    return {round(i * (count - 1) / max(at_most - 1, 1)) for i in range(min(count, at_most))}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m avp_nerfstudio.log",
        description="Render and score the held-out views of a finished nerfstudio training (any method), write "
        "pictures of truth, render and error, and log all to MLflow, in the run of the training if it had one.",
        epilog="A config.yml names Python objects, which are made when it is read: open those of your own trainings "
        "only. Checkpoints are read with torch's safe loader.",
    )
    add = parser.add_argument
    add("config", type=Path, metavar="CONFIG", help="config.yml of the training, or its folder")
    add(
        "--mlflow",
        default="auto",
        metavar="ADDRESS",
        help=f"an MLflow address such as {DEFAULT_ADDRESS}; auto: MLFLOW_TRACKING_URI, or else {DEFAULT_ADDRESS}; "
        "off: no MLflow (default: %(default)s)",
    )
    add(
        "--experiment",
        metavar="NAME",
        help="MLflow experiment of a new run (default: that of the rollout's run, below which this one then appears: "
        f"the one in which its policy was trained, else {DEFAULT_HELP})",
    )
    add("--rerun", type=Path, metavar="FILE", help="write a Rerun recording (.rrd) to this file, which must not exist")
    add("--pictures", type=int, metavar="N", help="keep pictures of N views, evenly spread (default: all)")
    add("--output", type=Path, metavar="DIR", help="folder of table and pictures (default: heldout beside CONFIG)")
    return parser


def _request(argv: Sequence[str]) -> Request:
    options = _parser().parse_args(argv)
    if options.pictures is not None and options.pictures < 0:
        raise UsageError(f"--pictures: expected a number from 0, got {options.pictures}")
    if options.rerun is not None and options.rerun.exists():
        raise UsageError(f"--rerun {options.rerun}: exists already; choose another name or remove it")
    config = config_path(options.config)
    return Request(
        config=config,
        output=options.output or config.parent / "heldout",
        mlflow=address_of(options.mlflow, default=DEFAULT_ADDRESS),
        experiment=options.experiment,
        rerun=options.rerun,
        pictures=options.pictures,
    )


def main(argv: Sequence[str]) -> None:
    """Log one training; print its scores and where everything went."""
    request = _request(argv)
    logged = log(request)
    for name, value in logged.scores.items():
        print(f"  {name:<20} {value:.4f}")
    print(explained(*(name.upper() for name in logged.scores if name.upper() in TERMS)))
    print(f"pictures and table: {logged.table.parent}")
    if request.rerun is not None:
        print(f"recording:          rerun {shlex.quote(str(request.rerun))}")
    if request.mlflow and logged.run_id:
        print(about_run(logged.run_id, request.mlflow, delivered=logged.delivered))


if __name__ == "__main__":
    sys.exit(command.run(main))
