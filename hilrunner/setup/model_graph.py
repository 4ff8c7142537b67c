"""From an ONNX graph to layers: which nodes a multilayer perceptron may be written with, and what each one means.

A network is a chain of nodes from one graph input to one graph output. Elementwise constants before the first matrix are
its input scaling, those after the last its output scaling; every other linear node is folded into a layer.
"""

from dataclasses import dataclass, field

import numpy as np

from hilrunner.base.errors import ModelError
from hilrunner.plant.generic_kernel import (
    ACTIVATION_ELU,
    ACTIVATION_GELU,
    ACTIVATION_LINEAR,
    ACTIVATION_NAMES,
    ACTIVATION_RELU,
    ACTIVATION_SIGMOID,
    ACTIVATION_SILU,
    ACTIVATION_SOFTPLUS,
    ACTIVATION_TANH,
    MAX_LAYERS,
    MAX_WIDTH,
)
from hilrunner.plant.head import MAX_QUANTITIES

_ACTIVATIONS = {
    "Tanh": ACTIVATION_TANH,
    "Sigmoid": ACTIVATION_SIGMOID,
    "Relu": ACTIVATION_RELU,
    "Softplus": ACTIVATION_SOFTPLUS,
    "Elu": ACTIVATION_ELU,
    "Gelu": ACTIVATION_GELU,
    "Swish": ACTIVATION_SILU,
}
_PASSED = {"Identity", "Dropout", "Cast", "Flatten", "Reshape", "Squeeze"}  # change no number of one row


_KNOWN = {*_ACTIVATIONS, *_PASSED, "MatMul", "Gemm", "Add", "Sub", "Mul", "Div", "Scaler"}


@dataclass
class Chain:
    """One network as it is read, front to back."""

    input: str
    output: str
    input_count: int = 0
    input_offset: np.ndarray | None = None
    input_scale: np.ndarray | None = None
    weights: list[np.ndarray] = field(default_factory=list)
    biases: list[np.ndarray] = field(default_factory=list)
    activations: list[int] = field(default_factory=list)
    scale: np.ndarray | None = None  # elementwise, not yet folded
    offset: np.ndarray | None = None

    def describe(self) -> str:
        """One line: how the chain was understood."""
        sizes = " -> ".join(str(n) for n in [self.input_count, *(len(bias) for bias in self.biases)])
        names = ", ".join(ACTIVATION_NAMES[kind] for kind in self.activations)
        return f"{sizes} ({names})"


class Graph:
    """The nodes of a model by what they make."""

    def __init__(self, place: str, model) -> None:
        from onnx import numpy_helper

        self.place = place
        self.nodes = list(model.graph.node)
        self.constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
        for node in self.nodes:
            if node.op_type == "Constant" and node.attribute and node.attribute[0].name == "value":
                self.constants[node.output[0]] = numpy_helper.to_array(node.attribute[0].t)
        self.maker = {name: index for index, node in enumerate(self.nodes) for name in node.output}
        self.inputs = [value.name for value in model.graph.input if value.name not in self.constants]
        self.outputs = [value.name for value in model.graph.output]
        self.input_widths = {value.name: _last_dimension(value) for value in model.graph.input}

    def where(self, index: int) -> str:
        """`node 7, LSTM` with the node's name if it has one."""
        node = self.nodes[index]
        return f"node {index}, {node.op_type}" + (f" '{node.name}'" if node.name else "")

    def refuse(self, index: int, why: str) -> ModelError:
        """The error for a node that cannot be ported."""
        return self.error(self.where(index), why)

    def error(self, where: str, why: str) -> ModelError:
        """The error for nodes that cannot be ported."""
        return ModelError(
            f"{self.place}: {where}",
            why,
            "MatMul, Gemm, Add, Sub, Mul, Div, Scaler and " + ", ".join(_ACTIVATIONS),
            "run it with --engine onnx, or export the network without this node",
        )

    def path(self, output: str) -> tuple[str, list[int]]:
        """The graph input a graph output comes from, and the nodes between them in order."""
        steps: list[int] = []
        name = output
        while name not in self.inputs:
            if name not in self.maker:
                raise ModelError(
                    self.place, f"output '{output}' depends on '{name}', which nothing makes", "a whole file"
                )
            index = self.maker[name]
            node = self.nodes[index]
            steps.append(index)
            sources = [source for source in node.input if source and source not in self.constants]
            gate = self._gate(index)
            if gate is not None:
                sources = [gate]
            elif len(sources) != 1:
                raise self.refuse(index, f"joins {len(sources)} branches: not a chain of layers")
            name = sources[0]
            if len(steps) > 10_000:
                raise self.refuse(index, "the graph goes in a circle")
        return name, steps[::-1]

    def _gate(self, index: int) -> str | None:
        """For the Mul of x * Sigmoid(x) (SiLU written out): x, else None."""
        node = self.nodes[index]
        if node.op_type != "Mul" or any(source in self.constants for source in node.input):
            return None
        for one, other in (node.input, tuple(node.input)[::-1]):
            made = self.maker.get(other)
            if made is not None and self.nodes[made].op_type == "Sigmoid" and self.nodes[made].input[0] == one:
                return one
        return None

    def chain(self, output: str) -> Chain:
        """Read the network that ends in a graph output."""
        source, steps = self.path(output)
        chain = Chain(source, output, input_count=self.input_widths.get(source) or 0)
        foreign = [index for index in steps if self.nodes[index].op_type not in _KNOWN]
        if foreign:
            named = "; ".join(self.where(index) for index in foreign[:8])
            raise self.error(named, "no part of a multilayer perceptron that can be ported")
        for index in steps:
            self._read(chain, index)
        return _finished(self.place, chain)

    def _read(self, chain: Chain, index: int) -> None:
        node = self.nodes[index]
        kind = node.op_type
        if kind in _PASSED:
            return
        if kind in _ACTIVATIONS:
            _check_activation(self, index)
            self._activate(chain, index, _ACTIVATIONS[kind])
        elif self._gate(index) is not None:
            self._activate(chain, index, ACTIVATION_SILU)
        elif kind in ("MatMul", "Gemm"):
            _dense(self, chain, index)
        elif kind in ("Add", "Sub", "Mul", "Div"):
            _elementwise(self, chain, index)
        else:  # Scaler (ai.onnx.ml)
            values = {attribute.name: np.array(attribute.floats, float) for attribute in node.attribute}
            _scale(chain, np.ones(1), -values.get("offset", np.zeros(1)))
            _scale(chain, values.get("scale", np.ones(1)), np.zeros(1))

    def _activate(self, chain: Chain, index: int, kind: int) -> None:
        if not chain.weights or chain.activations and len(chain.activations) == len(chain.weights):
            raise self.refuse(index, "is an activation without a layer before it")
        _fold_after(chain)
        chain.activations.append(kind)


def _last_dimension(value) -> int | None:
    dimensions = value.type.tensor_type.shape.dim
    return dimensions[-1].dim_value or None if len(dimensions) else None


def _check_activation(graph: Graph, index: int) -> None:
    node = graph.nodes[index]
    values = {attribute.name: attribute for attribute in node.attribute}
    for name in ("alpha", "beta"):
        if name in values and values[name].f != 1.0:
            raise graph.refuse(index, f"{name} = {values[name].f:g}; only 1 is ported")
    if "approximate" in values and values["approximate"].s not in (b"", b"none"):
        raise graph.refuse(index, "the tanh approximation of Gelu is not ported")


def _vector(graph: Graph, index: int, name: str) -> np.ndarray:
    value = np.asarray(graph.constants[name], float)
    if value.ndim > 2 or (value.ndim == 2 and value.shape[0] != 1):
        raise graph.refuse(index, f"constant '{name}' of shape {value.shape} is not one number a column")
    return value.reshape(-1)


def _elementwise(graph: Graph, chain: Chain, index: int) -> None:
    node = graph.nodes[index]
    places = [place for place, name in enumerate(node.input) if name in graph.constants]
    if len(places) != 1:
        raise graph.refuse(index, "has no constant side")
    value = _vector(graph, index, node.input[places[0]])
    kind, first = node.op_type, places[0] == 0
    if kind == "Add":
        _scale(chain, np.ones(1), value)
    elif kind == "Sub":
        _scale(chain, -np.ones(1) if first else np.ones(1), value if first else -value)
    elif kind == "Mul":
        _scale(chain, value, np.zeros(1))
    elif first:
        raise graph.refuse(index, "divides a constant by the signal")
    else:
        _scale(chain, 1.0 / value, np.zeros(1))


def _scale(chain: Chain, scale: np.ndarray, offset: np.ndarray) -> None:
    """Note z = z * scale + offset, elementwise; before the first layer kept as (x - offset) * scale without rounding."""
    if not chain.weights and chain.scale is None and chain.input_scale is None and np.all(scale == 1.0):
        chain.input_offset = -offset if chain.input_offset is None else chain.input_offset - offset
        return
    if not chain.weights and chain.scale is None and np.all(offset == 0.0):
        chain.input_scale = scale if chain.input_scale is None else chain.input_scale * scale
        return
    before, shift = (np.ones(1), np.zeros(1)) if chain.scale is None else (chain.scale, chain.offset)
    chain.scale, chain.offset = before * scale, shift * scale + offset


def _dense(graph: Graph, chain: Chain, index: int) -> None:
    node = graph.nodes[index]
    weight_name = node.input[1]
    if weight_name not in graph.constants:
        raise graph.refuse(index, "multiplies two signals")
    weight = np.asarray(graph.constants[weight_name], float)
    bias = None
    if node.op_type == "Gemm":
        values = {attribute.name: attribute for attribute in node.attribute}
        if "transA" in values and values["transA"].i:
            raise graph.refuse(index, "transA = 1 mixes rows")
        weight = weight.T if not ("transB" in values and values["transB"].i) else weight
        weight = weight * (values["alpha"].f if "alpha" in values else 1.0)
        if len(node.input) > 2 and node.input[2]:
            bias = _vector(graph, index, node.input[2]) * (values["beta"].f if "beta" in values else 1.0)
    else:
        weight = weight.T
    if weight.ndim != 2:
        raise graph.refuse(index, f"weight of shape {weight.shape} is not a matrix")
    width = len(chain.biases[-1]) if chain.biases else chain.input_count or weight.shape[1]
    if weight.shape[1] != width:
        raise ModelError(
            f"{graph.place}: {graph.where(index)}", f"takes {weight.shape[1]} columns, gets {width}", f"{width}"
        )
    chain.input_count = chain.input_count or weight.shape[1]
    bias = np.zeros(len(weight)) if bias is None else np.broadcast_to(bias, (len(weight),)).astype(float)
    if chain.weights and len(chain.activations) < len(chain.weights):
        _fold_after(chain)
        chain.activations.append(ACTIVATION_LINEAR)
    if chain.scale is not None:  # elementwise before a matrix: W (s x + o) + b
        bias = bias + weight @ np.broadcast_to(chain.offset, (weight.shape[1],))
        weight = weight * np.broadcast_to(chain.scale, (weight.shape[1],))
        chain.scale = chain.offset = None
    chain.weights.append(weight)
    chain.biases.append(bias)


def _fold_after(chain: Chain) -> None:
    """Fold elementwise constants after a matrix into it: s (W x + b) + o."""
    if chain.scale is None:
        return
    chain.weights[-1] = chain.weights[-1] * np.broadcast_to(chain.scale, chain.biases[-1].shape)[:, None]
    chain.biases[-1] = chain.biases[-1] * chain.scale + chain.offset
    chain.scale = chain.offset = None


def _finished(place: str, chain: Chain) -> Chain:
    place = f"{place}: output '{chain.output}'"
    if not chain.weights:
        raise ModelError(place, "no MatMul or Gemm: not a network", "a multilayer perceptron")
    if len(chain.activations) < len(chain.weights):
        # bias written as an Add of its own: the first elementwise offset with unit scale belongs to the last matrix
        chain.activations.append(ACTIVATION_LINEAR)
    if len(chain.weights) > MAX_LAYERS:
        raise ModelError(place, f"{len(chain.weights)} layers", f"at most {MAX_LAYERS}", "run it with --engine onnx")
    widest = max(len(bias) for bias in chain.biases)
    if widest > MAX_WIDTH:
        raise ModelError(place, f"a layer of {widest} units", f"at most {MAX_WIDTH}", "run it with --engine onnx")
    if max(chain.input_count, len(chain.biases[-1])) > MAX_QUANTITIES:
        raise ModelError(
            place, f"{chain.input_count} inputs and {len(chain.biases[-1])} outputs", f"at most {MAX_QUANTITIES} each"
        )
    return chain
