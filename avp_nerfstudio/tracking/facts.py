"""What a reconstruction's MLflow run says of itself besides the course of the training: settings and origin."""

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from avp_habitat.provenance import flat
from avp_habitat.rollout.format import read_meta
from avp_habitat.tracking import names, rollout_run
from avp_habitat.tracking.names import safe_name

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
    """The facts of a training.

    Args:
        config: nerfstudio's `TrainerConfig`; its rollout, if it has one, is still where it says.

    Raises:
        RolloutError: `rollout.json` or `steps.csv` cannot be read.
    """
    config.set_experiment_name()
    tags = {names.METHOD_TAG: str(config.method_name), names.KIND_TAG: names.RECONSTRUCTION}
    name = f"{config.method_name} {config.experiment_name}"
    folders = tuple(rollout_folders(config))
    if not folders:
        return Facts(name, settings(config), tags)
    metas = [read_meta(folder) for folder in folders]
    ids = [rollout_run.policy_run_id(folder, meta) for folder, meta in zip(folders, metas, strict=True)]
    policy_runs = tuple(dict.fromkeys(run_id for run_id in ids if run_id is not None))
    tags |= rollout_run.origin(metas[0]) | {
        names.ROLLOUT_TAG: joined(folders),
        names.ROLLOUT_ID_TAG: joined(map(rollout_run.rollout_id, folders)),
    }
    if policy_runs:
        tags[names.POLICY_RUN_TAG] = joined(policy_runs)
    title = rollout_run.title(metas[0])
    if title is not None and len(folders) == 1 and config.experiment_name in (folders[0].stem, "unnamed"):
        # nerfstudio's own names: that of the folder, or none where the data is given to the dataparser.
        name = f"{config.method_name} {title}"
    # The figures of a rollout are those of all its frames and of no others.
    prefix = "eval" if _is_whole(config) else "rollout"
    return Facts(
        name,
        settings(config) | rollout_run.rollout_params(metas[0]),
        tags,
        rollout_run.figures(metas[0], prefix),
        folders,
        policy_runs,
    )


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


def settings(config: Any) -> dict[str, str]:
    """All settings of a configuration by dotted name, without those that cannot change the result."""
    leaves = flat(dataclasses.asdict(config))
    return {
        safe_name(key): str(value)
        for key, value in leaves.items()
        if not key.startswith(_NOT_SETTINGS) and not key.endswith("_target")
    }


def joined(values: Iterable[object]) -> str:
    """Several values as one tag."""
    return ", ".join(map(str, values))[: names.MAX_TAG]


def _is_whole(config: Any) -> bool:
    """Whether all frames of one rollout are trained with."""
    parser = getattr(config.pipeline.datamanager, "dataparser", None)
    usual = (("also", ()), ("every", 1), ("max_views", 0))
    return all(getattr(parser, option, value) == value for option, value in usual)
