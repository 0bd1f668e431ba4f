"""`python -m avp_nerfstudio.log`: score and picture a finished training's held-out views, and log them."""

import contextlib
import json
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from avp_habitat import command
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.files import check_new
from avp_habitat.metrics import TERMS, explained
from avp_habitat.ranges import Range, number
from avp_habitat.tracking.experiments import DEFAULT_HELP
from avp_habitat.tracking.stores import DEFAULT_ADDRESS, about_run, address_of, open_store

if TYPE_CHECKING:
    from avp_nerfstudio.method.checkpoints import TrainedRun
    from avp_nerfstudio.recording import ReconstructionRecording

TABLE = "heldout.json"
_EXPERIMENT = (
    "MLflow experiment of a new run (omitted: that of the rollout's run, below which this one then appears: the one in "
    f"which its policy was trained, else {DEFAULT_HELP})"
)


@dataclass(frozen=True)
class Log:
    """Render and score the held-out views of a finished nerfstudio training (any method), and log all to MLflow.

    Pictures of truth, render and error are written and logged too; the run is that of the training if it had one. A
    config.yml names Python objects, which are made when it is read: open those of your own trainings only. Checkpoints
    are read with torch's safe loader.
    """

    config: Positional[Path]
    """config.yml of the training, or its folder."""
    mlflow: str = "auto"
    """An MLflow address such as sqlite:///mlflow.db; auto: MLFLOW_TRACKING_URI, or else sqlite:///mlflow.db; off: no
    MLflow."""
    experiment: Annotated[str | None, arg(help=_EXPERIMENT)] = None
    rerun: Path | None = None
    """Write a Rerun recording (.rrd) to this file, which must not exist."""
    pictures: int | None = None
    """Keep pictures of so many views, evenly spread (omitted: all)."""
    output: Path | None = None
    """Folder of table and pictures (omitted: heldout beside CONFIG)."""

    def __post_init__(self) -> None:
        """Refuse what cannot be right."""
        if self.pictures is not None:
            number("pictures", self.pictures, int, Range(0, 10**9))
        if self.rerun is not None:
            check_new(self.rerun, option="--rerun")


def main(options: Log) -> None:
    """Render the held-out views of a training once and log them; print the mean scores and where everything went.

    Raises:
        TrainedRunError: the training cannot be opened.
        RolloutError: its rollout cannot be used.
        TrackingError: MLflow cannot be reached or refuses.
        UsageError: the recording or the output folder cannot be written.
    """
    from avp_nerfstudio import plugin  # noqa: F401 - leaves out what nerfstudio makes torch say
    from avp_nerfstudio.method.checkpoints import config_path, open_trained, read_config

    path = config_path(options.config)
    # nerfstudio's scripts come first: its modules import each other in circles, and this way round is its own.
    import nerfstudio.scripts.eval  # noqa: F401

    address = address_of(options.mlflow, default=DEFAULT_ADDRESS)
    if address is not None:
        open_store(address)  # before anything is rendered, which takes long
    config = read_config(path)
    output = options.output or path.parent / "heldout"
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--output {output}: cannot make this folder: {error.strerror}") from None
    trained = open_trained(config)
    with _recording(options.rerun, trained, path.parent) as recording:
        rows, pictures = _render(trained, recording, output, options.pictures)
    scores = _write_table(output / TABLE, trained, rows)
    for name, value in scores.items():
        print(f"  {name:<20} {value:.4f}")
    print(explained(*(name.upper() for name in scores if name.upper() in TERMS)))
    print(f"pictures and table: {output}")
    if options.rerun is not None:
        print(f"recording:          rerun {shlex.quote(str(options.rerun))}")
    if address is not None:
        _track(address, options.experiment, trained, path, scores, [output / TABLE, *pictures])


def _render(
    trained: "TrainedRun", recording: "ReconstructionRecording | None", output: Path, at_most: int | None
) -> tuple[list[dict[str, Any]], list[Path]]:
    """The table's rows, and the pictures' files."""
    from avp_habitat.rollout.images import write_rgb
    from avp_nerfstudio.method.scores import heldout_count, render_views, triptych

    count = heldout_count(trained.pipeline)
    if not count:
        raise RolloutError(f"{trained.checkpoint}: its data has no held-out views to score")
    kept = count if at_most is None else min(at_most, count)
    chosen = {round(i * (count - 1) / max(kept - 1, 1)) for i in range(kept)}
    rows, pictures = [], []
    for view in command.progress(
        render_views(trained.pipeline), total=count, unit="view", desc="rendering held-out views"
    ):
        rows.append({"view": view.index, "name": view.name, **view.scores, "seconds": round(view.seconds, 3)})
        if view.index in chosen:
            pictures.append(output / f"view_{view.index:05d}.png")
            write_rgb(pictures[-1], triptych(view))
        if recording is not None:
            recording.view(view)
    return rows, pictures


def _write_table(path: Path, trained: "TrainedRun", rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    from avp_nerfstudio.method.scores import mean_scores

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
    address: str,
    experiment: str | None,
    trained: "TrainedRun",
    config: Path,
    scores: dict[str, float],
    files: Sequence[Path],
) -> None:
    from avp_nerfstudio.tracking import facts_of, open_again, read_events

    folder = config.parent
    run, had_one = open_again(address, facts_of(trained.config), folder=folder, experiment=experiment)
    try:
        if not had_one:
            for name, value, step, seconds in read_events(trained.config, folder):
                run.metrics({name: value}, step, timestamp_ms=int(1000 * seconds))
        run.metrics({f"eval/{name}": value for name, value in scores.items()}, trained.step)
        for path in (config, *folder.glob("dataparser_transforms.json")):
            run.file(path)
        for path in files:
            run.file(path, f"heldout/{path.name}")
    except BaseException as error:
        run.close("KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED")
        raise
    print(about_run(run.run_id, address, delivered=run.close("FINISHED")))


@contextlib.contextmanager
def _recording(path: Path | None, trained: "TrainedRun", folder: Path) -> "Iterator[ReconstructionRecording | None]":
    if path is None:
        yield None
        return
    from avp_nerfstudio.recording import ReconstructionRecording
    from avp_nerfstudio.tracking import read_events

    with contextlib.closing(ReconstructionRecording(path, trained.pipeline)) as recording:
        for name, value, step, _ in read_events(trained.config, folder):
            recording.scalar(name, value, step)
        yield recording


if __name__ == "__main__":
    sys.exit(command.run(main))
