"""A policy's weights out of a Stable-Baselines3 model, and into a new one."""

import shlex
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat import plugins
from avp_habitat.errors import PolicyError, UsageError
from avp_habitat.policies.registry import exported_file, observation_of
from avp_habitat.policies.weights import packaged
from avp_habitat.policies.weights.format import (
    DenseLayer,
    ObservationStatistics,
    PolicyWeights,
    read_facts,
    read_weights,
)
from avp_habitat.provenance import PACKAGES, git_commit, installed_versions
from avp_habitat.task.observations import make_observation
from avp_habitat.task.settings import OBSERVATIONS, TaskSettings

TRAINING = "avp_training"
"""Attribute of a model, kept in its `.zip`: the facts of its training as `PolicyWeights` has them."""
_START = "avp_start"
_TORCH = {
    "Tanh": "tanh",
    "ReLU": "relu",
    "LeakyReLU": "leaky_relu",
    "ELU": "elu",
    "SiLU": "silu",
    "Sigmoid": "sigmoid",
}
"""torch's classes of activations by their names, and their names in the format."""


def note_training(model: Any, settings: TaskSettings, scenes: Iterable[str]) -> None:
    """Note in a model, and so in its `.zip`, what the command that runs trains it with: its weights can tell later."""
    noted = {
        "command": shlex.join(["python", "-m", "avp_sb3.train", *sys.argv[1:]]),
        "commit": git_commit(),
        "scenes": list(scenes),
        "settings": settings.facts(),
        "versions": installed_versions(PACKAGES),
    }
    if (start := getattr(model, _START, None)) is not None:
        noted["start"] = start
    setattr(model, TRAINING, noted)


def weights_of(
    model: Any,
    name: str,
    *,
    version: int = 1,
    observation: str | None = None,
    settings: TaskSettings | None = None,
    statistics: Any = None,
) -> PolicyWeights:
    """What a model's files are to hold.

    Args:
        model: of an algorithm whose policy is the `MlpPolicy` of PPO, A2C or TRPO, with numbered actions.
        name: of the policy.
        version: of its weights.
        observation: kind of its observation; what the training noted, or else the only kind of the model's space.
        settings: of the task it was trained for; what the training noted when omitted.
        statistics: the `VecNormalize` of its training, if there was one.

    Raises:
        PolicyError: the format cannot hold it.
        UsageError: its kind of observation is not known.
    """
    _check_kind(model)
    policy, noted = model.policy, dict(getattr(model, TRAINING, {}))
    facts = {"algorithm": type(model).__name__, "steps": model.num_timesteps, "seed": model.seed, **noted}
    if (run := getattr(model, "avp_mlflow_run_id", None)) is not None:
        facts["mlflow_run_id"] = run
    told = facts.pop("settings", {}) if settings is None else settings.facts()
    facts.pop("settings", None)
    return PolicyWeights(
        name=name,
        version=version,
        observation=observation or told.get("observation") or _kind_of(model.observation_space),
        shape=tuple(model.observation_space.shape),
        actor=_layers(policy.mlp_extractor.policy_net, policy.action_net),
        critic=_layers(policy.mlp_extractor.value_net, policy.value_net),
        statistics=_statistics(statistics),
        settings=told,
        training=facts,
    )


def _check_kind(model: Any) -> None:
    from gymnasium.spaces import Box, Discrete
    from stable_baselines3.common.policies import ActorCriticPolicy
    from stable_baselines3.common.preprocessing import is_image_space
    from stable_baselines3.common.torch_layers import FlattenExtractor

    policy, space = model.policy, model.observation_space
    what = "export: the format holds the MlpPolicy of PPO, A2C or TRPO on vectors of numbers with numbered actions"
    if type(policy) is not ActorCriticPolicy:
        raise PolicyError(f"{what}, found the {type(policy).__name__} of {type(model).__name__}")
    if type(policy.features_extractor) is not FlattenExtractor:
        raise PolicyError(f"{what}, found the features of {type(policy.features_extractor).__name__}")
    if not isinstance(space, Box) or (policy.normalize_images and is_image_space(space)):
        raise PolicyError(f"{what}, found observations {space}")
    if not isinstance(model.action_space, Discrete) or model.action_space.start != 0:
        raise PolicyError(f"{what}, found actions {model.action_space}")
    if policy.use_sde:
        raise PolicyError(f"{what}, found state-dependent exploration")


def _layers(hidden: Any, last: Any) -> tuple[DenseLayer, ...]:
    from torch import nn

    layers: list[DenseLayer] = []
    for module in [*hidden, last]:
        if isinstance(module, nn.Linear):
            weight, bias = (part.detach().cpu().numpy().copy() for part in (module.weight, module.bias))
            layers.append(DenseLayer(weight, bias))
            continue
        found = str(module)
        # As torch writes one with its own constants, which are those of the format.
        if found not in {str(getattr(nn, name)()) for name in _TORCH} or layers[-1].activation is not None:
            raise PolicyError(f"export: the format holds the activations {', '.join(_TORCH)}, found {found}")
        layers[-1] = DenseLayer(layers[-1].weight, layers[-1].bias, _TORCH[type(module).__name__])
    return tuple(layers)


def _statistics(normalised: Any) -> ObservationStatistics | None:
    if normalised is None or not normalised.norm_obs:
        return None
    seen = normalised.obs_rms
    return ObservationStatistics(
        np.asarray(seen.mean, np.float64),
        np.asarray(seen.var, np.float64),
        clip=float(normalised.clip_obs),
        epsilon=float(normalised.epsilon),
        count=float(seen.count),
    )


def _kind_of(space: Any) -> str:
    kinds = plugins.names("avp.observations", OBSERVATIONS)
    fitting = [kind for kind in kinds if make_observation(TaskSettings(observation=kind)).space == space]
    if len(fitting) != 1:
        found = " and ".join(fitting) or f"none of {', '.join(kinds)}"
        raise UsageError(f"--observation: expected the kind that the model was trained on: {space} is {found}")
    return fitting[0]


def start_file(start: str) -> Path:
    """The `.json` of the policy from which a training starts: as for `--policy`, or a name of the package's weights.

    Raises:
        UsageError: there is none; the nearest is named.
        PolicyError: the folder holds none.
    """
    if start.endswith(".zip"):
        raise UsageError(f"start: expected a policy without pickles, got {start}: export it, or go on with --resume")
    return exported_file(start) or packaged(start)


def start_observation(start: str, observation: str | None) -> str:
    """The kind of observation of a training that starts from a policy: its own, which may also be asked for.

    Raises:
        UsageError: another one is asked for, or there is no such policy.
        PolicyError: the policy cannot be read.
    """
    path = start_file(start)
    made = str(read_facts(path)["observation"]["kind"])
    if observation not in (None, made):
        raise UsageError(f"observation: {start} was made for {made}, got {observation}; leave it out")
    return observation or observation_of(path)


def started_ppo(start: str, env: Any, **arguments: Any) -> Any:
    """A PPO for a vector environment whose actor and critic are those of exported weights.

    Where these normalise observations, the environment is wrapped in a `VecNormalize` that goes on with their
    statistics and leaves rewards as they are.

    Args:
        start: as `start_file` takes it.
        env: the agents.
        **arguments: further ones of PPO.

    Raises:
        UsageError: there are no such weights, or they were made for other observations or actions.
        PolicyError: their files cannot be used.
    """
    import torch
    from stable_baselines3 import PPO
    from torch import nn

    weights = read_weights(start_file(start))
    offered = env.observation_space.shape, getattr(env.action_space, "n", None)
    if offered != (weights.shape, len(weights.actor[-1].bias)):
        made = f"observations of shape {weights.shape} and {len(weights.actor[-1].bias)} actions"
        raise UsageError(f"--start {start}: made for {made}, but this task has {offered[0]} and {offered[1]}")
    found = {str(layer.activation) for layer in (*weights.actor[:-1], *weights.critic[:-1])} or {"tanh"}
    if len(found) != 1:
        raise UsageError(f"--start {start}: expected one activation in all layers, found {', '.join(sorted(found))}")
    torch_name = {ours: name for name, ours in _TORCH.items()}[found.pop()]
    sizes = {"pi": _hidden(weights.actor), "vf": _hidden(weights.critic)}
    if weights.statistics is not None:
        env = _normalised(env, weights.statistics)
    arguments["policy_kwargs"] = {"net_arch": sizes, "activation_fn": getattr(nn, torch_name)}
    model = PPO("MlpPolicy", env, device="cpu", **arguments)
    extractor = model.policy.mlp_extractor
    with torch.no_grad():
        for modules, layers in (
            ([*extractor.policy_net, model.policy.action_net], weights.actor),
            ([*extractor.value_net, model.policy.value_net], weights.critic),
        ):
            linear = [module for module in modules if isinstance(module, nn.Linear)]
            for module, layer in zip(linear, layers, strict=True):
                module.weight.copy_(_tensor(layer.weight))
                module.bias.copy_(_tensor(layer.bias))
    setattr(model, _START, {"name": weights.name, "version": weights.version, "sha256": weights.sha256})
    return model


def _hidden(layers: tuple[DenseLayer, ...]) -> list[int]:
    return [len(layer.bias) for layer in layers[:-1]]


def _tensor(array: NDArray[np.float32]) -> Any:
    import torch

    # A copy: safetensors gives arrays that cannot be written.
    return torch.from_numpy(array.copy())


def _normalised(env: Any, seen: ObservationStatistics) -> Any:
    from stable_baselines3.common.vec_env import VecNormalize

    env = VecNormalize(env, norm_reward=False, clip_obs=seen.clip, epsilon=seen.epsilon)
    env.obs_rms.mean, env.obs_rms.var, env.obs_rms.count = seen.mean.copy(), seen.var.copy(), seen.count
    return env
