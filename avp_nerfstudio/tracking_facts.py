"""What a reconstruction's MLflow run says of itself besides the course of the training: settings, origin, versions."""

import dataclasses
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from avp_habitat.provenance import flat, git_commit
from avp_habitat.rollout import read_meta
from avp_habitat.versions import installed_versions

PACKAGES = ("avp-suite", "nerfstudio", "torch", "torchvision", "torchmetrics", "numpy", "mlflow")
_BRACKETS, _UNSAFE = re.compile(r"[()\[\]{}]"), re.compile(r"[^\w.\- /]")
_MAX_NAME, _MAX_PARAM, _MAX_TAG = 250, 6000, 5000
# Of no meaning for the result; `mlflow` is an address, which may hold a password.
_NOT_SETTINGS = ("viewer.", "mlflow", "rerun", "logging.local_writer.", "load_config")


@dataclass(frozen=True)
class Facts:
    """What is known of a reconstruction without looking at its course."""

    name: str
    """Of the run."""
    params: dict[str, str]
    """The settings, flat."""
    tags: dict[str, str]
    """Versions, commit, scene, policy."""
    metrics: dict[str, float] = field(default_factory=dict)
    """The figures of the rollout it was made from: `eval/...`, or `rollout/...` when it is not the whole of one."""
    policy_run: str | None = None
    """MLflow run in which the rollout's policy was trained; None for none or several."""


def facts_of(config: Any) -> Facts:
    """The facts of a training.

    Args:
        config: nerfstudio's `TrainerConfig`; its rollout, if it has one, is still where it says.

    Raises:
        RolloutError: `rollout.json` cannot be read.
    """
    config.set_experiment_name()
    tags = {f"version.{name}": version for name, version in installed_versions(PACKAGES).items()}
    tags["avp.method"] = str(config.method_name)
    if (commit := git_commit()) is not None:
        tags["mlflow.source.git.commit"] = commit
    name = f"{config.method_name} {config.experiment_name}"
    folders = rollout_folders(config)
    if not folders:
        return Facts(name, settings(config), tags)
    metas = [read_meta(folder) for folder in folders]
    policy_runs = {meta["mlflow_run_id"]: None for meta in metas if meta.get("mlflow_run_id")}
    tags |= {"avp.rollout": _joined(folders), **_origin(metas[0])}
    if policy_runs:
        tags["avp.policy_run"] = _joined(policy_runs)
    # The figures of a rollout are those of all its frames and of no others.
    prefix = "eval" if _is_whole(config) else "rollout"
    return Facts(
        name,
        settings(config) | _rollout_params(metas[0]),
        tags,
        _figures(metas[0], prefix),
        next(iter(policy_runs)) if len(policy_runs) == 1 else None,
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
        safe_name(key): str(value)[:_MAX_PARAM]
        for key, value in leaves.items()
        if not key.startswith(_NOT_SETTINGS) and not key.endswith("_target")
    }


def safe_name(name: str) -> str:
    """A name that MLflow takes: nerfstudio's brackets go, other unusual characters become `_`."""
    parts = _UNSAFE.sub("_", _BRACKETS.sub("", name)).split("/")
    return "/".join(part for part in parts if part not in ("", ".", ".."))[:_MAX_NAME] or "_"


def _origin(meta: Mapping[str, Any]) -> dict[str, str]:
    """Tags of a rollout, named as those of the policy's training are."""
    leaves = flat({key: meta[key] for key in ("scene", "policy", "simulator") if isinstance(meta.get(key), Mapping)})
    named = {
        "avp.scene": leaves.get("scene.name"),
        "avp.scene_digest": leaves.get("scene.sha256"),
        "avp.policy": leaves.get("policy.name"),
        "avp.simulator": leaves.get("simulator.name"),
    }
    return {key: str(value)[:_MAX_TAG] for key, value in named.items() if value is not None}


def _is_whole(config: Any) -> bool:
    """Whether all frames of one rollout are trained with."""
    parser = getattr(config.pipeline.datamanager, "dataparser", None)
    usual = (("also", ()), ("every", 1), ("max_views", 0))
    return all(getattr(parser, option, value) == value for option, value in usual)


def _joined(values: Iterable[object]) -> str:
    return ", ".join(map(str, values))[:_MAX_TAG]


def _rollout_params(meta: Mapping[str, Any]) -> dict[str, str]:
    chosen = ("policy", "seed", "reward", "budget", "counts", "heldout", "created")
    leaves = flat({key: meta[key] for key in chosen if key in meta})
    return {safe_name(f"rollout.{key}"): str(value)[:_MAX_PARAM] for key, value in leaves.items()}


def _figures(meta: Mapping[str, Any], prefix: str) -> dict[str, float]:
    """`eval/coverage`, `eval/views`, ...: the names under which the policy's evaluation logs them."""
    metrics = meta.get("metrics")
    if not isinstance(metrics, Mapping):
        return {}
    return {
        safe_name(f"{prefix}/{name}"): float(value)
        for name, value in metrics.items()
        if isinstance(value, (int, float)) and math.isfinite(value)
    }
