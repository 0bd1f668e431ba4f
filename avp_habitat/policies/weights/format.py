"""A policy's files: `NAME.json` says what it is, `NAME.safetensors` holds its numbers; neither can run code."""

import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import PolicyError, UsageError, unknown_name
from avp_habitat.files import atomic_file, check_new

FORMAT = 1
"""Version of the format."""
_NAME = re.compile(r"[A-Za-z0-9][\w.+-]*")
_MEAN, _VAR = "observation.mean", "observation.var"


def _sigmoid(x: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.float32(0.5) * (1 + np.tanh(np.float32(0.5) * x))


ACTIVATIONS = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
    "leaky_relu": lambda x: np.where(x > 0, x, np.float32(0.01) * x),
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
    "silu": lambda x: x * _sigmoid(x),
    "sigmoid": _sigmoid,
}
"""What may stand between linear layers, by name, as torch computes it with its own constants."""


@dataclass(frozen=True)
class DenseLayer:
    """One linear layer, and what its outputs go through."""

    weight: NDArray[np.float32]
    """`(outputs, inputs)`."""
    bias: NDArray[np.float32]
    """`(outputs,)`."""
    activation: str | None = None
    """One of `ACTIVATIONS`; None for a network's last layer."""


@dataclass(frozen=True)
class ObservationStatistics:
    """What `VecNormalize` knew: observations become (x − mean) / √(var + epsilon), held within ± clip."""

    mean: NDArray[np.float64]
    """Of the observation's shape."""
    var: NDArray[np.float64]
    """Of the observation's shape."""
    clip: float
    """Greatest absolute value."""
    epsilon: float
    """Added to the variance."""
    count: float
    """How many observations they are of: a training that goes on weighs them by it."""

    def normalise(self, observation: NDArray) -> NDArray[np.float32]:
        """Observations `(n, …)` as the network knows them."""
        scaled = (observation - self.mean) / np.sqrt(self.var + self.epsilon)
        return np.clip(scaled, -self.clip, self.clip).astype(np.float32)


@dataclass(frozen=True)
class PolicyWeights:
    """A policy of dense layers, and what it was made for."""

    name: str
    """Of letters, digits, `_ . + -`."""
    version: int
    """Of the weights of this name."""
    observation: str
    """Kind of the observation, as `TaskSettings.observation` takes it."""
    shape: tuple[int, ...]
    """Of one observation."""
    actor: tuple[DenseLayer, ...]
    """From a flat observation to the logits of the actions."""
    critic: tuple[DenseLayer, ...]
    """From a flat observation to the return expected; what only training needs."""
    statistics: ObservationStatistics | None = None
    """With which observations are normalised first; None where they are not."""
    settings: dict[str, Any] = field(default_factory=dict)
    """`TaskSettings.facts` of the task that it was trained for, as far as they are known."""
    training: dict[str, Any] = field(default_factory=dict)
    """How it was made: algorithm, steps, seed, command, commit, scenes, versions, as far as they are known."""
    sha256: str = ""
    """Of the `.safetensors`, where it was read from one."""


def outputs(layers: Iterable[DenseLayer], observation: NDArray) -> NDArray[np.float32]:
    """`(n, outputs)` of a network for flat observations `(n, inputs)`, in float32."""
    values = observation.astype(np.float32)
    for layer in layers:
        values = values @ layer.weight.T + layer.bias
        if layer.activation is not None:
            values = ACTIVATIONS[layer.activation](values)
    return values


def write_weights(weights: PolicyWeights, folder: Path) -> Path:
    """Write a policy's two files into a folder, which may hold others; the path of the `.json`.

    Raises:
        UsageError: the name cannot be a file's, or there is such a policy already.
    """
    from safetensors.numpy import save

    if not _NAME.fullmatch(weights.name):
        raise UsageError(f"name {weights.name!r}: expected letters, digits and _ . + -")
    path, numbers = folder / f"{weights.name}.json", folder / f"{weights.name}.safetensors"
    check_new(path)
    tensors = {
        f"{network}.{number}.{part}": np.ascontiguousarray(getattr(layer, part), dtype=np.float32)
        for network in ("actor", "critic")
        for number, layer in enumerate(getattr(weights, network))
        for part in ("weight", "bias")
    }
    if weights.statistics is not None:
        tensors |= {_MEAN: np.asarray(weights.statistics.mean), _VAR: np.asarray(weights.statistics.var)}
    content = save(tensors)
    facts = _facts(weights) | {"sha256": hashlib.sha256(content).hexdigest()}
    with atomic_file(numbers, failure=PolicyError) as file:
        file.write_bytes(content)
    with atomic_file(path, failure=PolicyError) as file:
        file.write_text(json.dumps(facts, indent=2, default=str) + "\n", encoding="utf-8")
    return path


def _facts(weights: PolicyWeights) -> dict[str, Any]:
    seen = weights.statistics
    return {
        "format": FORMAT,
        "name": weights.name,
        "version": weights.version,
        "observation": {"kind": weights.observation, "shape": list(weights.shape)},
        "normalisation": seen and {"clip": seen.clip, "epsilon": seen.epsilon, "count": seen.count},
        **{
            network: [
                {"inputs": layer.weight.shape[1], "outputs": layer.weight.shape[0], "activation": layer.activation}
                for layer in getattr(weights, network)
            ]
            for network in ("actor", "critic")
        },
        "settings": weights.settings,
        "training": weights.training,
    }


def read_facts(path: Path) -> dict[str, Any]:
    """What the `.json` of a policy says.

    Raises:
        PolicyError: it cannot be read, is of another version of the format, or something else.
    """
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
        version = facts["format"]
        _ = facts["observation"]["kind"], facts["name"], facts["version"], facts["training"]["algorithm"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _no_policy(path, error) from None
    if version != FORMAT:
        raise PolicyError(f"{path}: expected format {FORMAT} of a policy's files, found {version!r}")
    return facts


def _no_policy(path: Path, error: Exception) -> PolicyError:
    why = f"no {error}" if isinstance(error, KeyError) else error
    return PolicyError(f"{path}: expected a policy as `python -m avp_sb3.export` writes it, could not read it: {why}")


def read_weights(path: Path) -> PolicyWeights:
    """The policy of a `.json` and the `.safetensors` beside it.

    Raises:
        PolicyError: one of them cannot be read, is another's or was changed, or is of another version of the format.
    """
    facts = read_facts(path)
    numbers = path.with_name(f"{path.name.removesuffix('.json')}.safetensors")
    try:
        content = numbers.read_bytes()
    except OSError as error:
        raise PolicyError(f"{numbers}: cannot read the weights of {path.name}: {error.strerror or error}") from None
    found = hashlib.sha256(content).hexdigest()
    if found != facts.get("sha256"):
        raise PolicyError(f"{numbers}: expected the SHA-256 {facts.get('sha256')} of {path.name}, found {found}")
    try:
        return _weights(facts, content)
    except PolicyError:
        raise
    except Exception as error:  # Safetensors has errors of its own.
        raise _no_policy(path, error) from None


def _weights(facts: dict[str, Any], content: bytes) -> PolicyWeights:
    from safetensors.numpy import load

    tensors = load(content)
    shape, seen, statistics = tuple(facts["observation"]["shape"]), facts["normalisation"], None
    if seen is not None:
        statistics = ObservationStatistics(_shaped(tensors, _MEAN, shape), _shaped(tensors, _VAR, shape), **seen)
    return PolicyWeights(
        name=facts["name"],
        version=facts["version"],
        observation=facts["observation"]["kind"],
        shape=shape,
        actor=_network(tensors, "actor", facts["actor"], int(np.prod(shape))),
        critic=_network(tensors, "critic", facts["critic"], int(np.prod(shape))),
        statistics=statistics,
        settings=facts["settings"],
        training=facts["training"],
        sha256=facts["sha256"],
    )


def _network(tensors: dict[str, Any], name: str, said: list[dict[str, Any]], inputs: int) -> tuple[DenseLayer, ...]:
    layers = []
    for number, each in enumerate(said):
        if each["activation"] not in (None, *ACTIVATIONS):
            raise PolicyError(str(unknown_name("activation", str(each["activation"]), ACTIVATIONS)))
        weight = _shaped(tensors, f"{name}.{number}.weight", (each["outputs"], inputs))
        layers.append(
            DenseLayer(weight, _shaped(tensors, f"{name}.{number}.bias", (each["outputs"],)), each["activation"])
        )
        inputs = each["outputs"]
    return tuple(layers)


def _shaped(tensors: dict[str, Any], name: str, shape: tuple[int, ...]) -> Any:
    if tensors[name].shape != shape:
        raise ValueError(f"expected {name} of shape {shape}, found {tensors[name].shape}")
    return tensors[name]
