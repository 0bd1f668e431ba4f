"""What follows a training while it runs: an MLflow run, a Rerun recording, both or neither.

A recording's `world` is nerfstudio's (Z up), in the units of the data before nerfstudio scaled them: metres for a
rollout. Below it are `training` and `heldout` (all cameras) and `camera` (the held-out view of the time line `view`,
with its render); `pictures` holds truth, render and error of that view, `plots` the numbers of the training by `step`.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

# nerfstudio's modules import each other in circles; the trainer has to come before the writers.
import nerfstudio.engine.trainer  # noqa: F401  isort: skip
import numpy as np
from nerfstudio.utils import writer
from nerfstudio.utils.writer import EventName, Writer
from numpy.typing import NDArray

from avp_habitat.errors import UsageError
from avp_habitat.files import check_new
from avp_habitat.tracking.deliver import recover_in_background
from avp_habitat.tracking.names import OFFLINE
from avp_habitat.tracking.run import Status, TrackedRun
from avp_habitat.tracking.stores import about_run
from avp_nerfstudio.method.scores import HeldoutView, error_colours, to_8_bit
from avp_nerfstudio.tracking.mlflow import facts_of, open_run, remembered_id

Sink = Callable[[str, float, int], None]
"""Takes name, value and iteration."""

# Its remaining time counts down from the wrong end when a training is resumed, and nobody plots it.
_DROPPED = {EventName.ETA.value}
_EVERY_ITERATION = {EventName.ITER_TRAIN_TIME.value, EventName.TRAIN_RAYS_PER_SEC.value}
_FILES = ("config.yml", "dataparser_transforms.json")
_FRUSTUM_M, _VIEW_FRUSTUM_M = 0.15, 0.3
_TRAINING_COLOUR, _HELDOUT_COLOUR = (228, 120, 51), (66, 110, 190)
_JPEG_QUALITY = 90


class ScalarWriter(Writer):
    """One of nerfstudio's event writers: hands the numbers that are kept to others."""

    def __init__(self, sinks: Sequence[Sink], every: int) -> None:
        """Hand each number to all `sinks`, those that arrive in each iteration only `every` so many iterations."""
        self._sinks = tuple(sinks)
        self._every = every

    def write_scalar(self, name: str, scalar: Any, step: int) -> None:
        """Hand a number on; a tensor of one element counts as one."""
        if _is_kept(name, step, self._every):
            for sink in self._sinks:
                sink(name, float(scalar), step)

    def write_image(self, name: str, image: Any, step: int) -> None:
        """Nothing: pictures are rendered once, after the training."""

    def write_config(self, name: str, config_dict: dict[str, Any], step: int) -> None:
        """Nothing: settings are logged as facts of the run."""


def _is_kept(name: str, step: int, every: int) -> bool:
    """Nerfstudio logs times and learning rates in each iteration, losses every so many."""
    each = name in _EVERY_ITERATION or name.startswith("learning_rate/")
    return name not in _DROPPED and (not each or step % every == 0)


def read_events(config: Any, folder: Path) -> Iterator[tuple[str, float, int, float]]:
    """The numbers that a training's TensorBoard event files hold of those that are kept; none when it wrote none.

    Args:
        config: nerfstudio's `TrainerConfig`.
        folder: of the training.

    Yields:
        nerfstudio's name, the value in nerfstudio's unit, the iteration, and seconds since 1970.
    """
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder, every = folder / config.logging.relative_log_dir, max(int(config.logging.steps_per_log), 1)
    if not any(folder.glob("events.out.tfevents.*")):
        return
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    for name in events.Tags()["scalars"]:
        for event in events.Scalars(name):
            if _is_kept(name, event.step, every):
                yield name, event.value, event.step, event.wall_time


class ReconstructionRecording:
    """A Rerun recording, written to a file while things happen: what came before an interruption is kept."""

    def __init__(self, path: Path, pipeline: Any) -> None:
        """Start a recording that shows the cameras of a pipeline (nerfstudio's) as small pyramids.

        Raises:
            UsageError: the file exists or cannot be written, or Rerun is not installed.
        """
        rr = _rerun()
        check_new(path, option="--rerun")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        except OSError as error:
            raise UsageError(f"--rerun {path}: cannot write there: {error.strerror}") from None
        manager = pipeline.datamanager
        outputs = getattr(manager, "train_dataparser_outputs", None)
        self.path = path
        self._units_per_metre = 1.0 if outputs is None else outputs.dataparser_scale
        self._recording = rr.RecordingStream("avp")
        self._recording.save(path, default_blueprint=_blueprint())
        self._recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._cameras("world/training", manager.train_dataset, _TRAINING_COLOUR)
        self._cameras("world/heldout", manager.eval_dataset, _HELDOUT_COLOUR)

    def scalar(self, name: str, value: float, step: int) -> None:
        """Add a number of the training to its plot."""
        rr = _rerun()
        self._recording.set_time("step", sequence=step)
        parts = [rr.escape_entity_path_part(part) for part in name.split("/")]
        self._recording.log("/".join(["plots", *parts]), rr.Scalars(value))
        self._recording.reset_time()

    def view(self, view: HeldoutView) -> None:
        """Add a held-out view at its place on the time line `view`."""
        rr = _rerun()
        self._recording.set_time("view", sequence=view.index)
        self._camera("world/camera", view.camera, _VIEW_FRUSTUM_M, _HELDOUT_COLOUR, static=False)
        self._picture("world/camera/render", to_8_bit(view.render))
        self._picture("pictures/truth", to_8_bit(view.truth))
        self._picture("pictures/render", to_8_bit(view.render))
        self._picture("pictures/error", error_colours(view))
        for name, score in view.scores.items():
            self._recording.log(f"scores/{name}", rr.Scalars(score))
        self._recording.reset_time()

    def close(self) -> None:
        """Finish the file."""
        self._recording.disconnect()

    def _cameras(self, path: str, dataset: Any, colour: tuple[int, int, int]) -> None:
        cameras = () if dataset is None else dataset.cameras
        for index in range(len(cameras)):
            self._camera(f"{path}/{index:05d}", cameras[index], _FRUSTUM_M, colour, static=True)

    def _picture(self, path: str, colours: NDArray[np.uint8]) -> None:
        self._recording.log(path, _rerun().Image(colours).compress(jpeg_quality=_JPEG_QUALITY))

    def _camera(self, path: str, camera: Any, size_m: float, colour: tuple[int, int, int], *, static: bool) -> None:
        """A camera with nerfstudio's axes: x right, y up, looking along -z."""
        rr = _rerun()
        pose = camera.camera_to_worlds.detach().cpu().numpy().reshape(3, 4).astype(np.float64)
        pinhole = rr.Pinhole(
            image_from_camera=camera.get_intrinsics_matrices().cpu().numpy().reshape(3, 3),
            resolution=[int(camera.width), int(camera.height)],
            camera_xyz=rr.ViewCoordinates.RUB,
            image_plane_distance=size_m,
            color=colour,
        )
        place = rr.Transform3D(translation=pose[:, 3] / self._units_per_metre, mat3x3=pose[:, :3])
        self._recording.log(path, place, pinhole, static=static)


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise UsageError(f"--rerun: Rerun is not installed ({error}): pip install rerun-sdk") from None
    return rerun


def _blueprint() -> Any:
    import rerun.blueprint as rrb

    pictures = [rrb.Spatial2DView(origin=f"pictures/{name}", name=name) for name in ("truth", "render", "error")]
    plots = [rrb.TimeSeriesView(origin="scores", name="scores"), rrb.TimeSeriesView(origin="plots", name="training")]
    scene = rrb.Spatial3DView(origin="world", name="cameras")
    return rrb.Blueprint(rrb.Vertical(rrb.Horizontal(*pictures), rrb.Horizontal(scene, *plots)), collapse_panels=True)


class Trackers:
    """The run and the recording of one training."""

    def __init__(self, config: Any, address: str | None, pipeline: Any) -> None:
        """Open what a training's options ask for.

        Args:
            config: `AVPTrainerConfig`.
            address: of the MLflow store, None for no run.
            pipeline: nerfstudio's; its cameras go into the recording.

        Raises:
            AVPError: the store or the recording cannot be used.
        """
        self._run: TrackedRun | None = None
        self._writer: ScalarWriter | None = None
        self._recording = None if config.rerun is None else ReconstructionRecording(config.rerun, pipeline)
        if address is None:
            return
        earlier = remembered_id(config.load_dir.parent) if config.load_dir is not None else None
        experiment, folder = config.mlflow_experiment, config.get_base_dir()
        self._run = run = open_run(address, facts_of(config), folder=folder, experiment=experiment, earlier=earlier)
        print(about_run(run.run_id, run.address, delivered=not run.run_id.startswith(OFFLINE)))
        recover_in_background()

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
            print(about_run(run.run_id, run.address, delivered=run.close(status)))
