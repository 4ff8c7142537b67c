"""onnxruntime inside the period: a pre-bound session run through its C function's address.

The row of addresses (made by setup.model) is data, so compiled code that uses it can still be cached on disk.
The call is `OrtStatus* RunWithBinding(session, run_options, binding)`; a Python callback with the same signature
stands in where the C function cannot be had. Inputs and outputs lie in buffers bound once.
"""

import ctypes

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
def _copy_in(words, at, x, x_at, count):
    address = int(words[at + FOREIGN_INPUT])
    if words[at + FOREIGN_SINGLE] == 1.0:
        narrow = _singles(address, count)
        for i in range(count):
            narrow[i] = x[x_at + i]
    else:
        wide = _doubles(address, count)
        for i in range(count):
            wide[i] = x[x_at + i]


@compiled.hot
def _copy_out(words, at, y, y_at, count):
    address = int(words[at + FOREIGN_OUTPUT])
    if words[at + FOREIGN_SINGLE] == 1.0:
        narrow = _singles(address, count)
        for i in range(count):
            y[y_at + i] = narrow[i]
    else:
        wide = _doubles(address, count)
        for i in range(count):
            y[y_at + i] = wide[i]


@compiled.hot
def forward_foreign(words, at, x, x_at, y, y_at, inputs, outputs):
    """x[x_at : x_at + inputs] -> y[y_at : y_at + outputs] through onnxruntime; 0, or 1 with NaN outputs if it failed.

    words[at : at + FOREIGN_SIZE]: addresses; a function address of 0 counts as failed.
    """
    function = int(words[at + FOREIGN_FUNCTION])
    status = 1
    if function != 0:
        _copy_in(words, at, x, x_at, inputs)
        status = _call(
            function,
            int(words[at + FOREIGN_SESSION]),
            int(words[at + FOREIGN_OPTIONS]),
            int(words[at + FOREIGN_BINDING]),
        )
    if status != 0:
        for i in range(outputs):
            y[y_at + i] = float("nan")
        return 1
    _copy_out(words, at, y, y_at, outputs)
    return 0
