"""`python -m avp_habitat.tracking.rollout_run`: rollouts as MLflow runs, each below the run that trained its policy."""

import argparse
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.rollout.format import read_rollout
from avp_habitat.tracking import rollout_facts as facts
from avp_habitat.tracking.experiments import DEFAULT_HELP, experiment_id, meant
from avp_habitat.tracking.journal import alone
from avp_habitat.tracking.names import PARENT_TAG, find_run
from avp_habitat.tracking.stores import (
    DEFAULT_ADDRESS,
    TrackingError,
    address_of,
    connect,
    first_line,
    how_to_look,
    shown,
    unreachable,
)

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

_ARTIFACTS = ("trajectory.png", "rollout.json", "steps.csv")
_MAX_PARAM, _MAX_TAG = 6000, 5000


def rollout_run(store: "MlflowClient | str", folder: str | Path, *, experiment: str | None = None) -> str:
    """The MLflow run of a rollout, which is made when the store has none.

    A rollout is recognised by its contents (`rollout_facts.rollout_id`), wherever its folder lies. Its run is a child
    of the run that trained the policy, in the experiment of that, when the store has it.

    Args:
        store: its client, or its address.
        folder: of the rollout, or its `rollout.json`.
        experiment: of a rollout whose policy's run the store does not have; as `experiments.meant` says when omitted.

    Returns:
        The run's id.

    Raises:
        RolloutError: the rollout cannot be read.
        TrackingError: the store cannot be reached or refuses.
    """
    rollout = _read(Path(folder))
    client = connect(store) if isinstance(store, str) else store
    try:
        # A handful of locks is enough, and leaves only a handful of files behind.
        with alone(f"rollout-{rollout.identity[0]}"):
            policy = find_run(client, rollout.policy_run)
            run = _found(client, rollout)
            if run is None:
                run = _made(client, rollout, policy, experiment)
            elif run.info.status != "FINISHED":
                _fill(client, run.info.run_id, rollout)
            _join_family(client, run, rollout, policy)
    except AVPError:
        raise
    except Exception as error:
        raise TrackingError(
            f"MLflow at {shown(client.tracking_uri)} did not take the rollout {rollout.folder}: {first_line(error)}"
        ) from error
    return run.info.run_id


@dataclass(frozen=True)
class _Rollout:
    """What is told of a rollout."""

    folder: Path
    """Where it is."""
    meta: dict[str, Any]
    """Its `rollout.json`."""
    identity: str
    """Its id."""
    policy_run: str | None
    """As it is written there."""

    @property
    def name(self) -> str:
        """Of the run."""
        title = facts.title(self.meta)
        return self.folder.resolve().name if title is None else f"{facts.ROLLOUT} {title}"

    def tags(self) -> dict[str, str]:
        """Versions are those of the programs that collected it, which need not be the ones of this process."""
        from mlflow.tracking.context.registry import resolve_tags

        tags = {name: value for name, value in resolve_tags().items() if not name.startswith("version.")}
        versions = self.meta.get("versions")
        if isinstance(versions, dict):
            tags |= {f"version.{name}": str(version) for name, version in versions.items()}
        tags |= facts.origin(self.meta) | {
            facts.KIND_TAG: facts.ROLLOUT,
            facts.ROLLOUT_ID_TAG: self.identity,
            facts.ROLLOUT_TAG: str(self.folder),
        }
        if self.policy_run is not None:
            tags[facts.POLICY_RUN_TAG] = self.policy_run
        return {name: value[:_MAX_TAG] for name, value in tags.items()}


def _read(folder: Path) -> _Rollout:
    rollout = read_rollout(folder)
    folder, meta = rollout.folder, rollout.meta
    return _Rollout(folder, meta, facts.rollout_id(folder), facts.policy_run_id(folder, meta))


def _found(client: "MlflowClient", rollout: _Rollout) -> "Run | None":
    """The rollout's run; the oldest, should there be several."""
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    query = f"tags.`{facts.ROLLOUT_ID_TAG}` = '{rollout.identity}' AND tags.`{facts.KIND_TAG}` = '{facts.ROLLOUT}'"
    found = client.search_runs(experiments, query)
    return min(found, key=lambda run: (run.info.start_time, run.info.run_id), default=None)


def _made(client: "MlflowClient", rollout: _Rollout, policy: "Run | None", experiment: str | None) -> "Run":
    if policy is not None:
        identity = policy.info.experiment_id
    else:
        identity, _ = experiment_id(client, *meant(experiment))
    ours = client.create_run(identity, run_name=rollout.name, tags=rollout.tags())
    _fill(client, ours.info.run_id, rollout)
    # MLflow cannot make a run only if there is none: a program on another machine may have made it meanwhile, too.
    first = _found(client, rollout) or ours
    if first.info.run_id != ours.info.run_id:
        client.delete_run(ours.info.run_id)
    return first


def _fill(client: "MlflowClient", run_id: str, rollout: _Rollout) -> None:
    """Figures, settings and files, and the end."""
    from mlflow.exceptions import MlflowException

    try:
        _log_facts(client, run_id, rollout)
    except MlflowException:
        if unreachable(client.tracking_uri):
            raise
        # MLflow refuses what somebody else tells it in the same moment; by now it has that.
        _log_facts(client, run_id, rollout)
    for name in _ARTIFACTS:
        if (rollout.folder / name).is_file():
            client.log_artifact(run_id, os.fspath(rollout.folder / name))
    client.set_terminated(run_id, "FINISHED")


def _log_facts(client: "MlflowClient", run_id: str, rollout: _Rollout) -> None:
    """What the run does not have already because somebody was killed."""
    from mlflow.entities import Metric, Param

    run = client.get_run(run_id)
    # With one time for whoever fills it, a database takes the same figure twice for the same point.
    at = run.info.start_time
    figures = facts.figures(rollout.meta)
    params = facts.rollout_params(rollout.meta)
    client.log_batch(
        run_id,
        metrics=[Metric(name, value, at, 0) for name, value in figures.items() if name not in run.data.metrics],
        params=[Param(name, value[:_MAX_PARAM]) for name, value in params.items() if name not in run.data.params],
    )


def _join_family(client: "MlflowClient", run: "Run", rollout: _Rollout, policy: "Run | None") -> None:
    """Tie a run to parent and children that came to the store later than it, as runs that were kept offline do."""
    run_id, home, above = run.info.run_id, run.info.experiment_id, set()
    if policy is not None:
        above = {policy.info.run_id, rollout.policy_run}
        _replace(client, run, {facts.POLICY_RUN_TAG: policy.info.run_id}, above)
        if policy.info.experiment_id == home:
            _replace(client, run, {PARENT_TAG: policy.info.run_id}, set())
    query = (
        f"tags.`{facts.ROLLOUT_ID_TAG}` = '{rollout.identity}' AND tags.`{facts.KIND_TAG}` = '{facts.RECONSTRUCTION}'"
    )
    for child in client.search_runs([home], query):
        _replace(client, child, {PARENT_TAG: run_id, facts.ROLLOUT_RUN_TAG: run_id}, above)


def _replace(client: "MlflowClient", run: "Run", tags: dict[str, str], old: set[str | None]) -> None:
    """Set tags that are missing or have one of the old values; others, which people may have set, stay."""
    for name, value in tags.items():
        present = run.data.tags.get(name)
        if present != value and (present is None or present in old):
            client.set_tag(run.info.run_id, name, value)


def command_for(folder: Path, option: str, experiment: str | None = None) -> str:
    """The command line that logs a rollout.

    Args:
        folder: of the rollout.
        option: `auto`, or an address; its password is not repeated.
        experiment: as in `rollout_run`.
    """
    words = ["python", "-m", "avp_habitat.tracking.rollout_run", str(folder)]
    words += [] if option == "auto" else ["--mlflow", shown(option)]
    return shlex.join(words if experiment is None else [*words, "--experiment", experiment])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m avp_habitat.tracking.rollout_run",
        description="Log rollouts to MLflow, each as a run below the run that trained its policy. A rollout that "
        "is there already, also from a copy of its folder, is left as it is.",
    )
    add = parser.add_argument
    add("rollouts", type=Path, nargs="+", metavar="ROLLOUT", help="the folder of a rollout, or its rollout.json")
    add(
        "--mlflow",
        default="auto",
        metavar="ADDRESS",
        help=f"an MLflow address such as {DEFAULT_ADDRESS}; auto: MLFLOW_TRACKING_URI, or else {DEFAULT_ADDRESS} "
        "(default: %(default)s)",
    )
    add(
        "--experiment",
        metavar="NAME",
        help=f"MLflow experiment of rollouts whose policy's run is not there (default: {DEFAULT_HELP})",
    )
    return parser


def main(argv: Sequence[str]) -> None:
    """Log rollouts; print their runs."""
    options = _parser().parse_args(argv)
    address = address_of(options.mlflow, default=DEFAULT_ADDRESS)
    if address is None:
        raise UsageError("--mlflow off: expected an address or auto, because logging is all that this command does")
    client = connect(address)
    for folder in options.rollouts:
        print(f"{folder}: MLflow run {rollout_run(client, folder, experiment=options.experiment)}")
    print(f"look at it: {how_to_look(address)}")


if __name__ == "__main__":
    sys.exit(command.run(main))
