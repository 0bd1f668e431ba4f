"""What follows a training while it runs: an MLflow run, a Rerun recording, both or neither."""

from pathlib import Path
from typing import Any

from nerfstudio.utils import writer

from avp_habitat.tracking.journal import spool_folder
from avp_habitat.tracking.looking import about_run
from avp_habitat.tracking.recovery import recover_in_background
from avp_habitat.tracking.remote import OFFLINE
from avp_habitat.tracking.run import Status, TrackedRun
from avp_nerfstudio.tracking_events import ScalarWriter, Sink
from avp_nerfstudio.tracking_facts import facts_of
from avp_nerfstudio.tracking_mlflow import open_run, remembered_id
from avp_nerfstudio.tracking_rerun import ReconstructionRecording

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
        recover_in_background(spool_folder())
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
