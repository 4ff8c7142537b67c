"""From an ONNX graph with branches to a program of plant.graph_kernel: residual links, layer normalisation, concatenation.

`model_graph` reads plain chains and folds what can be folded; what it cannot read because two branches meet comes here, node by node.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from hilrunner.base.errors import ModelError
from hilrunner.plant import graph_kernel as kernel
from hilrunner.plant.head import MAX_QUANTITIES
from hilrunner.setup.model_constants import numbers
from hilrunner.setup.model_graph import (
    ACTIVATIONS,
    PASSED,
    Chain,
    Graph,
    check_activation,
    dense_of,
    pass_row,
    row_vector,
)

PROGRAM_NODES = ("LayerNormalization", "Concat", "ReduceMean", "Pow", "Sqrt")
_STEPS_MAX, _CONSTANTS_MAX = 256, 2_000_000
_BINARY = {"Add": kernel.STEP_ADD, "Sub": kernel.STEP_SUBTRACT, "Mul": kernel.STEP_MULTIPLY, "Div": kernel.STEP_DIVIDE}


@dataclass
class _Value:
    """A signal: its register, and the shape of one row of it."""

    register: int
    width: int
    shape: tuple[int, ...] | None


@dataclass
class Program:
    """One network as it is read; `columns` and `factors` come on top at both ends (`finished`)."""

    input: str
    output: str
    input_count: int
    output_count: int = 0
    dense_count: int = 0
    steps: list[tuple] = field(default_factory=list)
    used: int = 0

    def describe(self) -> str:
        """One line: how the program was understood."""
        return (
            f"{self.input_count} -> {self.output_count} by {len(self.steps)} steps, {self.dense_count} of them layers"
        )

    def register(self, width: int) -> int:
        """A new range of registers."""
        self.used += width
        return self.used - width

    def step(self, kind: int, source: _Value, width: int, constants=(), other: int = 0, other_width: int = 0) -> _Value:
        """Add one step; its result."""
        target = self.register(1 if kind == kernel.STEP_MEAN else width)
        self.steps.append((kind, source.register, other, target, width, constants, source.width, other_width))
        return _Value(target, 1 if kind == kernel.STEP_MEAN else width, None)


def needs_program(graph: Graph, output: str) -> bool:
    """Whether an output cannot be read as a chain: two branches meet, or a node only programs know."""
    waiting, seen = [output], set()
    while waiting:
        index = graph.maker.get(waiting.pop())
        if index is None or index in seen:
            continue
        seen.add(index)
        node = graph.nodes[index]
        signals = [name for name in node.input if name and name not in graph.constants]
        if node.op_type in PROGRAM_NODES or len(signals) > 1 and graph.gate(index) is None:
            return True
        waiting += signals
    return False


def program_of(graph: Graph, output: str) -> tuple[Program, int]:
    """Read the network that ends in a graph output; (program, register of its first output); ModelError."""
    order, sources = _order(graph, output)
    if len(sources) != 1:
        raise ModelError(graph.place, f"output '{output}' needs {len(sources)} inputs", "one input a network")
    (source,) = sources
    shape = graph.row_shapes.get(source)
    if shape is None:
        raise ModelError(
            f"{graph.place}: input '{source}'", "has rows of unknown width", remedy="export it with the width of a row"
        )
    program = Program(source, output, math.prod(shape))
    values = {source: _Value(program.register(program.input_count), program.input_count, shape)}
    for index in order:
        try:
            with np.errstate(all="ignore"):
                values[graph.nodes[index].output[0]] = _read(graph, program, values, index)
        except (ValueError, IndexError, TypeError, OverflowError, KeyError) as error:
            raise graph.refuse(index, "its numbers do not fit the rows before it") from error
        _check_size(graph, program)
    last = values[output]
    program.output_count = last.width
    if not program.dense_count:
        raise ModelError(f"{graph.place}: output '{output}'", "no MatMul or Gemm: not a network", "layers")
    return program, last.register


def finished(program: Program, last: int, inputs: list[int], in_factors, outputs: list[int], out_factors) -> np.ndarray:
    """The words of the kernel, its columns in the reduced model's order and in SI.

    Args:
        last: register of the first output as the file has it.
        inputs, outputs: for each of the reduced model's quantities the file's column.
        in_factors, out_factors: the file's units in SI, by column of the file.
    """
    given = _Value(program.register(program.input_count), program.input_count, None)
    order = np.empty(program.input_count)
    order[inputs] = np.arange(program.input_count)  # a column of the file takes this input
    before = (
        kernel.STEP_GATHER, given.register, 0, 0, program.input_count,
        np.concatenate([order, 1.0 / np.asarray(in_factors, float)]), program.input_count, 0,
    )  # fmt: skip
    columns = np.asarray(outputs)
    after = program.step(
        kernel.STEP_GATHER, _Value(last, program.output_count, None), len(columns),
        np.concatenate([columns.astype(float), np.asarray(out_factors, float)[columns]]),
    )  # fmt: skip
    return kernel.pack([before, *program.steps], given.register, after.register)


def _order(graph: Graph, output: str) -> tuple[list[int], list[str]]:
    """Nodes an output depends on, each behind those it needs, and the graph inputs among them."""
    needed, sources, waiting = set(), [], [output]
    while waiting:
        name = waiting.pop()
        if name in graph.constants or not name:
            continue
        if name in graph.inputs:
            sources.append(name)
            continue
        if name not in graph.maker:
            raise ModelError(graph.place, f"output '{output}' depends on '{name}', which nothing makes", "a whole file")
        if graph.maker[name] not in needed:
            needed.add(graph.maker[name])
            waiting += graph.nodes[graph.maker[name]].input
    order, made = [], set(graph.constants) | set(graph.inputs) | {""}
    while len(order) < len(needed):
        ready = [i for i in sorted(needed - set(order)) if all(name in made for name in graph.nodes[i].input)]
        if not ready:
            raise graph.refuse(min(needed - set(order)), "the graph goes in a circle")
        order += ready
        made |= {name for i in ready for name in graph.nodes[i].output}
    return order, list(dict.fromkeys(sources))


def _check_size(graph: Graph, program: Program) -> None:
    constants = sum(np.size(step[5]) for step in program.steps)
    for found, most, what in (
        (program.used + 2 * MAX_QUANTITIES, kernel.REGISTERS_MAX, "values between its layers"),
        (len(program.steps), _STEPS_MAX, "steps"),
        (constants, _CONSTANTS_MAX, "constants"),
    ):
        if found > most:
            raise ModelError(graph.place, f"{found} {what}", f"at most {most}", "run it with --engine onnx")


def _read(graph: Graph, program: Program, values: dict[str, _Value], index: int) -> _Value:
    node = graph.nodes[index]
    kind = node.op_type
    signals = [values[name] for name in node.input if name and name not in graph.constants]
    attributes = {one.name: one for one in node.attribute}
    first = signals[0] if signals else None
    if kind in PASSED:
        chain = Chain("", "", shape=first.shape)
        pass_row(graph, chain, index)
        return _Value(first.register, first.width, chain.shape)
    if kind in ACTIVATIONS:
        check_activation(graph, index)
        made = program.step(kernel.STEP_ACTIVATE, first, first.width, other=ACTIVATIONS[kind])
    elif kind in ("MatMul", "Gemm", "Conv"):
        return _layer(graph, program, first, index)
    elif kind in _BINARY:
        made = _binary(graph, program, values, index)
    elif kind == "LayerNormalization":
        made = _layer_normalisation(graph, program, first, index, attributes)
    elif kind == "BatchNormalization":
        gain, shift, mean, variance = (numbers(graph.constants[name]).reshape(-1) for name in node.input[1:5])
        scale = gain / np.sqrt(variance + (attributes["epsilon"].f if "epsilon" in attributes else 1e-5))
        made = _affine(program, first, scale, shift - mean * scale)
    elif kind == "ReduceMean":
        axes = graph.constants[node.input[1]] if len(node.input) > 1 else np.array(attributes["axes"].ints)
        if len(first.shape or ()) != 1 or list(np.ravel(axes)) not in ([-1], [1]):
            raise graph.refuse(index, "takes the mean of something else than a row")
        return _Value(program.step(kernel.STEP_MEAN, first, first.width).register, 1, (1,))
    elif kind == "Pow" and float(numbers(graph.constants[node.input[1]]).reshape(-1)[0]) == 2.0:
        made = program.step(kernel.STEP_MULTIPLY, first, first.width, other=first.register, other_width=first.width)
    elif kind == "Sqrt":
        made = program.step(kernel.STEP_ROOT, first, first.width)
    elif kind == "Concat" and len(signals) == len(node.input):
        return _concatenated(graph, program, signals, index, attributes["axis"].i)
    else:
        raise graph.refuse(index, "no part of a network that can be ported")
    return _Value(made.register, made.width, first.shape if made.width == first.width else (made.width,))


def _layer(graph: Graph, program: Program, first: _Value, index: int) -> _Value:
    chain = Chain("", "", input_count=first.width, shape=first.shape)
    weight, bias, shape = dense_of(graph, chain, index)
    if weight.shape[1] != first.width:
        raise graph.refuse(index, f"takes {weight.shape[1]} columns, gets {first.width}")
    bias = np.zeros(len(weight)) if bias is None else np.broadcast_to(bias, (len(weight),))
    program.dense_count += 1
    constants = np.concatenate([bias, weight.T.ravel()])
    made = program.step(kernel.STEP_DENSE, first, len(weight), constants, other=first.width)
    return _Value(made.register, made.width, shape)


def _binary(graph: Graph, program: Program, values: dict[str, _Value], index: int) -> _Value:
    node = graph.nodes[index]
    left, right = node.input
    if left not in graph.constants and right not in graph.constants:
        a, b = values[left], values[right]
        if a.width != b.width and 1 not in (a.width, b.width):
            raise graph.refuse(index, f"joins rows of {a.width} and {b.width} numbers")
        width = max(a.width, b.width)
        made = program.step(_BINARY[node.op_type], a, width, other=b.register, other_width=b.width)
        return made
    signal = values[right if left in graph.constants else left]
    chain = Chain("", "", shape=signal.shape)
    value = row_vector(graph, chain, index, left if left in graph.constants else right)
    one, none = np.ones(1), np.zeros(1)
    kind, constant_first = node.op_type, left in graph.constants
    if kind == "Add":
        return _affine(program, signal, one, value)
    if kind == "Sub":
        return _affine(program, signal, -one if constant_first else one, value if constant_first else -value)
    if kind == "Mul":
        return _affine(program, signal, value, none)
    if constant_first:
        raise graph.refuse(index, "divides a constant by the signal")
    return _affine(program, signal, 1.0 / value, none)


def _affine(program: Program, signal: _Value, scale: np.ndarray, offset: np.ndarray) -> _Value:
    width = max(signal.width, len(scale), len(offset))
    if width != signal.width:
        raise ValueError("a row of one number meets several constants")
    constants = np.concatenate([np.broadcast_to(scale, (width,)), np.broadcast_to(offset, (width,))])
    return program.step(kernel.STEP_AFFINE, signal, width, constants)


def _layer_normalisation(graph: Graph, program: Program, first: _Value, index: int, attributes: dict) -> _Value:
    node = graph.nodes[index]
    axis = attributes["axis"].i if "axis" in attributes else -1
    if len(first.shape or ()) != 1 or axis not in (-1, 1):
        raise graph.refuse(index, "normalises something else than a row")
    gain = numbers(graph.constants[node.input[1]]).reshape(-1)
    shift = (
        numbers(graph.constants[node.input[2]]).reshape(-1) if len(node.input) > 2 and node.input[2] else np.zeros(1)
    )
    epsilon = attributes["epsilon"].f if "epsilon" in attributes else 1e-5
    width = first.width
    constants = np.concatenate([[epsilon], np.broadcast_to(gain, (width,)), np.broadcast_to(shift, (width,))])
    return program.step(kernel.STEP_NORMALISE, first, width, constants)


def _concatenated(graph: Graph, program: Program, signals: list[_Value], index: int, axis: int) -> _Value:
    if axis not in (-1, 1) or any(len(one.shape or ()) != 1 for one in signals):
        raise graph.refuse(index, "joins something else than rows")
    width = sum(one.width for one in signals)
    target = program.register(width)
    at = target
    for one in signals:
        constants = np.concatenate([np.arange(one.width), np.ones(one.width)])
        program.steps.append((kernel.STEP_GATHER, one.register, 0, at, one.width, constants, one.width, 0))
        at += one.width
    return _Value(target, width, (width,))
