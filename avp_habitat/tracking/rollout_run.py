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
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.provenance import flat
from avp_habitat.rollout.format import Rollout, read_rollout
from avp_habitat.tracking import names, stores
from avp_habitat.tracking.experiments import DEFAULT_HELP, chosen_experiment, experiment_id, find_run, search_tags
from avp_habitat.tracking.names import safe_name
from avp_habitat.tracking.view import run_colour

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

_IDENTITY = ("rollout.json", "steps.csv")
_ARTIFACTS = ("trajectory.png", *_IDENTITY)
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
    that trained the policy, in the experiment of that; or else in `experiments.chosen_experiment(experiment)`.

    Raises:
        RolloutError: the rollout cannot be read.
        TrackingError: the store cannot be reached or refuses.
    """
    from mlflow.exceptions import MlflowException

    rollout = read_rollout(folder)
    client = stores.connect(store) if isinstance(store, str) else store
    tags = _tags(rollout)
    same = {name: tags[name] for name in (names.ROLLOUT_ID_TAG, names.KIND_TAG)}
    try:
        # A handful of locks is enough, and leaves only a handful of files behind.
        with stores.locked(f"rollout-{tags[names.ROLLOUT_ID_TAG][0]}"):
            policy = find_run(client, policy_run_id(rollout.folder, rollout.meta))
            run = next(iter(search_tags(client, same)), None)
            if run is None:
                home = policy.info.experiment_id if policy else experiment_id(client, *chosen_experiment(experiment))
                named = title(rollout.meta)
                name = rollout.folder.resolve().name if named is None else f"{names.ROLLOUT} {named}"
                run = client.create_run(home, run_name=name, tags=tags)
            if run.info.status != "FINISHED":
                _fill(client, run, rollout)
            # A policy's run that was kept offline comes later. MLflow nests runs within one experiment only.
            if policy and policy.info.experiment_id == run.info.experiment_id and names.PARENT_TAG not in run.data.tags:
                for tag in (names.PARENT_TAG, names.POLICY_RUN_TAG):
                    client.set_tag(run.info.run_id, tag, policy.info.run_id)
    except (MlflowException, OSError, ValueError) as error:
        there = stores.shown(client.tracking_uri)
        text = f"MLflow at {there} did not take the rollout {rollout.folder}: {stores.first_line(error)}"
        raise stores.TrackingError(text) from error
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
            raise RolloutError(f"{folder / name}: expected this file of the rollout: {error.strerror}") from None
    return digest.hexdigest()


def origin(meta: Mapping[str, Any]) -> dict[str, str]:
    """Tags by `rollout.json` that name scene, simulator and policy as those of the policy's training do."""
    leaves = flat({key: meta[key] for key in ("scene", "policy", "simulator") if isinstance(meta.get(key), Mapping)})
    tags = {tag: str(leaves[key]) for tag, key in _ORIGIN.items() if leaves.get(key) is not None}
    # One colour per policy on all of the experiment's pages.
    return tags | ({names.COLOUR_TAG: run_colour(tags[names.POLICY_TAG])} if tags.get(names.POLICY_TAG) else {})


def title(meta: Mapping[str, Any]) -> str | None:
    """Policy, scene and seed by `rollout.json`, also the reward of a model; None where a rollout has no names."""
    policy, scene = (origin(meta).get(name) for name in (names.POLICY_TAG, names.SCENE_TAG))
    if policy is None or scene is None:
        return None
    reward, seed = meta.get("reward") if policy.endswith(".zip") else None, meta.get("seed")
    words = [policy, reward, scene, None if seed is None else f"seed {seed}"]
    return " ".join(str(word) for word in words if word is not None)


def rollout_params(meta: Mapping[str, Any]) -> dict[str, str]:
    """`rollout.seed`, `rollout.budget`, ...: what a rollout was collected with by its `rollout.json`."""
    leaves = flat({key: meta[key] for key in _SETTINGS if key in meta})
    return {safe_name(f"rollout.{key}"): str(value) for key, value in leaves.items()}


def figures(meta: Mapping[str, Any], prefix: str = "eval") -> dict[str, float]:
    """`eval/coverage`, `eval/views`, ... by a checked `rollout.json`, as the policy's evaluation names them."""
    found = {name: float(value) for name, value in meta.get("metrics", {}).items()}
    if found.get("views") and "coverage" in found:
        # It is written in no rollout, because it follows from two others.
        found.setdefault("cpv", 100 * found["coverage"] / found["views"])
    return {safe_name(f"{prefix}/{name}"): value for name, value in found.items()}


def policy_run_id(folder: Path, meta: Mapping[str, Any]) -> str | None:
    """MLflow run in which a rollout's policy was trained; None for a baseline. A `RolloutError` where it is no text."""
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
    tags |= {names.ROLLOUT_ID_TAG: rollout_id(rollout.folder)}
    tags |= {names.POLICY_RUN_TAG: policy} if (policy := policy_run_id(rollout.folder, rollout.meta)) else {}
    return {name: str(value)[: names.MAX_TAG] for name, value in tags.items()}


def _fill(client: "MlflowClient", run: "Run", rollout: Rollout) -> None:
    """Log what a run does not have already because a program was killed; end it."""
    from mlflow.entities import Metric, Param

    run_id, has, at = run.info.run_id, run.data, run.info.start_time
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


def command_for(folder: Path, option: str, experiment: str | None = None) -> str:
    """The command line that logs a rollout; `option` is `auto`, or an address whose password is not repeated."""
    words = ["python", "-m", "avp_habitat.tracking.rollout_run", str(folder)]
    words += [] if option == "auto" else ["--mlflow", stores.shown(option)]
    return shlex.join(words if experiment is None else [*words, "--experiment", experiment])


@dataclass(frozen=True)
class LogRollouts:
    """Log rollouts to MLflow, each as a run below the run that trained its policy.

    A rollout that is there already, also from a copy of its folder, is left as it is.
    """

    rollouts: Positional[tuple[Path, ...]]
    """Folders of rollouts, or their rollout.json."""
    mlflow: Annotated[str, arg(help=stores.ADDRESS_HELP)] = "auto"
    experiment: Annotated[str | None, arg(help=f"Of rollouts without a policy's run (omitted: {DEFAULT_HELP})")] = None

    def __post_init__(self) -> None:
        """Refuse what is no place, and no rollouts."""
        if not self.rollouts:
            raise UsageError("expected at least one rollout; --help shows all options")
        if self.mlflow == "off":
            raise UsageError("mlflow: expected an address or auto, got off: logging is all that this command does")


def main(options: LogRollouts) -> None:
    """Log rollouts; print their runs."""
    address = str(stores.address_of(options.mlflow, default=stores.DEFAULT_ADDRESS))
    client = stores.connect(address)
    for folder in options.rollouts:
        print(f"{folder}: MLflow run {rollout_run(client, folder, experiment=options.experiment)}")
    print(f"look at it: {stores.how_to_look(address)}")


if __name__ == "__main__":
    sys.exit(command.run(main))
