"""Any multilayer perceptron in compiled code: layer sizes and activations are data.

Slower than the vector kernel, for networks made elsewhere. Weights lie column by column, so that the inner loop
runs over the rows of one layer and vectorises.
"""

import math

import numpy as np

from hilrunner.base import compiled

from numba import carray, config, types  # isort: skip
from numba.core import cgutils  # isort: skip
from numba.extending import intrinsic  # isort: skip

MAX_LAYERS = 8
MAX_WIDTH = 512  # rows of one layer; two such buffers live on the stack

ACTIVATION_LINEAR = 0
ACTIVATION_TANH = 1
ACTIVATION_SIGMOID = 2
ACTIVATION_RELU = 3
ACTIVATION_SILU = 4  # x * sigmoid(x), also called swish
ACTIVATION_SOFTPLUS = 5
ACTIVATION_ELU = 6  # alpha 1
ACTIVATION_GELU = 7  # exact, with erf
ACTIVATION_NAMES = ("linear", "tanh", "sigmoid", "relu", "silu", "softplus", "elu", "gelu")


def pack(weights, biases, input_offset, input_scale, output_scale, output_offset) -> np.ndarray:
    """The network's numbers in the order `forward_generic` reads them, float64[n].

    Input offset and scale, a bias and the weight columns a layer, output scale and offset.
    """
    parts = [np.asarray(input_offset, float), np.asarray(input_scale, float)]
    for weight, bias in zip(weights, biases, strict=True):
        parts += [np.asarray(bias, float), np.asarray(weight, float).T.ravel()]
    parts += [np.asarray(output_scale, float), np.asarray(output_offset, float)]
    return np.concatenate(parts)


@compiled.hot
def activate(kind, value):
    """One activation of one value; `kind` is ACTIVATION_*."""
    if kind == ACTIVATION_TANH:
        return math.tanh(value)
    if kind == ACTIVATION_SIGMOID:
        return 0.5 + 0.5 * math.tanh(0.5 * value)
    if kind == ACTIVATION_RELU:
        return value if value > 0.0 or value != value else 0.0
    if kind == ACTIVATION_SILU:
        return value * (0.5 + 0.5 * math.tanh(0.5 * value))
    if kind == ACTIVATION_SOFTPLUS:
        return max(value, 0.0) + math.log1p(math.exp(-abs(value)))
    if kind == ACTIVATION_ELU:
        return value if value > 0.0 else math.expm1(value)
    if kind == ACTIVATION_GELU:
        return 0.5 * value * (1.0 + math.erf(value * math.sqrt(0.5)))
    return value


@intrinsic
def _stack_words(typing, count):
    """Pointer to `count` (a literal) float64 on the stack of the caller; lives until it returns."""
    if not isinstance(count, types.IntegerLiteral):
        return None
    signature = types.CPointer(types.float64)(count)

    def generate(context, builder, sig, arguments):
        size = context.get_constant(types.intp, sig.args[0].literal_value)
        return cgutils.alloca_once(builder, context.get_value_type(types.float64), size=size)

    return signature, generate


@compiled.hot
def _forward(words, start, rows_at, activations_at, layer_count, x, x_at, y, y_at, a, b):
    inputs = int(words[rows_at])
    at = start
    for i in range(inputs):
        a[i] = (x[x_at + i] - words[at + i]) * words[at + inputs + i]
    at += 2 * inputs
    for layer in range(layer_count):
        width_in, width_out = int(words[rows_at + layer]), int(words[rows_at + layer + 1])
        for r in range(width_out):
            b[r] = words[at + r]
        at += width_out
        for j in range(width_in):
            value = a[j]
            for r in range(width_out):
                b[r] += words[at + r] * value
            at += width_out
        kind = int(words[activations_at + layer])
        for r in range(width_out):
            a[r] = activate(kind, b[r])
    outputs = int(words[rows_at + layer_count])
    for i in range(outputs):
        y[y_at + i] = a[i] * words[at + i] + words[at + outputs + i]
    return 0


if config.DISABLE_JIT:

    def forward_generic(words, start, rows_at, activations_at, layer_count, x, x_at, y, y_at):
        """Evaluate; see the compiled twin below."""
        a, b = np.zeros(MAX_WIDTH), np.zeros(MAX_WIDTH)
        return _forward(words, start, rows_at, activations_at, layer_count, x, x_at, y, y_at, a, b)

else:

    @compiled.hot
    def forward_generic(words, start, rows_at, activations_at, layer_count, x, x_at, y, y_at):
        """Evaluate the network packed at `start`: x[x_at : x_at + inputs] (read) -> y[y_at : y_at + outputs] (written).

        Sizes of the layers from words[rows_at], their activations from words[activations_at].
        """
        a = carray(_stack_words(512), (512,))
        b = carray(_stack_words(512), (512,))
        return _forward(words, start, rows_at, activations_at, layer_count, x, x_at, y, y_at, a, b)
