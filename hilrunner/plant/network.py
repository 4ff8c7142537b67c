"""Small neural networks in compiled code: where their numbers lie and how one is evaluated.

A `NetworkBank` holds every network of every axis in flat arrays (constant after arming). Three kernels:
the vector kernel for three tanh layers of [25, 10, 20], a generic one for any other multilayer perceptron,
and a foreign one that calls through an address (onnxruntime in the loop).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hilrunner.base import compiled
from hilrunner.plant import foreign_call, generic_kernel, vector_kernel
from hilrunner.plant.foreign_call import FOREIGN_SIZE
from hilrunner.plant.generic_kernel import ACTIVATION_LINEAR, ACTIVATION_TANH, MAX_LAYERS

KERNEL_NONE = 0
KERNEL_VECTOR = 1  # [25, 10, 20] tanh, linear output
KERNEL_GENERIC = 2
KERNEL_FOREIGN = 3
KERNEL_NAMES = ("none", "vector", "generic", "onnxruntime")

RECIPE_NONE = 0
RECIPE_FLOW = 1  # networks give valve flows per unit command; volumes and mechanics are analytic
RECIPE_PAPER = 2  # network gives pressure rates from (x, v, p1, p2, u)
RECIPE_NAMES = ("none", "flow", "paper")

# which network of an axis; column of NetworkBank.axis_slot
ROLE_FLOW = 0  # circuit paper, recipe flow
ROLE_RATES = 0  # circuit paper, recipe paper
ROLE_SUPPLY = 0  # circuit lift: branch that is connected to the pump
ROLE_RETURN = 1  # circuit lift: branch that is connected to the tank
ROLE_COUNT = 2
ROLES = {"flow": ROLE_FLOW, "rates": ROLE_RATES, "supply": ROLE_SUPPLY, "return": ROLE_RETURN}

MAX_QUANTITIES = 8  # inputs or outputs of one network

# columns of NetworkBank.shape
SHAPE_KERNEL = 0
SHAPE_INPUTS = 1
SHAPE_OUTPUTS = 2
SHAPE_START = 3  # first word of the network in NetworkBank.weights
SHAPE_LAYERS = 4
SHAPE_ROWS = 5  # MAX_LAYERS + 1 columns: inputs, then rows of each layer
SHAPE_ACTIVATION = SHAPE_ROWS + MAX_LAYERS + 1  # MAX_LAYERS columns
SHAPE_SIZE = SHAPE_ACTIVATION + MAX_LAYERS


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
        return sum(w.size for w in self.weights) + sum(b.size for b in self.biases)

    @property
    def kernel(self) -> int:
        """Which compiled kernel evaluates it."""
        if self.foreign is not None:
            return KERNEL_FOREIGN
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

    shape: np.ndarray  # (slots, SHAPE_SIZE) int64
    weights: np.ndarray  # (words,) float64, packed as the kernel wants them
    ranges: np.ndarray  # (slots, 2, MAX_QUANTITIES) float64: training low, high
    foreign: np.ndarray  # (slots, FOREIGN_SIZE) int64: addresses
    axis_slot: np.ndarray  # (axes, ROLE_COUNT) int64; -1: none
    axis_recipe: np.ndarray  # (axes,) int64 RECIPE_*


def assemble_bank(axes: Sequence[SurrogateNetworks | None]) -> NetworkBank:
    """Pack the networks of every axis; an axis without networks (engine reference) gets slots of -1."""
    networks: list[Mlp] = []
    axis_slot = np.full((max(len(axes), 1), ROLE_COUNT), -1, np.int64)
    axis_recipe = np.zeros(max(len(axes), 1), np.int64)
    for index, axis in enumerate(axes):
        if axis is None:
            continue
        axis_recipe[index] = axis.recipe
        for role, network in axis.networks.items():
            axis_slot[index, ROLES[role]] = len(networks)
            networks.append(network)
    slots = max(len(networks), 1)
    shape = np.zeros((slots, SHAPE_SIZE), np.int64)
    ranges = np.zeros((slots, 2, MAX_QUANTITIES))
    foreign = np.zeros((slots, FOREIGN_SIZE), np.int64)
    parts: list[np.ndarray] = []
    start = 0
    for slot, network in enumerate(networks):
        packed = _pack(network)
        _write_shape(shape[slot], network, start)
        ranges[slot, 0, : network.input_count] = network.input_low
        ranges[slot, 1, : network.input_count] = network.input_high
        if network.foreign is not None:
            foreign[slot] = network.foreign
        # every network starts on a 64-byte line
        packed = np.concatenate([packed, np.zeros(-len(packed) % 8)])
        parts.append(packed)
        start += len(packed)
    return NetworkBank(shape, _aligned(parts), ranges, foreign, axis_slot, axis_recipe)


def _pack(network: Mlp) -> np.ndarray:
    scaling = (network.input_offset, network.input_scale, network.output_scale, network.output_offset)
    if network.kernel == KERNEL_VECTOR:
        return vector_kernel.pack(network.weights, network.biases, *scaling)
    if network.kernel == KERNEL_FOREIGN:
        return np.zeros(0)
    return generic_kernel.pack(network.weights, network.biases, *scaling)


def _write_shape(row: np.ndarray, network: Mlp, start: int) -> None:
    row[SHAPE_KERNEL] = network.kernel
    row[SHAPE_INPUTS] = network.input_count
    row[SHAPE_OUTPUTS] = network.output_count
    row[SHAPE_START] = start
    if network.kernel == KERNEL_FOREIGN:
        return
    row[SHAPE_LAYERS] = len(network.weights)
    row[SHAPE_ROWS : SHAPE_ROWS + len(network.layer_sizes)] = network.layer_sizes
    row[SHAPE_ACTIVATION : SHAPE_ACTIVATION + len(network.activations)] = network.activations


def _aligned(parts: list[np.ndarray]) -> np.ndarray:
    """One float64 array that starts on a 64-byte line, so that vector loads cross no line."""
    total = sum(len(part) for part in parts)
    raw = np.zeros(total + 8)
    first = (-raw.ctypes.data % 64) // 8
    out = raw[first : first + total]
    position = 0
    for part in parts:
        out[position : position + len(part)] = part
        position += len(part)
    return out


@compiled.hot
def forward(bank, slot, x, y):
    """Evaluate one network: x float64[inputs] (read) -> y float64[outputs] (written); 0, or 1 if onnxruntime failed.

    A NaN among the inputs gives NaN outputs. No range check: see `outside_training`.
    """
    row = bank.shape[slot]
    kernel = row[SHAPE_KERNEL]
    if kernel == KERNEL_VECTOR:
        vector_kernel.forward_vector(bank.weights, row[SHAPE_START], x, y, row[SHAPE_INPUTS], row[SHAPE_OUTPUTS])
        return 0
    if kernel == KERNEL_GENERIC:
        generic_kernel.forward_generic(
            bank.weights, row[SHAPE_START], row[SHAPE_LAYERS], row[SHAPE_ROWS:], row[SHAPE_ACTIVATION:], x, y
        )
        return 0
    return foreign_call.forward_foreign(bank.foreign[slot], x, y, row[SHAPE_INPUTS], row[SHAPE_OUTPUTS])


@compiled.hot
def outside_training(bank, slot, x):
    """True if an input lies outside the range the network was trained on (or is not a number)."""
    outside = False
    for i in range(bank.shape[slot, SHAPE_INPUTS]):
        outside |= not (bank.ranges[slot, 0, i] <= x[i] <= bank.ranges[slot, 1, i])
    return outside


@compiled.entry
def forward_many(bank, slot, inputs, outputs):
    """Evaluate one network on inputs float64[n, inputs] into outputs float64[n, outputs]; the count of failures."""
    failures = 0
    for i in range(inputs.shape[0]):
        failures += forward(bank, slot, inputs[i], outputs[i])
    return failures
