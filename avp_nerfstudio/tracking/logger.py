"""What follows a training while it runs: an MLflow run, a Rerun recording, both or neither."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nerfstudio.engine.trainer  # noqa: F401
from nerfstudio.utils import writer
from nerfstudio.utils.writer import EventName, Writer

from avp_habitat.tracking.deliver import recover_in_background
from avp_habitat.tracking.names import OFFLINE
from avp_habitat.tracking.run import Status, TrackedRun
from avp_habitat.tracking.stores import about_run
from avp_nerfstudio.tracking.facts import facts_of
from avp_nerfstudio.tracking.mlflow import open_run, remembered_id
from avp_nerfstudio.tracking.rerun import ReconstructionRecording

# nerfstudio's modules import each other in circles; the trainer has to come before the writers.

Sink = Callable[[str, float, int], None]
"""Takes name, value and iteration."""

# Its remaining time counts down from the wrong end when a training is resumed, and nobody plots it.
_DROPPED = {EventName.ETA.value}
_EVERY_ITERATION = {EventName.ITER_TRAIN_TIME.value, EventName.TRAIN_RAYS_PER_SEC.value}


@dataclass(frozen=True)
class Scalar:
    """A number that nerfstudio logged."""

    name: str
    """nerfstudio's."""
    value: float
    """In nerfstudio's unit."""
    step: int
    """Iteration."""
    timestamp: float
    """Seconds since 1970."""


class ScalarWriter(Writer):
    """One of nerfstudio's event writers: hands the numbers that are kept to others."""

    def __init__(self, sinks: Sequence[Sink], every: int) -> None:
        """Hand each number to all `sinks`, those that arrive in each iteration only `every` so many iterations."""
        self._sinks = tuple(sinks)
        self._every = every

    def write_scalar(self, name: str, scalar: Any, step: int) -> None:
        """Hand a number on; a tensor of one element counts as one."""
        if is_kept(name, step, self._every):
            for sink in self._sinks:
                sink(name, float(scalar), step)

    def write_image(self, name: str, image: Any, step: int) -> None:
        """Nothing: pictures are rendered once, after the training."""

    def write_config(self, name: str, config_dict: dict[str, Any], step: int) -> None:
        """Nothing: settings are logged as facts of the run."""


def is_kept(name: str, step: int, every: int) -> bool:
    """Whether a number is kept: nerfstudio logs times and learning rates in each iteration, losses every so many."""
    each = name in _EVERY_ITERATION or name.startswith("learning_rate/")
    return name not in _DROPPED and (not each or step % every == 0)


def read_events(folder: Path, every: int) -> Iterator[Scalar]:
    """The kept numbers of a training's TensorBoard event files; none when it wrote none."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    if not any(folder.glob("events.out.tfevents.*")):
        return
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    for name in events.Tags()["scalars"]:
        for event in events.Scalars(name):
            if is_kept(name, event.step, every):
                yield Scalar(name, event.value, event.step, event.wall_time)


_FILES = ("config.yml", "dataparser_transforms.json")


class Trackers:
    """The run and the recording of one training."""

    def __init__(self, run: TrackedRun | None = None, recording: ReconstructionRecording | None = None) -> None:
        """Follow a training with these."""
        self._run = run
        self._recording = recording
        self._writer: ScalarWriter | None = None

    @classmethod
    def of(cls, config: Any, address: str | None, pipeline: Any) -> "Trackers":
        """Open what a training's options ask for.

        Args:
            config: `AVPTrainerConfig`.
            address: of the MLflow store, None for no run.
            pipeline: nerfstudio's; its cameras go into the recording.

        Raises:
            AVPError: the store or the recording cannot be used.
        """
        recording = start_recording(config.rerun, pipeline) if config.rerun is not None else None
        if address is None:
            return cls(None, recording)
        run = open_run(
            address,
            facts_of(config),
            folder=config.get_base_dir(),
            experiment=config.mlflow_experiment,
            earlier=remembered_id(config.load_dir.parent) if config.load_dir is not None else None,
        )
        print(about_run(run.run_id, run.address, delivered=not run.run_id.startswith(OFFLINE)))
        recover_in_background()
        return cls(run, recording)

    def listen(self, every: int) -> None:
        """Take nerfstudio's numbers from now on, those of each iteration only `every` so many."""
        sinks: list[Sink] = [] if self._recording is None else [self._recording.scalar]
        if (run := self._run) is not None:
            sinks.append(lambda name, value, step: run.metrics({name: value}, step))
        if sinks:
            self._writer = ScalarWriter(sinks, every)
            writer.EVENT_WRITERS.append(self._writer)

    def close(self, status: Status, folder: Path) -> None:
        """Take the numbers that nerfstudio still holds, keep the training's small files, end run and recording.

        Args:
            status: of the run.
            folder: of the training.
        """
        if self._writer in writer.EVENT_WRITERS:
            writer.write_out_storage()
            writer.EVENT_WRITERS.remove(self._writer)
        run, self._run = self._run, None
        recording, self._recording = self._recording, None
        if recording is not None:
            recording.close()
            print(f"recording: {recording.path}")
        if run is not None:
            for path in (folder / name for name in _FILES):
                if path.is_file():
                    run.file(path)
            delivered = run.close(status)
            print(about_run(run.run_id, run.address, delivered=delivered))


def start_recording(path: Path, pipeline: Any) -> ReconstructionRecording:
    """A recording that shows the cameras of a pipeline.

    Raises:
        UsageError: the file exists or cannot be written, or Rerun is not installed.
    """
    manager = pipeline.datamanager
    outputs = getattr(manager, "train_dataparser_outputs", None)
    recording = ReconstructionRecording(path, units_per_metre=outputs.dataparser_scale if outputs is not None else 1.0)
    recording.cameras(manager.train_dataset.cameras, heldout=False)
    if manager.eval_dataset is not None:
        recording.cameras(manager.eval_dataset.cameras, heldout=True)
    return recording
