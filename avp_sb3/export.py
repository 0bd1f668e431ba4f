"""`python -m avp_sb3.export`: write a Stable-Baselines3 model as files that hold no code, and as ONNX."""

import re
import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional, arg

from avp_habitat import command
from avp_habitat.errors import PolicyError, UsageError
from avp_habitat.files import check_new, check_writable
from avp_habitat.policies.registry import TRUSTED
from avp_habitat.policies.saved_model import load_model, load_statistics, statistics_of
from avp_habitat.policies.weights.format import write_weights
from avp_habitat.policies.weights.policy import PretrainedPolicy
from avp_habitat.provenance import PACKAGES, git_commit, installed_versions
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.task.settings import OBSERVATIONS_HELP
from avp_sb3.exchange.onnx_file import check_onnx, write_onnx
from avp_sb3.exchange.sb3 import weights_of

_OBSERVATIONS = 1000
_BOUND = 10.0
_CLOSE = 1e-5


@dataclass(frozen=True)
class ExportModel:
    """Write a model as NAME.json and NAME.safetensors, which open without running code, and check that they act alike.

    Of PPO, A2C or TRPO with an MlpPolicy. Then `--policy FOLDER` lets it act, `--start FOLDER` trains on from it.
    """

    model: Positional[Path]
    """Saved by Stable-Baselines3 or sb3-contrib (.zip); statistics of VecNormalize beside it come along."""
    out: Path
    """Folder of the files; it may hold others."""
    name: str | None = None
    """Of the policy and its files (omitted: the model's)."""
    version: Annotated[int, Range(1, 1e6)] = 1
    """Of the weights."""
    observation: Annotated[
        str | None,
        arg(help=f"{OBSERVATIONS_HELP} (omitted: what the training noted, or the only one of the model's space)"),
    ] = None
    onnx: bool = False
    """Write NAME.onnx too: input `observation` (batch, …) float32, output `logits`."""
    trusted: Annotated[bool, arg(help=TRUSTED)] = False

    def __post_init__(self) -> None:
        """Hold the ranges."""
        hold_ranges(self)


def _drawn(space: Any) -> Any:
    """`(n, …)` float32 observations within a space's bounds, which are held within ± 10."""
    rng = np.random.default_rng(0)
    low, high = np.clip(space.low, -_BOUND, _BOUND), np.clip(space.high, -_BOUND, _BOUND)
    return rng.uniform(low, high, size=(_OBSERVATIONS, *space.shape)).astype(np.float32)


def _torch_logits(model: Any, normalised: Any, observations: Any) -> Any:
    import torch

    known = observations if normalised is None else normalised.normalize_obs(observations)
    with torch.no_grad():
        distribution = model.policy.get_distribution(model.policy.obs_to_tensor(known)[0]).distribution
        # Categorical's logits are normalised: they are the network's but for a number that is the same for all actions.
        return distribution.logits.numpy()


def _check_same(policy: PretrainedPolicy, model: Any, normalised: Any, observations: Any) -> float:
    ours, theirs = policy.logits(observations), _torch_logits(model, normalised, observations)
    ours = ours - np.logaddexp.reduce(ours, axis=1, keepdims=True)
    difference = float(np.abs(ours - theirs).max())
    if difference > _CLOSE * max(1.0, float(np.abs(theirs).max())):
        raise PolicyError(f"export: expected the model's logits, found a difference of {difference:g}; nothing is kept")
    return difference


def main(options: ExportModel) -> None:
    """Read the model, write the files, check them."""
    name = options.name or re.sub(r"[^\w.+-]", "_", options.model.stem)
    targets = [options.out / f"{name}{suffix}" for suffix in (".json", ".safetensors", ".onnx")[: 2 + options.onnx]]
    for target in targets:
        check_new(target, option="--out")
    check_writable(targets[0])
    if options.onnx:
        check_onnx()
    if not options.model.is_file():
        raise UsageError(f"{options.model}: no such model file")
    model = load_model(options.model, trusted=options.trusted)
    found = statistics_of(options.model)
    normalised = found and load_statistics(found, model.observation_space, trusted=options.trusted)
    weights = weights_of(model, name, version=options.version, observation=options.observation, statistics=normalised)
    exported = {
        "command": shlex.join(["python", "-m", "avp_sb3.export", *sys.argv[1:]]),
        "commit": git_commit(),
        "versions": installed_versions(PACKAGES),
    }
    weights = replace(weights, training=weights.training | {"exported": exported})
    observations = _drawn(model.observation_space)
    difference = _check_same(PretrainedPolicy(weights), model, normalised, observations)
    same = f"same logits as the model on {len(observations)} observations"
    if options.onnx:
        apart = write_onnx(weights, targets[2], observations)
        print(f"{targets[2]}: {same} (largest difference {apart:.1g})")
    path = write_weights(weights, options.out)
    print(f"{path}: {same} (largest difference {difference:.1g}); observation {weights.observation}")
    print(f"to use it:  --policy {shlex.quote(str(path))}   to train on from it:  --start {shlex.quote(str(path))}")


if __name__ == "__main__":
    sys.exit(command.run(main))
