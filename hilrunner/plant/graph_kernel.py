"""A network that is no plain chain, as a short program: dense layers, activations, sums of branches, layer normalisation.

Each step reads and writes registers, ranges of one scratch array; sizes, places and constants are data, so one machine code serves every
network. Slower than the generic kernel for the same layers, which is why chains do not use it.
"""

import math

import numpy as np

from hilrunner.base import compiled
from hilrunner.plant.generic_kernel import activate

from numba import carray, config, types  # isort: skip
from numba.core import cgutils  # isort: skip
from numba.extending import intrinsic  # isort: skip

REGISTERS_MAX = 4096  # float64 on the stack of the caller

STEP_GATHER = 0  # target[i] = source[order[i]] * factor[i]; constants: order, factor
STEP_DENSE = (
    1  # target = bias + weight @ source; `other`: width of the source; constants: bias, weight column by column
)
STEP_AFFINE = 2  # target = source * scale + offset; constants: scale, offset
STEP_ACTIVATE = 3  # target = activation(source); `other`: generic_kernel.ACTIVATION_*
STEP_ADD = 4  # of two registers; one of width 1 meets every number of the other
STEP_SUBTRACT = 5
STEP_MULTIPLY = 6
STEP_DIVIDE = 7
STEP_NORMALISE = 8  # (source - mean) / sqrt(variance + epsilon) * gain + shift; constants: epsilon, gain, shift
STEP_MEAN = 9  # one number; `width`: of the source
STEP_ROOT = 10  # square root

PROGRAM_HEAD = 3  # words: count of steps, register of the first input, register of the first output
STEP_SIZE = 8  # words: kind, source, other, target, width, place of the constants, width of source, width of other


def pack(steps: list[tuple], first_input: int, first_output: int) -> np.ndarray:
    """The words of a program, float64[n].

    Args:
        steps: (kind, source, other, target, width, constants float64[k], width of the source, width of other) each, in order.
        first_input, first_output: registers.
    """
    at = PROGRAM_HEAD + len(steps) * STEP_SIZE
    words, constants = [float(len(steps)), float(first_input), float(first_output)], []
    for kind, source, other, target, width, numbers, source_width, other_width in steps:
        words += [float(value) for value in (kind, source, other, target, width, at, source_width, other_width)]
        constants.append(np.asarray(numbers, float).ravel())
        at += len(constants[-1])
    return np.concatenate([words, *constants])


def constant_count(program: np.ndarray) -> int:
    """How many constants a program holds."""
    return len(program) - PROGRAM_HEAD - int(program[0]) * STEP_SIZE


@compiled.hot
def _dense(words, constants, registers, source, width_in, target, width):
    for r in range(width):
        registers[target + r] = words[constants + r]
    at = constants + width
    for j in range(width_in):
        value = registers[source + j]
        for r in range(width):
            registers[target + r] += words[at + r] * value
        at += width


@compiled.hot
def _normalise(words, constants, registers, source, target, width):
    mean = 0.0
    for i in range(width):
        mean += registers[source + i]
    mean /= width
    variance = 0.0
    for i in range(width):
        variance += (registers[source + i] - mean) ** 2
    scale = 1.0 / math.sqrt(variance / width + words[constants])
    for i in range(width):
        value = (registers[source + i] - mean) * scale
        registers[target + i] = value * words[constants + 1 + i] + words[constants + 1 + width + i]


@compiled.hot
def _two(kind, registers, source, source_width, other, other_width, target, width):
    for i in range(width):
        a = registers[source + (i if source_width > 1 else 0)]
        b = registers[other + (i if other_width > 1 else 0)]
        if kind == STEP_ADD:
            registers[target + i] = a + b
        elif kind == STEP_SUBTRACT:
            registers[target + i] = a - b
        elif kind == STEP_MULTIPLY:
            registers[target + i] = a * b
        else:
            registers[target + i] = a / b


@compiled.hot
def _one(kind, words, constants, registers, source, other, target, width):
    if kind == STEP_MEAN:
        total = 0.0
        for i in range(width):
            total += registers[source + i]
        registers[target] = total / width
        return
    for i in range(width):
        if kind == STEP_GATHER:
            value = registers[source + int(words[constants + i])] * words[constants + width + i]
        elif kind == STEP_AFFINE:
            value = registers[source + i] * words[constants + i] + words[constants + width + i]
        elif kind == STEP_ROOT:
            value = math.sqrt(registers[source + i]) if registers[source + i] >= 0.0 else math.nan
        else:
            value = activate(other, registers[source + i])
        registers[target + i] = value


@compiled.hot
def _run(words, start, registers):
    """Every step of the program at `start`, in order."""
    for step in range(int(words[start])):
        at = start + PROGRAM_HEAD + step * STEP_SIZE
        kind, source, other = int(words[at]), int(words[at + 1]), int(words[at + 2])
        target, width, constants = int(words[at + 3]), int(words[at + 4]), start + int(words[at + 5])
        if kind == STEP_DENSE:
            _dense(words, constants, registers, source, other, target, width)
        elif kind == STEP_NORMALISE:
            _normalise(words, constants, registers, source, target, width)
        elif STEP_ADD <= kind <= STEP_DIVIDE:
            _two(kind, registers, source, int(words[at + 6]), other, int(words[at + 7]), target, width)
        else:
            _one(kind, words, constants, registers, source, other, target, width)


@compiled.hot
def _forward(words, start, x, x_at, inputs, y, y_at, outputs, registers):
    first, last = int(words[start + 1]), int(words[start + 2])
    for i in range(inputs):
        registers[first + i] = x[x_at + i]
    _run(words, start, registers)
    for i in range(outputs):
        y[y_at + i] = registers[last + i]
    return 0


@intrinsic
def _stack_registers(typing):
    """Pointer to REGISTERS_MAX float64 on the stack of the caller; lives until it returns."""

    def generate(context, builder, sig, arguments):
        size = context.get_constant(types.intp, REGISTERS_MAX)
        return cgutils.alloca_once(builder, context.get_value_type(types.float64), size=size)

    return types.CPointer(types.float64)(), generate


if config.DISABLE_JIT:

    def forward_graph(words, start, x, x_at, inputs, y, y_at, outputs):
        """Evaluate; see the compiled twin below."""
        return _forward(words, start, x, x_at, inputs, y, y_at, outputs, np.zeros(REGISTERS_MAX))

else:

    @compiled.hot
    def forward_graph(words, start, x, x_at, inputs, y, y_at, outputs):
        """Evaluate the program packed at `start`: x[x_at : x_at + inputs] (read) -> y[y_at : y_at + outputs] (written)."""
        registers = carray(_stack_registers(), (REGISTERS_MAX,))
        return _forward(words, start, x, x_at, inputs, y, y_at, outputs, registers)
