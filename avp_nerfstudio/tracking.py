"""What follows a training while it runs: an MLflow run, a Rerun recording, both or neither."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfstudio.utils import writer

from avp_nerfstudio.tracking_events import ScalarWriter
from avp_nerfstudio.tracking_facts import facts_of
from avp_nerfstudio.tracking_mlflow import Status, TrackedRun, open_run, remembered_id
from avp_nerfstudio.tracking_rerun import ReconstructionRecording

if TYPE_CHECKING:
    from mlflow import MlflowClient

_FILES = ("config.yml", "dataparser_transforms.json")


class Trackers:
    """The run and the recording of one training."""

    def __init__(self, run: TrackedRun | None = None, recording: ReconstructionRecording | None = None) -> None:
        """Follow a training with these."""
        self._run = run
        self._recording = recording
        self._writer: ScalarWriter | None = None

    @classmethod
    def of(cls, config: Any, client: "MlflowClient | None", pipeline: Any) -> "Trackers":
        """Open what a training's options ask for.

        Args:
            config: `AVPTrainerConfig`.
            client: of the MLflow store, None for no run.
            pipeline: nerfstudio's; its cameras go into the recording.

        Raises:
            AVPError: the store or the recording cannot be used.
        """
        recording = start_recording(config.rerun, pipeline) if config.rerun is not None else None
        if client is None:
            return cls(None, recording)
        run = open_run(client, facts_of(config), folder=config.get_base_dir(), experiment=config.mlflow_experiment)
        if config.load_dir is not None and (earlier := remembered_id(config.load_dir.parent)) is not None:
            client.set_tag(run.run_id, "avp.continued_from", earlier)
        return cls(run, recording)

    def listen(self, every: int) -> None:
        """Take nerfstudio's numbers from now on, those of each iteration only `every` so many."""
        sinks = [tracker.scalar for tracker in (self._run, self._recording) if tracker is not None]
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
            run.close(status, files=[folder / name for name in _FILES if (folder / name).is_file()])
            print(f"MLflow run {run.run_id}")


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
