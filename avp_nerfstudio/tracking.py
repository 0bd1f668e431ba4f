"""What follows a training: its MLflow run (settings and origin, which run it is, and whose child), and a recording."""

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

# nerfstudio's modules import each other in circles; the trainer has to come before the writers.
import nerfstudio.engine.trainer  # noqa: F401  isort: skip
from nerfstudio.utils import writer
from nerfstudio.utils.writer import EventName, Writer

from avp_habitat.provenance import flat
from avp_habitat.rollout.format import read_meta
from avp_habitat.tracking import names, rollout_run
from avp_habitat.tracking.deliver import finish, recover_in_background
from avp_habitat.tracking.experiments import find_run
from avp_habitat.tracking.journal import Journal, journal_of
from avp_habitat.tracking.names import safe_name
from avp_habitat.tracking.run import NewRun, Status, TrackedRun, continue_run, join_run, may_continue, start_run
from avp_habitat.tracking.stores import TrackingError, about_run, open_store

if TYPE_CHECKING:
    from mlflow import MlflowClient

Sink = Callable[[str, float, int], None]
"""Takes name, value and iteration."""

# Its remaining time counts down from the wrong end when a training is resumed, and nobody plots it.
_DROPPED = {EventName.ETA.value}
_EVERY_ITERATION = {EventName.ITER_TRAIN_TIME.value, EventName.TRAIN_RAYS_PER_SEC.value}
_FILES = ("config.yml", "dataparser_transforms.json")
RUN_FILE = "mlflow_run_id.txt"
"""In a training's folder: the id of its run."""
# Of no meaning for the result; `mlflow` is an address, which may hold a password.
_NOT_SETTINGS = ("viewer.", "mlflow", "rerun", "logging.local_writer.", "load_config")


@dataclass(frozen=True)
class Facts:
    """What is known of a reconstruction without looking at its course."""

    name: str
    """Of the run."""
    params: Mapping[str, str] = field(default_factory=dict)
    """The settings, flat."""
    tags: Mapping[str, str] = field(default_factory=dict)
    """Method, scene, policy."""
    metrics: Mapping[str, float] = field(default_factory=dict)
    """The figures of the rollout it was made from: `eval/...`, or `rollout/...` when it is not the whole of one."""
    rollouts: tuple[Path, ...] = ()
    """Folders of the rollouts."""
    policy_runs: tuple[str, ...] = ()
    """MLflow runs in which the rollouts' policies were trained, each once."""


def facts_of(config: Any) -> Facts:
    """The facts of a training, from its `TrainerConfig`; its rollout, if it has one, is still where it says.

    Raises:
        RolloutError: `rollout.json` or `steps.csv` cannot be read.
    """
    config.set_experiment_name()
    tags = {names.METHOD_TAG: str(config.method_name), names.KIND_TAG: names.RECONSTRUCTION}
    name = f"{config.method_name} {config.experiment_name}"
    folders = tuple(rollout_folders(config))
    if not folders:
        return Facts(name, _settings(config), tags)
    metas = [read_meta(folder) for folder in folders]
    ids = [rollout_run.policy_run_id(folder, meta) for folder, meta in zip(folders, metas, strict=True)]
    policy_runs = tuple(dict.fromkeys(run_id for run_id in ids if run_id is not None))
    tags |= rollout_run.origin(metas[0]) | {
        names.ROLLOUT_TAG: _joined(folders),
        names.ROLLOUT_ID_TAG: _joined(map(rollout_run.rollout_id, folders)),
    }
    if policy_runs:
        tags[names.POLICY_RUN_TAG] = _joined(policy_runs)
    title = rollout_run.title(metas[0])
    if title is not None and len(folders) == 1 and config.experiment_name in (folders[0].stem, "unnamed"):
        # nerfstudio's own names: that of the folder, or none where the data is given to the dataparser.
        name = f"{config.method_name} {title}"
    # The figures of a rollout are those of all its frames and of no others.
    parser = getattr(config.pipeline.datamanager, "dataparser", None)
    usual = (("also", ()), ("every", 1), ("max_views", 0))
    whole = all(getattr(parser, option, value) == value for option, value in usual)
    params = _settings(config) | rollout_run.rollout_params(metas[0])
    figures = rollout_run.figures(metas[0], "eval" if whole else "rollout")
    return Facts(name, params, tags, figures, folders, policy_runs)


def rollout_folders(config: Any) -> list[Path]:
    """The rollouts that a training reads, whatever its dataparser; none when its data is something else."""
    manager = config.pipeline.datamanager
    parser = getattr(manager, "dataparser", None)
    data = manager.data or getattr(parser, "data", None)
    if data is None or data == Path():
        return []
    paths = [Path(path) for path in (data, *getattr(parser, "also", ()))]
    folders = [path.parent if path.is_file() else path for path in paths]
    return folders if all((folder / "rollout.json").is_file() for folder in folders) else []


def _settings(config: Any) -> dict[str, str]:
    """All settings by dotted name, without those that cannot change the result."""
    return {
        safe_name(key): str(value)
        for key, value in flat(dataclasses.asdict(config)).items()
        if not key.startswith(_NOT_SETTINGS) and not key.endswith("_target")
    }


def _joined(values: Iterable[object]) -> str:
    return ", ".join(map(str, values))[: names.MAX_TAG]


def open_run(
    address: str, facts: Facts, *, folder: Path, experiment: str | None = None, earlier: str | None = None
) -> TrackedRun:
    """The run of a training that begins: a new one, or that of the training it goes on with, unless that is finished.

    A new run is the child of its rollout's run, which is a child of the policy's run, in the experiment of these when
    no experiment is named: MLflow nests runs within one experiment only.

    Args:
        address: of the store.
        facts: of the training.
        folder: of the training, where the run's id is remembered.
        experiment: MLflow's, made when it does not exist.
        earlier: id of the run that is continued.

    Raises:
        RolloutError: a rollout cannot be read.
        TrackingError: the store cannot be used.
    """
    if earlier is not None and may_continue(address, earlier):
        run = continue_run(address, earlier)
        # Its origin and figures stay as they are; settings that are no longer the same are noted in a tag.
        run.params(facts.params)
        _remember(folder, run)
        return run
    return _new(address, facts, folder, experiment, {} if earlier is None else {names.CONTINUED_TAG: earlier})


def open_again(address: str, facts: Facts, *, folder: Path, experiment: str | None = None) -> tuple[TrackedRun, bool]:
    """The run of a training that ended, and whether it had one: a new run is made when it was not tracked.

    A run that it had keeps the status and the settings that it has. The arguments are those of `open_run`.

    Raises:
        RolloutError: a rollout cannot be read.
        TrackingError: the store cannot be used.
    """
    client, run_id = open_store(address), remembered_id(folder)
    run = _again(client, address, run_id) if run_id is not None else None
    return (run, True) if run is not None else (_new(address, facts, folder, experiment, {}), False)


def remembered_id(folder: Path) -> str | None:
    """The run id that a training's folder remembers; MLflow's, or one that was given offline."""
    path = folder / RUN_FILE
    return path.read_text(encoding="ascii").strip() if path.is_file() else None


def _remember(folder: Path, run: TrackedRun) -> None:
    path = folder / RUN_FILE
    try:
        path.write_text(run.run_id + "\n", encoding="ascii")
    except OSError as error:
        warnings.warn(f"{path}: a later log will make a new run, because this failed: {error}", stacklevel=4)


def _again(client: "MlflowClient | None", address: str, run_id: str) -> TrackedRun | None:
    """The run, which stays as ended as it is; None when it is not there."""
    if client is None:
        # Offline nobody can tell how it ended.
        with suppress(TrackingError):
            return continue_run(address, run_id)
        return None
    # What it could not send while it lasted comes first; if its program was killed, that closes it.
    left = journal_of(run_id)
    journal = None if left is None else Journal.adopt(left)
    if journal is not None:
        finish(journal)
    found = find_run(client, run_id)
    return None if found is None else join_run(address, found.info.run_id)


def _new(address: str, facts: Facts, folder: Path, experiment: str | None, tags: Mapping[str, str]) -> TrackedRun:
    """A run below that of the rollout, or else of the policy; without a client only what the rollouts say is known."""
    client = open_store(address)
    policy = facts.policy_runs[0] if len(facts.policy_runs) == 1 else None
    parent, above = policy, {}
    if client is not None:
        rollouts = [rollout_run.rollout_run(client, rollout, experiment=experiment) for rollout in facts.rollouts]
        found = {run_id: find_run(client, run_id) for run_id in facts.policy_runs}
        if rollouts:
            above[names.ROLLOUT_RUN_TAG] = _joined(rollouts)
        if found:
            ids = (run.info.run_id if run else given for given, run in found.items())
            above[names.POLICY_RUN_TAG] = _joined(ids)
        run_above = find_run(client, rollouts[0] if len(rollouts) == 1 else policy)
        parent = None if run_above is None else run_above.info.run_id
        if run_above is not None and experiment is None:
            experiment = client.get_experiment(run_above.info.experiment_id).name
    new = NewRun(experiment=experiment, name=facts.name, tags={**facts.tags, **above, **tags}, parent=parent)
    run = start_run(address, new)
    run.params(facts.params)
    run.metrics(facts.metrics, step=0)
    _remember(folder, run)
    return run


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


class Trackers:
    """The run and the recording of one training."""

    def __init__(self, config: Any, address: str | None, pipeline: Any) -> None:
        """Open what the options of an `AVPTrainerConfig` ask for; without an address there is no run.

        Raises:
            AVPError: the store or the recording cannot be used.
        """
        self._run: TrackedRun | None = None
        self._writer: ScalarWriter | None = None
        self._recording: Any = None
        if config.rerun is not None:
            from avp_nerfstudio.recording import ReconstructionRecording

            self._recording = ReconstructionRecording(config.rerun, pipeline)
        if address is None:
            return
        earlier = remembered_id(config.load_dir.parent) if config.load_dir is not None else None
        experiment, folder = config.mlflow_experiment, config.get_base_dir()
        self._run = run = open_run(address, facts_of(config), folder=folder, experiment=experiment, earlier=earlier)
        print(about_run(run.run_id, run.address, delivered=not run.run_id.startswith(names.OFFLINE)))
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
        """Take the numbers that nerfstudio still holds, keep the small files of the training's folder, end both."""
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
