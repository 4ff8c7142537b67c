"""onnxruntime inside the period: a pre-bound session run through its C function's address.

The row of addresses (made by setup.model) is data, so compiled code that uses it can still be cached on disk.
The call is `OrtStatus* RunWithBinding(session, run_options, binding)`; a Python callback with the same signature
stands in where the C function cannot be had. Inputs and outputs lie in buffers bound once.
"""

import ctypes
import math

import numpy as np
from llvmlite import ir

from hilrunner.base import compiled

from numba import carray, config, types  # isort: skip
from numba.extending import intrinsic  # isort: skip

FOREIGN_FUNCTION = 0  # address of the function
FOREIGN_SESSION = 1
FOREIGN_OPTIONS = 2
FOREIGN_BINDING = 3
FOREIGN_INPUT = 4  # address of the input buffer
FOREIGN_OUTPUT = 5
FOREIGN_SINGLE = 6  # 1: the buffers are float32, 0: float64
FOREIGN_SIZE = 8
LAYOUT_STRIDE = 8


def layout(input_order, input_factors, output_order, output_factors) -> np.ndarray:
    """How a file's columns and units differ from the reduced model's, float64[4 * LAYOUT_STRIDE].

    Args:
        input_order: for each of the reduced model's inputs the file's column; input_factors: the file's units in SI.
        output_order, output_factors: the same of the outputs.
    """
    words = np.zeros((4, LAYOUT_STRIDE))
    for place, column in enumerate(input_order):
        words[0, column] = place  # a column of the file takes this input
    words[1, : len(input_factors)] = 1.0 / np.asarray(input_factors, float)
    words[2, : len(output_order)] = output_order  # an output takes this column of the file
    words[3, : len(output_order)] = np.asarray(output_factors, float)[list(output_order)]
    return words.ravel()


def _call_interpreted(function, session, options, binding):
    kind = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)
    return kind(int(function))(int(session), int(options), int(binding)) or 0


@intrinsic
def _call_compiled(typing, function, session, options, binding):
    """Call `function(session, options, binding)` at an address; its returned pointer as an integer."""
    signature = types.int64(types.int64, types.int64, types.int64, types.int64)

    def generate(context, builder, sig, arguments):
        word = ir.IntType(64)
        kind = ir.FunctionType(word, [word, word, word])
        pointer = builder.inttoptr(arguments[0], kind.as_pointer())
        return builder.call(pointer, arguments[1:])

    return signature, generate


def _make_pointer(value_type):
    @intrinsic
    def pointer_at(typing, address):
        signature = types.CPointer(value_type)(types.int64)

        def generate(context, builder, sig, arguments):
            return builder.inttoptr(arguments[0], context.get_value_type(sig.return_type))

        return signature, generate

    return pointer_at


_double_at = _make_pointer(types.float64)
_single_at = _make_pointer(types.float32)

if config.DISABLE_JIT:
    _call = _call_interpreted

    def _doubles(address, count):
        return np.ctypeslib.as_array((ctypes.c_double * int(count)).from_address(int(address)))

    def _singles(address, count):
        return np.ctypeslib.as_array((ctypes.c_float * int(count)).from_address(int(address)))

else:
    _call = _call_compiled

    @compiled.hot
    def _doubles(address, count):
        return carray(_double_at(address), (count,))

    @compiled.hot
    def _singles(address, count):
        return carray(_single_at(address), (count,))


@compiled.hot
def _copy_in(words, at, layout_at, x, x_at, count):
    address = int(words[at + FOREIGN_INPUT])
    if words[at + FOREIGN_SINGLE] == 1.0:
        narrow = _singles(address, count)
        for i in range(count):
            narrow[i] = x[x_at + int(words[layout_at + i])] * words[layout_at + LAYOUT_STRIDE + i]
    else:
        wide = _doubles(address, count)
        for i in range(count):
            wide[i] = x[x_at + int(words[layout_at + i])] * words[layout_at + LAYOUT_STRIDE + i]


@compiled.hot
def _copy_out(words, at, layout_at, y, y_at, count):
    address = int(words[at + FOREIGN_OUTPUT])
    source = layout_at + 2 * LAYOUT_STRIDE
    if words[at + FOREIGN_SINGLE] == 1.0:
        narrow = _singles(address, count)
        for i in range(count):
            y[y_at + i] = narrow[int(words[source + i])] * words[source + LAYOUT_STRIDE + i]
    else:
        wide = _doubles(address, count)
        for i in range(count):
            y[y_at + i] = wide[int(words[source + i])] * words[source + LAYOUT_STRIDE + i]


@compiled.hot
def forward_foreign(words, at, layout_at, x, x_at, y, y_at, inputs, outputs):
    """x[x_at : x_at + inputs] -> y[y_at : y_at + outputs] through onnxruntime; 0, or 1 with NaN outputs if it failed.

    words[at : at + FOREIGN_SIZE]: addresses; a function address of 0 counts as failed. words[layout_at : ]: see `layout`.
    """
    function = int(words[at + FOREIGN_FUNCTION])
    status = 1
    if function != 0:
        _copy_in(words, at, layout_at, x, x_at, inputs)
        status = _call(
            function,
            int(words[at + FOREIGN_SESSION]),
            int(words[at + FOREIGN_OPTIONS]),
            int(words[at + FOREIGN_BINDING]),
        )
    if status != 0:
        for i in range(outputs):
            y[y_at + i] = math.nan
        return 1
    _copy_out(words, at, layout_at, y, y_at, outputs)
    return 0
