"""Small neural networks in compiled code: where their numbers lie and how one is evaluated.

A `NetworkBank` holds every network of every axis in flat arrays (constant after arming). Four kernels:
the vector kernel for three tanh layers of [25, 10, 20], a generic one for any other multilayer perceptron, one that runs a
program for networks with branches, and a foreign one that calls through an address (onnxruntime in the loop).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hilrunner.base import compiled
from hilrunner.plant import foreign_call, generic_kernel, graph_kernel, vector_kernel
from hilrunner.plant.foreign_call import FOREIGN_SIZE
from hilrunner.plant.generic_kernel import ACTIVATION_LINEAR, ACTIVATION_TANH
from hilrunner.plant.head import (
    FORM_PINNED,
    FORM_PLAIN,
    FORM_SHARE,
    HEAD_ACTIVATION,
    HEAD_ADDRESS,
    HEAD_FOREIGN,
    HEAD_FORM,
    HEAD_HIGH,
    HEAD_INPUTS,
    HEAD_KERNEL,
    HEAD_LAYERS,
    HEAD_LOW,
    HEAD_OUTPUTS,
    HEAD_ROWS,
    HEAD_SIZE,
    KERNEL_FOREIGN,
    KERNEL_GENERIC,
    KERNEL_GRAPH,
    KERNEL_VECTOR,
    MAX_QUANTITIES,
)
from hilrunner.plant.kernels import call_kernel, kernel_address

__all__ = [
    "FORM_PINNED",
    "FORM_PLAIN",
    "FORM_SHARE",
    "Mlp",
    "NetworkBank",
    "SurrogateNetworks",
    "assemble_bank",
    "forward_at",
]

RECIPE_NONE = 0
RECIPE_FLOW = 1  # networks give valve flows per unit command; volumes and mechanics are analytic
RECIPE_PAPER = 2  # network gives pressure rates from (x, v, p1, p2, u)
RECIPE_NAMES = ("none", "flow", "paper")

# which network of an axis; column of NetworkBank.axis_start
ROLE_FLOW = 0  # circuit paper, recipe flow
ROLE_RATES = 0  # circuit paper, recipe paper
ROLE_SUPPLY = 0  # circuit lift: branch that is connected to the pump
ROLE_RETURN = 1  # circuit lift: branch that is connected to the tank
ROLE_COUNT = 2
ROLES = {
    "flow": ROLE_FLOW,
    "rates": ROLE_RATES,
    "supply": ROLE_SUPPLY,
    "return": ROLE_RETURN,
}


@dataclass(frozen=True)
class Mlp:
    """One multilayer perceptron: y = output_scale * layers((x - input_offset) * input_scale) + output_offset.

    Args:
        weights: float64[out, in] a layer.
        biases: float64[out] a layer.
        activations: generic_kernel.ACTIVATION_* a layer; the last is usually linear.
        input_offset, input_scale, output_scale, output_offset: float64, the normalisation.
        input_low, input_high: training range, raw inputs; outside it FLAG_OUTSIDE_TRAINING is raised.
        input_names, output_names: quantities with their units last.
        form: FORM_*, for role "flow": the quantities it is asked in.
        foreign: addresses for onnxruntime in the loop (foreign_call), None for the compiled kernels.
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    activations: tuple[int, ...]
    input_offset: np.ndarray
    input_scale: np.ndarray
    output_scale: np.ndarray
    output_offset: np.ndarray
    input_low: np.ndarray
    input_high: np.ndarray
    input_names: tuple[str, ...] = ()
    output_names: tuple[str, ...] = ()
    foreign: np.ndarray | None = None
    foreign_layout: np.ndarray | None = None  # foreign_call.layout
    form: int = FORM_SHARE
    program: np.ndarray | None = (
        None  # graph_kernel's words, for a network that is no chain; weights and biases are empty then
    )

    @property
    def input_count(self) -> int:
        """Number of inputs."""
        return len(self.input_low)

    @property
    def output_count(self) -> int:
        """Number of outputs."""
        return len(self.output_scale)

    @property
    def layer_sizes(self) -> tuple[int, ...]:
        """Inputs, then the rows of every layer."""
        return (self.input_count, *(len(bias) for bias in self.biases))

    @property
    def parameter_count(self) -> int:
        """Weights and biases."""
        if self.program is not None:
            return graph_kernel.constant_count(self.program)
        return sum(w.size for w in self.weights) + sum(b.size for b in self.biases)

    @property
    def kernel(self) -> int:
        """Which compiled kernel evaluates it."""
        if self.foreign is not None:
            return KERNEL_FOREIGN
        if self.program is not None:
            return KERNEL_GRAPH
        tanh = (ACTIVATION_TANH,) * 3 + (ACTIVATION_LINEAR,)
        if self.layer_sizes[1:-1] == vector_kernel.HIDDEN and self.activations == tanh:
            return KERNEL_VECTOR
        return KERNEL_GENERIC


@dataclass(frozen=True)
class SurrogateNetworks:
    """The networks one axis needs, by role, and how the reduced model uses them."""

    recipe: int  # RECIPE_*
    networks: Mapping[str, Mlp]  # key of ROLES -> network
    circuit: str = ""
    source: str = ""  # file name and hash, for logs
    keep_alive: object = field(default=None, compare=False, repr=False)  # owner of foreign addresses

    def __getstate__(self):
        # addresses mean nothing in another process: what is pickled are the numbers
        state = dict(self.__dict__)
        state["keep_alive"] = None
        return state


class NetworkBank(NamedTuple):
    """Every network of every axis; all arrays constant after arming."""

    words: np.ndarray  # (n,) float64: heads and packed numbers, every network on a 64-byte line
    axis_start: np.ndarray  # (axes, ROLE_COUNT) int64: where an axis' network begins in `words`; -1: none
    axis_recipe: np.ndarray  # (axes,) int64 RECIPE_*


def assemble_bank(axes: Sequence[SurrogateNetworks | None]) -> NetworkBank:
    """Pack the networks of every axis; an axis without networks (engine reference) gets starts of -1."""
    axis_start = np.full((max(len(axes), 1), ROLE_COUNT), -1, np.int64)
    axis_recipe = np.zeros(max(len(axes), 1), np.int64)
    parts: list[np.ndarray] = [np.zeros(8)]
    for index, axis in enumerate(axes):
        if axis is None:
            continue
        axis_recipe[index] = axis.recipe
        for role, network in axis.networks.items():
            axis_start[index, ROLES[role]] = sum(len(part) for part in parts)
            packed = np.concatenate([_head(network), _pack(network)])
            parts.append(np.concatenate([packed, np.zeros(-len(packed) % 8)]))
    return NetworkBank(_aligned(np.concatenate(parts)), axis_start, axis_recipe)


def _head(network: Mlp) -> np.ndarray:
    head = np.zeros(HEAD_SIZE)
    head[HEAD_KERNEL] = network.kernel
    head[HEAD_INPUTS] = network.input_count
    head[HEAD_OUTPUTS] = network.output_count
    head[HEAD_FORM] = network.form
    head[HEAD_ADDRESS] = kernel_address(network.kernel)
    head[HEAD_LOW : HEAD_LOW + network.input_count] = network.input_low
    head[HEAD_HIGH : HEAD_HIGH + network.input_count] = network.input_high
    if network.foreign is not None:
        head[HEAD_FOREIGN : HEAD_FOREIGN + FOREIGN_SIZE] = network.foreign
        return head
    if network.program is not None:
        return head
    head[HEAD_LAYERS] = len(network.weights)
    head[HEAD_ROWS : HEAD_ROWS + len(network.layer_sizes)] = network.layer_sizes
    head[HEAD_ACTIVATION : HEAD_ACTIVATION + len(network.activations)] = network.activations
    return head


def _pack(network: Mlp) -> np.ndarray:
    scaling = (network.input_offset, network.input_scale, network.output_scale, network.output_offset)
    if network.kernel == KERNEL_VECTOR:
        return vector_kernel.pack(network.weights, network.biases, *scaling)
    if network.kernel == KERNEL_FOREIGN:
        straight = (range(network.input_count), np.ones(network.input_count))
        plain = foreign_call.layout(*straight, range(network.output_count), np.ones(network.output_count))
        return plain if network.foreign_layout is None else network.foreign_layout
    if network.kernel == KERNEL_GRAPH:
        return network.program
    return generic_kernel.pack(network.weights, network.biases, *scaling)


def _aligned(words: np.ndarray) -> np.ndarray:
    """The same numbers from a 64-byte line on, so that vector loads cross no line."""
    raw = np.zeros(len(words) + 8)
    first = (-raw.ctypes.data % 64) // 8
    out = raw[first : first + len(words)]
    out[:] = words
    return out


@compiled.hot
def forward_at(words, start, work, x_at, y_at):
    """Evaluate the network at `start` on work[x_at : x_at + inputs] into work[y_at : y_at + outputs].

    Args:
        words: NetworkBank.words; start: an entry of NetworkBank.axis_start.
        work: float64, read at x_at and written at y_at.

    Returns:
        0, or 1 if onnxruntime failed. A NaN among the inputs gives NaN outputs. No range check: see `outside_training`.
    """
    return call_kernel(words, start, work, x_at, y_at, HEAD_ADDRESS)


@compiled.hot
def outside_training(words, start, work, x_at):
    """True if an input lies outside the range the network was trained on (or is not a number)."""
    outside = False
    for i in range(int(words[start + HEAD_INPUTS])):
        value = work[x_at + i]
        outside |= not (words[start + HEAD_LOW + i] <= value <= words[start + HEAD_HIGH + i])
    return outside


@compiled.entry
def forward_many(words, start, inputs, outputs):
    """Evaluate one network on inputs float64[n, inputs] into outputs float64[n, outputs]; the count of failures."""
    work = np.zeros(2 * MAX_QUANTITIES)
    failures = 0
    for i in range(inputs.shape[0]):
        for k in range(inputs.shape[1]):  # slices would compile the words of their error, which takes seconds
            work[k] = inputs[i, k]
        failures += forward_at(words, start, work, 0, MAX_QUANTITIES)
        for k in range(outputs.shape[1]):
            outputs[i, k] = work[MAX_QUANTITIES + k]
    return failures
