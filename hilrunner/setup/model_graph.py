"""From an ONNX graph to layers: which nodes a multilayer perceptron may be written with, and what each one means.

A network is a chain of nodes from one graph input to one graph output. Elementwise constants before the first matrix are
its input scaling, those after the last its output scaling; every other linear node is folded into a layer.
"""

import math
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
from hilrunner.setup.model_constants import constants_of, numbers

ACTIVATIONS = {
    "Tanh": ACTIVATION_TANH,
    "Sigmoid": ACTIVATION_SIGMOID,
    "Relu": ACTIVATION_RELU,
    "Softplus": ACTIVATION_SOFTPLUS,
    "Elu": ACTIVATION_ELU,
    "Gelu": ACTIVATION_GELU,
    "Swish": ACTIVATION_SILU,
}
# change no number of one row
PASSED = {"Identity", "Dropout", "Cast", "Flatten", "Reshape", "Squeeze", "Unsqueeze", "Transpose"}


_KNOWN = {*ACTIVATIONS, *PASSED, "MatMul", "Gemm", "Add", "Sub", "Mul", "Div", "Scaler", "Conv", "BatchNormalization"}


@dataclass
class Chain:
    """One network as it is read, front to back."""

    input: str
    output: str
    input_count: int = 0
    shape: tuple[int, ...] | None = (
        None  # of one row where the last node has read it, without the rows; None: not known
    )
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
        self.place = place
        self.nodes = list(model.graph.node)
        self.constants = constants_of(place, model)
        self.maker = {name: index for index, node in enumerate(self.nodes) for name in node.output}
        self.inputs = [value.name for value in model.graph.input if value.name not in self.constants]
        self.outputs = [value.name for value in model.graph.output]
        self.row_shapes = {value.name: _row_shape(value) for value in model.graph.input}

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
            "MatMul, Gemm, Conv over the whole row, Add, Sub, Mul, Div, Concat, BatchNormalization, LayerNormalization and "
            + ", ".join(ACTIVATIONS),
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
            gate = self.gate(index)
            if gate is not None:
                sources = [gate]
            elif len(sources) != 1:
                raise self.refuse(index, f"joins {len(sources)} branches: not a chain of layers")
            name = sources[0]
            if len(steps) > 10_000:
                raise self.refuse(index, "the graph goes in a circle")
        return name, steps[::-1]

    def gate(self, index: int) -> str | None:
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
        shape = self.row_shapes.get(source)
        chain = Chain(source, output, input_count=math.prod(shape or (0,)), shape=shape)
        foreign = [index for index in steps if self.nodes[index].op_type not in _KNOWN]
        if foreign:
            named = "; ".join(self.where(index) for index in foreign[:8])
            raise self.error(named, "no part of a multilayer perceptron that can be ported")
        for index in steps:
            try:
                with np.errstate(all="ignore"):  # what is not finite is told of the whole network
                    self._read(chain, index)
            except (ValueError, IndexError, TypeError, OverflowError) as error:
                raise self.refuse(index, "its numbers do not fit the row before it") from error
        return _finished(self.place, chain)

    def _read(self, chain: Chain, index: int) -> None:
        node = self.nodes[index]
        kind = node.op_type
        if kind in PASSED:
            pass_row(self, chain, index)
            return
        if kind in ACTIVATIONS:
            check_activation(self, index)
            self._activate(chain, index, ACTIVATIONS[kind])
        elif self.gate(index) is not None:
            self._activate(chain, index, ACTIVATION_SILU)
        elif kind in ("MatMul", "Gemm", "Conv"):
            _dense(self, chain, index)
        elif kind == "BatchNormalization":
            _batch_normalisation(self, chain, index)
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


def _row_shape(value) -> tuple[int, ...] | None:
    """The shape of one row of a graph input: `[n, 5, 1, 1]` has rows of (5, 1, 1), `[5]` is one row; None: not told."""
    dimensions = [one.dim_value or 0 for one in value.type.tensor_type.shape.dim]
    row = dimensions[1:] if len(dimensions) > 1 else dimensions
    return tuple(row) if row and min(row) > 0 else None


def pass_row(graph: Graph, chain: Chain, index: int) -> None:
    """A node that may change the shape of a row and never the order of its numbers."""
    node, shape = graph.nodes[index], chain.shape
    if node.op_type == "Transpose":
        order = next((list(one.ints) for one in node.attribute if one.name == "perm"), None)
        if shape is None or order is None or sorted(order) != list(range(len(shape) + 1)):
            raise graph.refuse(index, "turns rows of unknown shape")
        full = (0, *shape)
        moved = [axis for axis in order if axis == 0 or full[axis] > 1]
        if moved != sorted(moved):
            raise graph.refuse(index, f"turns rows of shape {shape}: their numbers change places")
        chain.shape = tuple(full[axis] for axis in order if axis)
    elif node.op_type in ("Flatten", "Reshape", "Squeeze", "Unsqueeze"):
        chain.shape = None if shape is None else (math.prod(shape),)
        if node.op_type in ("Reshape", "Unsqueeze") and len(node.input) > 1 and node.input[1] in graph.constants:
            chain.shape = _reshaped(node.op_type, graph.constants[node.input[1]], shape)


def _reshaped(kind: str, wanted: np.ndarray, shape: tuple[int, ...] | None) -> tuple[int, ...] | None:
    """The shape of one row behind a Reshape or Unsqueeze that keeps the rows first; None: not known."""
    if shape is None:
        return None
    try:
        row = np.zeros((1, *shape))
        if kind == "Unsqueeze":
            return np.expand_dims(row, tuple(int(n) for n in wanted)).shape[1:]
        sizes = [int(n) for n in wanted]
        free = [row.shape[i] if n == 0 else n for i, n in enumerate(sizes)]
        return row.reshape([1, *free[1:]]).shape[1:] if len(free) > 1 else None
    except (ValueError, IndexError):
        return None


def check_activation(graph: Graph, index: int) -> None:
    node = graph.nodes[index]
    values = {attribute.name: attribute for attribute in node.attribute}
    for name in ("alpha", "beta"):
        if name in values and values[name].f != 1.0:
            raise graph.refuse(index, f"{name} = {values[name].f:g}; only 1 is ported")
    if "approximate" in values and values["approximate"].s not in (b"", b"none"):
        raise graph.refuse(index, "the tanh approximation of Gelu is not ported")


def row_vector(graph: Graph, chain: Chain, index: int, name: str) -> np.ndarray:
    """A constant that meets the signal number by number, float64[columns] or float64[1]."""
    value = numbers(graph.constants[name])
    if value.ndim <= 1 or (value.ndim == 2 and value.shape[0] == 1):
        return value.reshape(-1)
    if value.size == 1:
        return value.reshape(-1)
    try:  # of more dimensions: as it lies over one row
        return np.broadcast_to(value, (1, *(chain.shape or ()))).reshape(-1)
    except ValueError:
        raise graph.refuse(index, f"constant '{name}' of shape {value.shape} is not one number a column") from None


def _elementwise(graph: Graph, chain: Chain, index: int) -> None:
    node = graph.nodes[index]
    places = [place for place, name in enumerate(node.input) if name in graph.constants]
    if len(places) != 1:
        raise graph.refuse(index, "has no constant side")
    value = row_vector(graph, chain, index, node.input[places[0]])
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


def dense_of(graph: Graph, chain: Chain, index: int) -> tuple[np.ndarray, np.ndarray | None, tuple[int, ...]]:
    """The layer that a MatMul, Gemm or Conv is: weight float64[out, in], bias float64[out], float64[1] or None, and its rows' shape."""
    node = graph.nodes[index]
    if node.op_type == "Conv":
        return _convolution(graph, chain, index)
    weight_name = node.input[1]
    if weight_name not in graph.constants:
        raise graph.refuse(index, "multiplies two signals")
    weight = numbers(graph.constants[weight_name])
    bias = None
    if node.op_type == "Gemm":
        values = {attribute.name: attribute for attribute in node.attribute}
        if "transA" in values and values["transA"].i:
            raise graph.refuse(index, "transA = 1 mixes rows")
        weight = weight.T if not ("transB" in values and values["transB"].i) else weight
        weight = weight * (values["alpha"].f if "alpha" in values else 1.0)
        if len(node.input) > 2 and node.input[2]:
            bias = row_vector(graph, chain, index, node.input[2]) * (values["beta"].f if "beta" in values else 1.0)
    else:
        weight = weight.T
    if weight.ndim != 2:
        raise graph.refuse(index, f"weight of shape {weight.shape} is not a matrix")
    return weight, bias, (len(weight),)


def _dense(graph: Graph, chain: Chain, index: int) -> None:
    """One more layer."""
    weight, bias, shape = dense_of(graph, chain, index)
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
    chain.shape = shape


def _convolution(graph: Graph, chain: Chain, index: int) -> tuple[np.ndarray, np.ndarray | None, tuple[int, ...]]:
    """A convolution whose kernel covers the whole row is a layer: that is how MATLAB writes fully connected ones."""
    node = graph.nodes[index]
    kernel = graph.constants.get(node.input[1]) if len(node.input) > 1 else None
    if kernel is None or kernel.ndim < 3:
        raise graph.refuse(index, "has no constant kernel")
    values = {attribute.name: attribute for attribute in node.attribute}
    row = chain.shape
    if row is None or len(row) != kernel.ndim - 1:
        raise graph.refuse(index, f"meets rows of shape {row or 'unknown'}, its kernel has shape {kernel.shape}")
    if "group" in values and values["group"].i != 1 or kernel.shape[1:] != row:
        raise graph.refuse(index, f"its kernel of shape {kernel.shape} does not cover a whole row of shape {row}")
    padded = "auto_pad" in values and values["auto_pad"].s not in (b"NOTSET", b"VALID")
    if padded or "pads" in values and any(values["pads"].ints):
        raise graph.refuse(index, "pads its rows")
    bias = numbers(graph.constants[node.input[2]]).reshape(-1) if _has_constant(graph, node, 2) else None
    if bias is None and len(node.input) > 2 and node.input[2]:
        raise graph.refuse(index, "has a bias that is no constant")
    return numbers(kernel).reshape(len(kernel), -1), bias, (len(kernel), *([1] * (kernel.ndim - 2)))


def _batch_normalisation(graph: Graph, chain: Chain, index: int) -> None:
    """As it was left after training: a scale and an offset a channel."""
    node = graph.nodes[index]
    if not all(_has_constant(graph, node, place) for place in (1, 2, 3, 4)):
        raise graph.refuse(index, "has numbers that are no constants")
    values = {attribute.name: attribute for attribute in node.attribute}
    if "training_mode" in values and values["training_mode"].i:
        raise graph.refuse(index, "is in training mode: export the network after model.eval()")
    gain, shift, mean, variance = (numbers(graph.constants[name]).reshape(-1) for name in node.input[1:5])
    epsilon = values["epsilon"].f if "epsilon" in values else 1e-5
    scale = gain / np.sqrt(variance + epsilon)
    offset = shift - mean * scale
    repeats = math.prod(chain.shape[1:]) if chain.shape else 1
    _scale(chain, np.repeat(scale, repeats), np.repeat(offset, repeats))


def _has_constant(graph: Graph, node, place: int) -> bool:
    return len(node.input) > place and node.input[place] in graph.constants


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
    for what, values, width in (
        ("input scaling", (chain.input_offset, chain.input_scale), chain.input_count),
        ("output scaling", (chain.scale, chain.offset), len(chain.biases[-1])),
    ):
        if any(value is not None and value.shape not in ((1,), (width,)) for value in values):
            raise ModelError(place, f"its {what} is not one number a column of {width}", remedy="export it again")
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
