"""What a reconstruction's MLflow run says of itself besides the course of the training: settings, origin, versions."""

import dataclasses
import math
import re
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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
    """`eval/...`: the figures of the rollout it was made from."""
    policy_run: str | None = None
    """MLflow run in which the rollout's policy was trained."""


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
    folder = rollout_folder(config)
    if folder is None:
        return Facts(name, settings(config), tags)
    meta = read_meta(folder)
    tags |= {"avp.rollout": str(folder)} | _origin(meta)
    policy_run = meta.get("mlflow_run_id")
    return Facts(name, settings(config) | _rollout_params(meta), tags, _figures(meta), policy_run)


def rollout_folder(config: Any) -> Path | None:
    """The rollout that a training reads, whatever its dataparser; None when its data is something else."""
    manager = config.pipeline.datamanager
    data = manager.data or getattr(getattr(manager, "dataparser", None), "data", None)
    if data is None or data == Path():
        return None
    folder = Path(data).parent if Path(data).is_file() else Path(data)
    return folder if (folder / "rollout.json").is_file() else None


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


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, keys joined by dots."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves |= flat(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = value
    return leaves


def git_commit() -> str | None:
    """The commit checked out in the current folder; None outside a repository or without git."""
    command = ["git", "rev-parse", "HEAD"]
    try:
        answer = subprocess.run(
            command, capture_output=True, text=True, timeout=10, check=True, stdin=subprocess.DEVNULL
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def _origin(meta: Mapping[str, Any]) -> dict[str, str]:
    """Tags of a rollout, named as those of the policy's training are."""
    leaves = flat({key: meta[key] for key in ("scene", "policy", "simulator") if isinstance(meta.get(key), Mapping)})
    named = {
        "avp.scene": leaves.get("scene.name"),
        "avp.scene_digest": leaves.get("scene.sha256"),
        "avp.policy": leaves.get("policy.name"),
        "avp.simulator": leaves.get("simulator.name"),
        "avp.policy_run": meta.get("mlflow_run_id"),
    }
    return {key: str(value)[:_MAX_TAG] for key, value in named.items() if value is not None}


def _rollout_params(meta: Mapping[str, Any]) -> dict[str, str]:
    chosen = ("policy", "seed", "reward", "budget", "counts", "heldout", "created")
    leaves = flat({key: meta[key] for key in chosen if key in meta})
    return {safe_name(f"rollout.{key}"): str(value)[:_MAX_PARAM] for key, value in leaves.items()}


def _figures(meta: Mapping[str, Any]) -> dict[str, float]:
    """`eval/coverage`, `eval/views`, ...: the names under which the policy's evaluation logs them."""
    metrics = meta.get("metrics")
    if not isinstance(metrics, Mapping):
        return {}
    return {
        safe_name(f"eval/{name}"): float(value)
        for name, value in metrics.items()
        if isinstance(value, (int, float)) and math.isfinite(value)
    }
