"""`python -m avp_habitat.tracking.rollout_run`: rollouts as MLflow runs, each below the run that trained its policy."""

import hashlib
import os
import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from avp_habitat import command
from avp_habitat.errors import AVPError, RolloutError, UsageError
from avp_habitat.provenance import flat
from avp_habitat.rollout.format import Rollout, read_rollout
from avp_habitat.tracking import names
from avp_habitat.tracking.experiments import DEFAULT_HELP, chosen_experiment, experiment_id, find_run, search_tags
from avp_habitat.tracking.names import safe_name
from avp_habitat.tracking.stores import (
    ADDRESS_HELP,
    DEFAULT_ADDRESS,
    TrackingError,
    address_of,
    connect,
    first_line,
    how_to_look,
    locked,
    shown,
)
from avp_habitat.tracking.view import run_colour

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

_ARTIFACTS = ("trajectory.png", "rollout.json", "steps.csv")
_IDENTITY = ("rollout.json", "steps.csv")
_SETTINGS = ("policy", "seed", "reward", "budget", "counts", "heldout", "created")
_ORIGIN = {
    names.SCENE_TAG: "scene.name",
    names.DIGEST_TAG: "scene.sha256",
    names.POLICY_TAG: "policy.name",
    names.SIMULATOR_TAG: "simulator.name",
}


def rollout_run(store: "MlflowClient | str", folder: str | Path, *, experiment: str | None = None) -> str:
    """The id of the MLflow run of a rollout, which is made when the store has none.

    A rollout is recognised by its contents (`rollout_id`), wherever its folder lies. Its run is a child of the run
    that trained the policy, in the experiment of that; or else in that of `experiments.chosen_experiment`.

    Args:
        store: its client, or its address.
        folder: of the rollout, or its `rollout.json`.
        experiment: of a rollout whose policy's run the store does not have.

    Raises:
        RolloutError: the rollout cannot be read.
        TrackingError: the store cannot be reached or refuses.
    """
    rollout = read_rollout(folder)
    client = connect(store) if isinstance(store, str) else store
    try:
        tags = _tags(rollout)
        # A handful of locks is enough, and leaves only a handful of files behind.
        with locked(f"rollout-{tags[names.ROLLOUT_ID_TAG][0]}"):
            policy = find_run(client, tags.get(names.POLICY_RUN_TAG))
            run = _found(client, tags)
            if run is None:
                run = _made(client, rollout, tags, policy, experiment)
            elif run.info.status != "FINISHED":
                _fill(client, run, rollout)
            _tie(client, run, tags, policy)
    except AVPError:
        raise
    except Exception as error:
        there = shown(client.tracking_uri)
        text = f"MLflow at {there} did not take the rollout {rollout.folder}: {first_line(error)}"
        raise TrackingError(text) from error
    return run.info.run_id


def rollout_id(folder: Path) -> str:
    """What a rollout is recognised by wherever its folder lies: SHA-256 of `rollout.json` and `steps.csv`, hex.

    Raises:
        RolloutError: one of them cannot be read.
    """
    digest = hashlib.sha256()
    for name in _IDENTITY:
        try:
            # Each with its own digest, so that nothing can move from one file to the other unseen.
            digest.update(hashlib.sha256((folder / name).read_bytes()).digest())
        except OSError as error:
            found = "found none" if isinstance(error, FileNotFoundError) else error.strerror
            raise RolloutError(f"{folder / name}: expected this file of the rollout, {found}") from None
    return digest.hexdigest()


def origin(meta: Mapping[str, Any]) -> dict[str, str]:
    """Tags by `rollout.json` that name scene, simulator and policy as those of the policy's training do."""
    leaves = flat({key: meta[key] for key in ("scene", "policy", "simulator") if isinstance(meta.get(key), Mapping)})
    tags = {tag: str(leaves[key]) for tag, key in _ORIGIN.items() if leaves.get(key) is not None}
    # One colour per policy on all of the experiment's pages.
    return tags | ({names.COLOUR_TAG: run_colour(tags[names.POLICY_TAG])} if tags.get(names.POLICY_TAG) else {})


def title(meta: Mapping[str, Any]) -> str | None:
    """Policy, scene and seed by `rollout.json`, also the reward of a model; None where a rollout has no names."""
    named = origin(meta)
    if not {names.POLICY_TAG, names.SCENE_TAG} <= named.keys():
        return None
    policy, seed = named[names.POLICY_TAG], meta.get("seed")
    reward = meta.get("reward") if policy.endswith(".zip") else None
    words = [policy, reward, named[names.SCENE_TAG], None if seed is None else f"seed {seed}"]
    return " ".join(str(word) for word in words if word is not None)


def rollout_params(meta: Mapping[str, Any]) -> dict[str, str]:
    """`rollout.seed`, `rollout.budget`, ...: what a rollout was collected with by its `rollout.json`."""
    leaves = flat({key: meta[key] for key in _SETTINGS if key in meta})
    return {safe_name(f"rollout.{key}"): str(value) for key, value in leaves.items()}


def figures(meta: Mapping[str, Any], prefix: str = "eval") -> dict[str, float]:
    """`eval/coverage`, `eval/views`, ... by a checked `rollout.json`, as the policy's evaluation names them."""
    found = {name: float(value) for name, value in meta.get("metrics", {}).items()}
    if found.get("views") and "coverage" in found:
        # One number of the policy's evaluation is written in no rollout, because it follows from two others.
        found.setdefault("cpv", 100 * found["coverage"] / found["views"])
    return {safe_name(f"{prefix}/{name}"): value for name, value in found.items()}


def policy_run_id(folder: Path, meta: Mapping[str, Any]) -> str | None:
    """MLflow run in which the policy of a rollout's `rollout.json` was trained; None for a baseline.

    Raises:
        RolloutError: what stands there cannot be the id of a run.
    """
    value = meta.get("mlflow_run_id")
    if value is not None and not isinstance(value, str):
        raise RolloutError(f"{folder / 'rollout.json'}: expected mlflow_run_id to be a text or null, found {value!r}")
    return value or None


def _tags(rollout: Rollout) -> dict[str, str]:
    """Versions are those of the programs that collected it, which need not be the ones of this process."""
    from mlflow.tracking.context.registry import resolve_tags

    tags = {name: value for name, value in resolve_tags().items() if not name.startswith("version.")}
    tags |= flat({"version": rollout.meta.get("versions", {})}) | origin(rollout.meta)
    tags |= {names.KIND_TAG: names.ROLLOUT, names.ROLLOUT_TAG: str(rollout.folder)}
    tags[names.ROLLOUT_ID_TAG] = rollout_id(rollout.folder)
    if (policy_run := policy_run_id(rollout.folder, rollout.meta)) is not None:
        tags[names.POLICY_RUN_TAG] = policy_run
    return {name: str(value)[: names.MAX_TAG] for name, value in tags.items()}


def _found(client: "MlflowClient", tags: Mapping[str, str]) -> "Run | None":
    """The rollout's run; the oldest, should there be several."""
    found = search_tags(client, {name: tags[name] for name in (names.ROLLOUT_ID_TAG, names.KIND_TAG)})
    return min(found, key=lambda run: (run.info.start_time, run.info.run_id), default=None)


def _made(
    client: "MlflowClient", rollout: Rollout, tags: dict[str, str], policy: "Run | None", experiment: str | None
) -> "Run":
    home = policy.info.experiment_id if policy else experiment_id(client, *chosen_experiment(experiment))
    named = title(rollout.meta)
    name = rollout.folder.resolve().name if named is None else f"{names.ROLLOUT} {named}"
    ours = client.create_run(home, run_name=name, tags=tags)
    _fill(client, ours, rollout)
    # A program on another machine may have made it meanwhile, too.
    first = _found(client, tags) or ours
    if first.info.run_id != ours.info.run_id:
        client.delete_run(ours.info.run_id)
    return first


def _fill(client: "MlflowClient", run: "Run", rollout: Rollout) -> None:
    """Log what a run does not have already because somebody was killed; end it."""
    from mlflow.entities import Metric, Param

    run_id, has = run.info.run_id, client.get_run(run.info.run_id).data
    # With one time for whoever fills it, a database takes the same figure twice for the same point.
    at = run.info.start_time
    metrics, params = figures(rollout.meta), rollout_params(rollout.meta)
    client.log_batch(
        run_id,
        metrics=[Metric(name, value, at, 0) for name, value in metrics.items() if name not in has.metrics],
        params=[Param(name, value[: names.MAX_PARAM]) for name, value in params.items() if name not in has.params],
    )
    for name in _ARTIFACTS:
        if (rollout.folder / name).is_file():
            client.log_artifact(run_id, os.fspath(rollout.folder / name))
    client.set_terminated(run_id, "FINISHED")


def _tie(client: "MlflowClient", run: "Run", tags: Mapping[str, str], policy: "Run | None") -> None:
    """Tie a run to parent and children that came to the store later than it, as runs that were kept offline do."""
    run_id, home, above = run.info.run_id, run.info.experiment_id, set()
    if policy is not None:
        above = {policy.info.run_id, tags[names.POLICY_RUN_TAG]}
        _replace(client, run, {names.POLICY_RUN_TAG: policy.info.run_id}, above)
        if policy.info.experiment_id == home:
            _replace(client, run, {names.PARENT_TAG: policy.info.run_id}, set())
    identity = {names.ROLLOUT_ID_TAG: tags[names.ROLLOUT_ID_TAG], names.KIND_TAG: names.RECONSTRUCTION}
    for child in search_tags(client, identity, home):
        _replace(client, child, {names.PARENT_TAG: run_id, names.ROLLOUT_RUN_TAG: run_id}, above)


def _replace(client: "MlflowClient", run: "Run", tags: dict[str, str], old: set[str]) -> None:
    """Set tags that are missing or have one of the old values; others, which people may have set, stay."""
    for name, value in tags.items():
        present = run.data.tags.get(name)
        if present != value and (present is None or present in old):
            client.set_tag(run.info.run_id, name, value)


def command_for(folder: Path, option: str, experiment: str | None = None) -> str:
    """The command line that logs a rollout; `option` is `auto`, or an address whose password is not repeated."""
    words = ["python", "-m", "avp_habitat.tracking.rollout_run", str(folder)]
    words += [] if option == "auto" else ["--mlflow", shown(option)]
    return shlex.join(words if experiment is None else [*words, "--experiment", experiment])


@dataclass(frozen=True)
class LogRollouts:
    """Log rollouts to MLflow, each as a run below the run that trained its policy.

    A rollout that is there already, also from a copy of its folder, is left as it is.
    """

    rollouts: Positional[tuple[Path, ...]]
    """Folders of rollouts, or their rollout.json."""
    mlflow: Annotated[str, arg(help=ADDRESS_HELP)] = "auto"
    experiment: Annotated[
        str | None, arg(help=f"MLflow's, of rollouts whose policy's run is not there (omitted: {DEFAULT_HELP})")
    ] = None

    def __post_init__(self) -> None:
        """Refuse what is no place, and no rollouts."""
        if not self.rollouts:
            raise UsageError("expected at least one rollout; --help shows all options")
        if self.mlflow == "off":
            raise UsageError("mlflow: expected an address or auto, got off: logging is all that this command does")


def main(options: LogRollouts) -> None:
    """Log rollouts; print their runs."""
    address = str(address_of(options.mlflow, default=DEFAULT_ADDRESS))
    client = connect(address)
    for folder in options.rollouts:
        print(f"{folder}: MLflow run {rollout_run(client, folder, experiment=options.experiment)}")
    print(f"look at it: {how_to_look(address)}")


if __name__ == "__main__":
    sys.exit(command.run(main))
