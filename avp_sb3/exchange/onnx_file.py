"""A policy as ONNX, for robots and programs without Python, checked with ONNX Runtime."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import PolicyError, UsageError
from avp_habitat.files import atomic_file
from avp_habitat.policies.weights.format import DenseLayer, ObservationStatistics, PolicyWeights
from avp_habitat.policies.weights.policy import PretrainedPolicy

INPUT, OUTPUT = "observation", "logits"
"""Names of the graph's input, `(batch, *shape)` float32 as the environment gives it, and of its output
`(batch, actions)`."""
CLOSE = 1e-5
"""Greatest difference of logits, relative to their size where that is above 1."""
_OPSET = 17
_IR = 8
"""Versions of ONNX that runtimes since 2022 read."""
_OPERATORS = {"tanh": "Tanh", "relu": "Relu", "leaky_relu": "LeakyRelu", "elu": "Elu", "sigmoid": "Sigmoid"}


def check_onnx() -> None:
    """Refuse to go on where ONNX or its runtime are missing.

    Raises:
        UsageError: they are.
    """
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
    except ImportError as error:
        raise UsageError(f"--onnx needs {error.name}; install it with `pip install 'avp-suite[onnx]'`") from None


def write_onnx(weights: PolicyWeights, path: Path, observations: NDArray[np.float32]) -> float:
    """Write the actor, from observations as the environment gives them to logits, and check the file.

    Args:
        weights: of the policy.
        path: of the `.onnx`.
        observations: `(n, *shape)` for which the file and NumPy have to agree.

    Returns:
        The greatest difference of logits.

    Raises:
        UsageError: ONNX or its runtime is missing.
        PolicyError: the file does not give the same logits and actions; it is removed.
    """
    check_onnx()
    import onnx

    graph = _graph(weights, onnx)
    opset = onnx.helper.make_opsetid("", _OPSET)
    made = onnx.helper.make_model(graph, opset_imports=[opset], ir_version=_IR, producer_name="avp-suite")
    made.metadata_props.add(key="name", value=weights.name)
    made.metadata_props.add(key="version", value=str(weights.version))
    made.metadata_props.add(key="observation", value=weights.observation)
    onnx.checker.check_model(made)
    with atomic_file(path, failure=PolicyError) as file:
        onnx.save(made, str(file))
        return _difference(weights, file, observations)


def _graph(weights: PolicyWeights, onnx: Any) -> Any:
    nodes, constants = [], {}

    def add(operator: str, *inputs: str, **attributes: Any) -> str:
        nodes.append(onnx.helper.make_node(operator, inputs, [f"value_{len(nodes)}"], **attributes))
        return nodes[-1].output[0]

    def constant(name: str, value: Any) -> str:
        constants[name] = onnx.numpy_helper.from_array(np.asarray(value), name)
        return name

    value = INPUT if weights.statistics is None else _normalise(weights.statistics, add, constant, onnx)
    value = add("Flatten", value, axis=1)
    for number, layer in enumerate(weights.actor):
        parts = [constant(f"actor.{number}.{part}", getattr(layer, part)) for part in ("weight", "bias")]
        value = add("Gemm", value, *parts, transB=1)
        value = _activated(layer, value, add)
    nodes.append(onnx.helper.make_node("Identity", [value], [OUTPUT]))
    number = onnx.TensorProto.FLOAT
    seen = onnx.helper.make_tensor_value_info(INPUT, number, ["batch", *weights.shape])
    given = onnx.helper.make_tensor_value_info(OUTPUT, number, ["batch", len(weights.actor[-1].bias)])
    return onnx.helper.make_graph(nodes, "policy", [seen], [given], initializer=list(constants.values()))


def _normalise(seen: ObservationStatistics, add: Any, constant: Any, onnx: Any) -> str:
    # In float64, as Stable-Baselines3 does: where a number hardly varies, float32 would lose it.
    value = add("Cast", INPUT, to=onnx.TensorProto.DOUBLE)
    value = add("Sub", value, constant("observation.mean", seen.mean))
    value = add("Div", value, constant("observation.scale", np.sqrt(seen.var + seen.epsilon)))
    value = add("Clip", value, constant("low", np.float64(-seen.clip)), constant("high", np.float64(seen.clip)))
    return add("Cast", value, to=onnx.TensorProto.FLOAT)


def _activated(layer: DenseLayer, value: str, add: Any) -> str:
    if layer.activation is None:
        return value
    if layer.activation == "silu":
        return add("Mul", value, add("Sigmoid", value))
    return add(_OPERATORS[layer.activation], value)


def _difference(weights: PolicyWeights, path: Path, observations: NDArray[np.float32]) -> float:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    found = np.asarray(session.run([OUTPUT], {INPUT: observations})[0])
    expected = PretrainedPolicy(weights).logits(observations)
    difference = float(np.abs(found - expected).max())
    close = difference <= CLOSE * max(1.0, float(np.abs(expected).max()))
    if not close or (found.argmax(axis=1) != expected.argmax(axis=1)).any():
        raise PolicyError(
            f"{path}: expected ONNX Runtime to give the same logits, found a difference of {difference:g}"
        )
    return difference
