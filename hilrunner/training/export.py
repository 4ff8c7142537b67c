"""A trained network as ONNX: one file, scaling inside the graph, `hil.*` metadata, golden vectors; needs no torch."""

import hashlib
import json
from dataclasses import dataclass

import numpy as np

from hilrunner.setup import model_text
from hilrunner.training.problem import Quantity

OPSET = 17  # any onnxruntime of the last years; the limit of the format is opset 20, IR 10
IR_VERSION = 8
GOLDEN_COUNT = 32


@dataclass(frozen=True)
class Trained:
    """One trained network with tanh layers and linear output, normalised to -1..1 on both sides.

    weights, biases: float64 a layer. output_low, output_high: what -1 and 1 of the last layer stand for.
    """

    role: str
    inputs: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    output_low: np.ndarray
    output_high: np.ndarray

    @property
    def input_offset(self) -> np.ndarray:
        """Middle of every input's range."""
        return np.array([0.5 * (quantity.low + quantity.high) for quantity in self.inputs])

    @property
    def input_scale(self) -> np.ndarray:
        """Factor that makes the range -1..1."""
        return np.array([2.0 / (quantity.high - quantity.low) for quantity in self.inputs])

    def weights_sha256(self) -> str:
        """Hash of every number that decides an output."""
        digest = hashlib.sha256()
        for array in (*self.weights, *self.biases, self.output_low, self.output_high):
            digest.update(np.ascontiguousarray(array, "<f8").tobytes())
        for quantity in self.inputs:
            digest.update(np.array([quantity.low, quantity.high], "<f8").tobytes())
        return digest.hexdigest()


def to_onnx(networks: list[Trained], circuit: str, recipe: str, parameters: dict, training: dict, seed: int):
    """The model of all networks of a recipe: graph inputs `<role>`, outputs `<role>_out`, float64, batch first.

    Returns:
        onnx.ModelProto that passed onnx.checker's full check.
    """
    import onnx
    from onnx import TensorProto, helper

    from hilrunner import __version__

    nodes, constants, inputs, outputs = [], [], [], []
    for network in networks:
        _append(network, nodes, constants)
        width = (len(network.inputs), len(network.outputs))
        inputs.append(
            helper.make_tensor_value_info(network.role, TensorProto.DOUBLE, [f"{network.role}_rows", width[0]])
        )
        outputs.append(
            helper.make_tensor_value_info(f"{network.role}_out", TensorProto.DOUBLE, [f"{network.role}_rows", width[1]])
        )
    graph = helper.make_graph(nodes, f"{circuit}-{recipe}", inputs, outputs, constants)
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPSET)],
        producer_name="hilrunner",
        producer_version=__version__,
    )
    model.ir_version = IR_VERSION
    properties = {
        model_text.KEY_FORMAT: model_text.FORMAT,
        model_text.KEY_CIRCUIT: circuit,
        model_text.KEY_RECIPE: recipe,
        model_text.KEY_NETWORKS: json.dumps([_describe(network) for network in networks]),
        model_text.KEY_PARAMETERS: json.dumps(parameters, sort_keys=True),
        model_text.KEY_TRAINING: json.dumps(training, sort_keys=True),
        model_text.KEY_WEIGHTS_SHA256: json.dumps({n.role: n.weights_sha256() for n in networks}, sort_keys=True),
    }
    helper.set_model_props(model, properties)
    golden = golden_vectors(model, networks, seed)
    helper.set_model_props(model, properties | {model_text.KEY_GOLDEN: json.dumps(golden)})
    onnx.checker.check_model(model, full_check=True)
    return model


def _describe(network: Trained) -> dict:
    return {
        "role": network.role,
        "input": network.role,
        "output": f"{network.role}_out",
        "inputs": [{"name": q.name, "unit": q.unit, "low": q.low, "high": q.high} for q in network.inputs],
        "outputs": [
            {"name": q.name, "unit": q.unit, "low": float(low), "high": float(high)}
            for q, low, high in zip(network.outputs, network.output_low, network.output_high, strict=True)
        ],
    }


def _append(network: Trained, nodes: list, constants: list) -> None:
    """Sub, Mul (to -1..1), Gemm and Tanh a layer, Mul, Add (back to SI)."""
    from onnx import helper, numpy_helper

    role = network.role
    at = role

    def constant(name: str, value: np.ndarray) -> str:
        constants.append(numpy_helper.from_array(np.ascontiguousarray(value, np.float64), f"{role}.{name}"))
        return f"{role}.{name}"

    def node(kind: str, name: str, *sources: str, **attributes) -> str:
        nodes.append(helper.make_node(kind, list(sources), [f"{role}.{name}"], name=f"{role}.{name}", **attributes))
        return f"{role}.{name}"

    at = node("Sub", "centred", at, constant("input_offset", network.input_offset))
    at = node("Mul", "normalised", at, constant("input_scale", network.input_scale))
    last = len(network.weights) - 1
    for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        names = constant(f"weight_{index}", weight), constant(f"bias_{index}", bias)
        at = node("Gemm", f"layer_{index}", at, *names, transB=1)
        if index < last:
            at = node("Tanh", f"tanh_{index}", at)
    half = 0.5 * (network.output_high - network.output_low)
    at = node("Mul", "scaled", at, constant("output_scale", half))
    middle = constant("output_offset", 0.5 * (network.output_high + network.output_low))
    nodes.append(helper.make_node("Add", [at, middle], [f"{role}_out"], name=f"{role}.out"))


def golden_vectors(model, networks: list[Trained], seed: int) -> dict:
    """Inputs spread over each training range and what onnxruntime makes of them, by role; floats that round-trip."""
    import onnxruntime

    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    random = np.random.default_rng(seed)
    golden = {}
    for network in networks:
        low = np.array([quantity.low for quantity in network.inputs])
        high = np.array([quantity.high for quantity in network.inputs])
        inputs = random.uniform(low, high, (GOLDEN_COUNT, len(low)))
        feeds = {other.role: np.zeros((1, len(other.inputs))) for other in networks} | {network.role: inputs}
        (outputs,) = session.run([f"{network.role}_out"], feeds)
        golden[network.role] = {"inputs": inputs.tolist(), "outputs": outputs.tolist()}
    return golden
