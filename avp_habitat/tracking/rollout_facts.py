"""What MLflow runs say of a rollout: which one it is, where it comes from, its settings and figures."""

import hashlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from avp_habitat.errors import RolloutError
from avp_habitat.provenance import flat
from avp_habitat.tracking.names import safe_name
from avp_habitat.tracking.view import COLOUR_TAG, run_colour

ROLLOUT_ID_TAG, ROLLOUT_TAG, ROLLOUT_RUN_TAG = "avp.rollout_id", "avp.rollout", "avp.rollout_run"
POLICY_TAG, POLICY_RUN_TAG, SCENE_TAG, KIND_TAG = "avp.policy", "avp.policy_run", "avp.scene", "avp.kind"
ROLLOUT, RECONSTRUCTION = "rollout", "reconstruction"
"""Values of the tag `avp.kind`."""
_IDENTITY = ("rollout.json", "steps.csv")
_SETTINGS = ("policy", "seed", "reward", "budget", "counts", "heldout", "created")
_ORIGIN = {
    SCENE_TAG: "scene.name",
    "avp.scene_digest": "scene.sha256",
    POLICY_TAG: "policy.name",
    "avp.simulator": "simulator.name",
}


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
        except FileNotFoundError:
            raise RolloutError(f"{folder / name}: expected this file of the rollout, found none") from None
        except OSError as error:
            raise RolloutError(f"{folder / name}: could not read it: {error.strerror}") from None
    return digest.hexdigest()


def origin(meta: Mapping[str, Any]) -> dict[str, str]:
    """Tags that name scene, simulator and policy as those of the policy's training do.

    Args:
        meta: `rollout.json`.
    """
    leaves = flat({key: meta[key] for key in ("scene", "policy", "simulator") if isinstance(meta.get(key), Mapping)})
    tags = {tag: str(leaves[key]) for tag, key in _ORIGIN.items() if leaves.get(key) is not None}
    # One colour per policy on all of the experiment's pages.
    return tags | ({COLOUR_TAG: run_colour(str(leaves["policy.name"]))} if leaves.get("policy.name") else {})


def title(meta: Mapping[str, Any]) -> str | None:
    """Policy, scene and seed, in words; the reward too of a policy that was trained. None where a rollout has no names.

    Args:
        meta: `rollout.json`.
    """
    named = origin(meta)
    if not {POLICY_TAG, SCENE_TAG} <= named.keys():
        return None
    policy, seed = named[POLICY_TAG], meta.get("seed")
    words = [policy, meta.get("reward") if policy.endswith(".zip") else None, named[SCENE_TAG]]
    words += [None if seed is None else f"seed {seed}"]
    return " ".join(str(word) for word in words if word is not None)


def rollout_params(meta: Mapping[str, Any]) -> dict[str, str]:
    """`rollout.seed`, `rollout.budget`, ...: what a rollout was collected with.

    Args:
        meta: `rollout.json`.
    """
    leaves = flat({key: meta[key] for key in _SETTINGS if key in meta})
    return {safe_name(f"rollout.{key}"): str(value) for key, value in leaves.items()}


def figures(meta: Mapping[str, Any], prefix: str = "eval") -> dict[str, float]:
    """`eval/coverage`, `eval/views`, ...: the names under which the policy's evaluation logs them.

    Args:
        meta: `rollout.json`; figures that are no finite number are left out.
        prefix: of the names.
    """
    metrics = meta.get("metrics")
    if not isinstance(metrics, Mapping):
        return {}
    found = {
        name: float(value)
        for name, value in metrics.items()
        if isinstance(value, (int, float)) and math.isfinite(value)
    }
    if found.get("views") and "coverage" in found:
        # One number of the policy's evaluation is written in no rollout, because it follows from two others.
        found.setdefault("cpv", 100 * found["coverage"] / found["views"])
    return {safe_name(f"{prefix}/{name}"): value for name, value in found.items()}


def policy_run_id(folder: Path, meta: Mapping[str, Any]) -> str | None:
    """MLflow run in which a rollout's policy was trained; None for a baseline.

    Args:
        folder: of the rollout.
        meta: its `rollout.json`.

    Raises:
        RolloutError: what stands there cannot be the id of a run.
    """
    value = meta.get("mlflow_run_id")
    if value is not None and not isinstance(value, str):
        raise RolloutError(f"{folder / 'rollout.json'}: expected mlflow_run_id to be a text or null, found {value!r}")
    return value or None
