"""The kernels as functions at addresses, so that a network brings its own and callers hold none of their code.

Every kernel is `int64 kernel(float64* network, float64* x, float64* y)`, compiled once and kept on disk; its address is
written into the network's head (plant.network) when a bank is assembled. A caller compiles one indirect call: with the
kernels inlined, each function above them would compile them again.
"""

import os

from hilrunner.base import compiled
from hilrunner.plant import foreign_call, generic_kernel, graph_kernel, vector_kernel
from hilrunner.plant.head import (
    HEAD_ACTIVATION,
    HEAD_FOREIGN,
    HEAD_INPUTS,
    HEAD_LAYERS,
    HEAD_OUTPUTS,
    HEAD_ROWS,
    HEAD_SIZE,
    KERNEL_FOREIGN,
    KERNEL_GENERIC,
    KERNEL_GRAPH,
    KERNEL_VECTOR,
)

from llvmlite import ir  # isort: skip
from numba import carray, cfunc, config, types  # isort: skip
from numba.extending import intrinsic  # isort: skip

_POINTER = types.CPointer(types.float64)
_KERNEL = types.int64(_POINTER, _POINTER, _POINTER)
_EVERYTHING = 1 << 40  # as long as an array over a pointer needs to pretend to be


@intrinsic
def _moved(typing, pointer, count):
    """The pointer `count` float64 further."""

    def generate(context, builder, sig, arguments):
        return builder.gep(arguments[0], [arguments[1]])

    return _POINTER(_POINTER, types.int64), generate


def _vector(network, x, y):
    inputs, outputs = int(network[HEAD_INPUTS]), int(network[HEAD_OUTPUTS])
    return vector_kernel.forward_vector(_moved(network, HEAD_SIZE), x, y, inputs, outputs)


def _generic(network, x, y):
    words = carray(network, (_EVERYTHING,))
    return generic_kernel.forward_generic(
        words, HEAD_SIZE, HEAD_ROWS, HEAD_ACTIVATION, int(words[HEAD_LAYERS]),
        carray(x, (_EVERYTHING,)), 0, carray(y, (_EVERYTHING,)), 0,
    )  # fmt: skip


def _foreign(network, x, y):
    words = carray(network, (_EVERYTHING,))
    inputs, outputs = int(words[HEAD_INPUTS]), int(words[HEAD_OUTPUTS])
    x_values, y_values = carray(x, (_EVERYTHING,)), carray(y, (_EVERYTHING,))
    return foreign_call.forward_foreign(words, HEAD_FOREIGN, HEAD_SIZE, x_values, 0, y_values, 0, inputs, outputs)


def _graph(network, x, y):
    words = carray(network, (_EVERYTHING,))
    inputs, outputs = int(words[HEAD_INPUTS]), int(words[HEAD_OUTPUTS])
    return graph_kernel.forward_graph(
        words, HEAD_SIZE, carray(x, (_EVERYTHING,)), 0, inputs, carray(y, (_EVERYTHING,)), 0, outputs
    )


_SOURCES = {KERNEL_VECTOR: _vector, KERNEL_GENERIC: _generic, KERNEL_FOREIGN: _foreign, KERNEL_GRAPH: _graph}
_compiled: dict = {}


def kernel_address(kind: int) -> int:
    """Address of a compiled kernel (KERNEL_*), compiled or read from disk on first use; 0 when nothing is compiled."""
    if config.DISABLE_JIT:
        return 0
    if kind not in _compiled:
        before = config.CACHE_DIR
        config.CACHE_DIR = os.environ.get("NUMBA_CACHE_DIR") or str(compiled.cache_folder("plant"))
        try:
            _compiled[kind] = cfunc(_KERNEL, cache=True, error_model="numpy", nogil=True)(_SOURCES[kind])
        finally:
            config.CACHE_DIR = before
    return _compiled[kind].address


@intrinsic
def _call_compiled(typing, words, start, work, x_at, y_at, address_at):
    """Call the kernel whose address lies in words[start + address_at]."""
    word = types.int64
    signature = word(words, word, work, word, word, word)

    def generate(context, builder, sig, arguments):
        array = context.make_array(sig.args[0])(context, builder, arguments[0])
        values = context.make_array(sig.args[2])(context, builder, arguments[2])
        network = builder.gep(array.data, [arguments[1]])
        address = builder.fptosi(builder.load(builder.gep(network, [arguments[5]])), ir.IntType(64))
        pointer = network.type
        kind = ir.FunctionType(ir.IntType(64), [pointer, pointer, pointer])
        function = builder.inttoptr(address, kind.as_pointer())
        x, y = (builder.gep(values.data, [place]) for place in (arguments[3], arguments[4]))
        return builder.call(function, [network, x, y])

    return signature, generate


def _call_interpreted(words, start, work, x_at, y_at, address_at):
    kernel = int(words[start])
    inputs, outputs = int(words[start + HEAD_INPUTS]), int(words[start + HEAD_OUTPUTS])
    if kernel == KERNEL_VECTOR:
        return vector_kernel.forward_interpreted(words, start + HEAD_SIZE, work, x_at, work, y_at, inputs, outputs)
    if kernel == KERNEL_GENERIC:
        return generic_kernel.forward_generic(
            words, start + HEAD_SIZE, start + HEAD_ROWS, start + HEAD_ACTIVATION, int(words[start + HEAD_LAYERS]),
            work, x_at, work, y_at,
        )  # fmt: skip
    if kernel == KERNEL_GRAPH:
        return graph_kernel.forward_graph(words, start + HEAD_SIZE, work, x_at, inputs, work, y_at, outputs)
    return foreign_call.forward_foreign(
        words, start + HEAD_FOREIGN, start + HEAD_SIZE, work, x_at, work, y_at, inputs, outputs
    )


call_kernel = _call_interpreted if config.DISABLE_JIT else _call_compiled
