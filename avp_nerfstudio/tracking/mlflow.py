"""A reconstruction as an MLflow run: which run it is, and whose child."""

import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from avp_habitat.tracking.deliver import finish
from avp_habitat.tracking.experiments import find_run
from avp_habitat.tracking.journal import Journal, journal_of
from avp_habitat.tracking.names import CONTINUED_TAG, POLICY_RUN_TAG, ROLLOUT_RUN_TAG
from avp_habitat.tracking.rollout_run import rollout_run
from avp_habitat.tracking.run import NewRun, TrackedRun, continue_run, join_run, may_continue, start_run
from avp_habitat.tracking.stores import TrackingError, open_store
from avp_nerfstudio.tracking.facts import Facts, joined

if TYPE_CHECKING:
    from mlflow import MlflowClient

RUN_FILE = "mlflow_run_id.txt"
"""In a training's folder: the id of its run."""


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
        experiment: MLflow's, made when it does not exist; when neither named nor given by the runs above,
            as `experiments.chosen_experiment` says.
        earlier: id of the run that is continued.

    Raises:
        RolloutError: a rollout cannot be read.
        TrackingError: the store cannot be used.
    """
    if earlier is not None and may_continue(address, earlier):
        run = continue_run(address, earlier)
        # Its origin and figures stay as they are; settings that are no longer the same are noted in a tag.
        run.params(facts.params)
    else:
        run = _new(address, facts, experiment, {} if earlier is None else {CONTINUED_TAG: earlier})
    _remember(folder, run)
    return run


def open_again(address: str, facts: Facts, *, folder: Path, experiment: str | None = None) -> tuple[TrackedRun, bool]:
    """The run of a training that ended, and whether it had one: a new run is made when it was not tracked.

    A run that it had keeps the status and the settings that it has.

    Args:
        address: of the store.
        facts: of the training.
        folder: of the training.
        experiment: of a new run.

    Raises:
        RolloutError: a rollout cannot be read.
        TrackingError: the store cannot be used.
    """
    client, run_id = open_store(address), remembered_id(folder)
    run = _again(client, address, run_id) if run_id is not None else None
    if run is not None:
        return run, True
    run = _new(address, facts, experiment, {})
    _remember(folder, run)
    return run, False


def remembered_id(folder: Path) -> str | None:
    """The run id that a training's folder remembers; MLflow's, or one that was given offline."""
    try:
        return (folder / RUN_FILE).read_text(encoding="ascii").strip() or None
    except (OSError, UnicodeDecodeError):
        return None


def _remember(folder: Path, run: TrackedRun) -> None:
    path = folder / RUN_FILE
    try:
        path.write_text(run.run_id + "\n", encoding="ascii")
    except OSError as error:
        warnings.warn(f"{path}: a later log will make a new run, because this failed: {error}", stacklevel=3)


def _again(client: "MlflowClient | None", address: str, run_id: str) -> TrackedRun | None:
    """The run, which stays as ended as it is; None when it is not there."""
    if client is None:
        # Offline nobody can tell how it ended.
        with suppress(TrackingError):
            return continue_run(address, run_id)
        return None
    _deliver_left(run_id)
    found = find_run(client, run_id)
    return None if found is None else join_run(address, found.info.run_id)


def _deliver_left(run_id: str) -> None:
    """Send what a run could not send while it lasted, and close it if its program was killed."""
    folder = journal_of(run_id)
    journal = None if folder is None else Journal.adopt(folder)
    if journal is not None:
        finish(journal)


def _new(address: str, facts: Facts, experiment: str | None, tags: Mapping[str, str]) -> TrackedRun:
    above = _Above(open_store(address), facts, experiment)
    new = NewRun(
        experiment=above.experiment, name=facts.name, tags={**facts.tags, **above.tags, **tags}, parent=above.parent
    )
    run = start_run(address, new)
    run.params(facts.params)
    run.metrics(facts.metrics, step=0)
    return run


class _Above:
    """The runs above a new one: rollout, or else policy."""

    def __init__(self, client: "MlflowClient | None", facts: Facts, experiment: str | None) -> None:
        """Find them, and make those of the rollouts; without a client only what the rollouts say is known."""
        policy = facts.policy_runs[0] if len(facts.policy_runs) == 1 else None
        self.tags: dict[str, str] = {}
        self.parent = policy
        self.experiment = experiment
        if client is None:
            return
        rollouts = [rollout_run(client, folder, experiment=experiment) for folder in facts.rollouts]
        found = {run_id: find_run(client, run_id) for run_id in facts.policy_runs}
        if rollouts:
            self.tags[ROLLOUT_RUN_TAG] = joined(rollouts)
        if found:
            self.tags[POLICY_RUN_TAG] = joined(run.info.run_id if run else given for given, run in found.items())
        parent = find_run(client, rollouts[0] if len(rollouts) == 1 else policy)
        self.parent = None if parent is None else parent.info.run_id
        if parent is not None and experiment is None:
            self.experiment = client.get_experiment(parent.info.experiment_id).name
