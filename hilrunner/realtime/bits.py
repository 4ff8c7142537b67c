"""Bits of a frame to raw integers and back, for signals of any start, either byte order and up to 64 bits.

A signal is read as the 64 bits of eight data bytes at once, in its own byte order, shifted and masked. Where those eight bytes
begin, and a second window for a signal that touches nine bytes, is worked out when the signal is loaded.
Raw values are uint64 all the way (a mixed int64/uint64 expression would silently become a float in compiled code);
a negative number is held as its two's complement, extended to 64 bits.
"""

import math
import sys

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from hilrunner.base.compiled import hot

WINDOW_COUNT_MAX = 2  # 64 bits that start inside a byte touch nine bytes
WINDOW_BYTES = 8
KIND_UNSIGNED = 0
KIND_SIGNED = 1
KIND_FLOAT32 = 2
KIND_FLOAT64 = 3

# One row a signal, small: a core that comes out of its sleep fetches every line of it anew. Owner: the tables; read-only.
SIGNAL = np.dtype(
    [
        ("scale", "f8"),  # SI value = raw * scale + offset
        ("offset", "f8"),
        ("number_min", "f8"),  # range as a number on the wire: raw for integers, physical for floats
        ("number_max", "f8"),
        ("modulus", "f8"),  # > 0: the number wraps (counters, time stamps) instead of being clamped
        ("bit_mask", "u8"),  # all bits of the signal
        ("sign_bit", "u8"),  # 0 unless signed
        ("window_mask", "u8", (WINDOW_COUNT_MAX,)),  # as wide as the bits of this window, at bit 0
        ("window_byte", "u1", (WINDOW_COUNT_MAX,)),  # first of eight data bytes, 0..56
        ("window_shift", "u1", (WINDOW_COUNT_MAX,)),  # bits to the right of the signal's in the 64
        ("window_place", "u1", (WINDOW_COUNT_MAX,)),  # their lowest bit in the raw value
        ("window_count", "u1"),
        ("big_endian", "u1"),  # 1: the first byte of a window is its highest
        ("kind", "u1"),
    ],
    align=True,
)


def _load_word(data, at):
    """Eight bytes from `at` on as uint64, the first byte lowest."""
    return np.uint64(int.from_bytes(data[at : at + WINDOW_BYTES].tobytes(), "little"))


def _store_word(data, at, word):
    """The eight bytes of a uint64 from `at` on, the lowest first."""
    data[at : at + WINDOW_BYTES] = np.frombuffer(int(word).to_bytes(WINDOW_BYTES, "little"), np.uint8)


def _swap_bytes(word):
    """A uint64 with its bytes in the other order."""
    return np.uint64(int.from_bytes(int(word).to_bytes(WINDOW_BYTES, "little"), "big"))


def _byte_swapped(builder, word):
    kind = ir.FunctionType(word.type, [word.type])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.bswap.i64"), [word])


def _word_pointer(context, builder, array_type, array, at):
    view = context.make_array(array_type)(context, builder, array)
    return builder.bitcast(builder.gep(view.data, [at]), ir.IntType(64).as_pointer())


@intrinsic
def _load_word_inline(typing_context, data, at):
    def codegen(context, builder, signature, arguments):
        load = builder.load(_word_pointer(context, builder, signature.args[0], *arguments))
        load.align = 1
        return load if sys.byteorder == "little" else _byte_swapped(builder, load)

    return types.uint64(data, types.int64), codegen


@intrinsic
def _store_word_inline(typing_context, data, at, word):
    def codegen(context, builder, signature, arguments):
        array, at, word = arguments
        word = word if sys.byteorder == "little" else _byte_swapped(builder, word)
        store = builder.store(word, _word_pointer(context, builder, signature.args[0], array, at))
        store.align = 1
        return ir.Constant(ir.IntType(8), 0)

    return types.int8(data, types.int64, types.uint64), codegen


@intrinsic
def _swap_bytes_inline(typing_context, word):
    def codegen(context, builder, signature, arguments):
        return _byte_swapped(builder, arguments[0])

    return types.uint64(types.uint64), codegen


@overload(_load_word)
def _load_word_compiled(data, at):
    return lambda data, at: _load_word_inline(data, np.int64(at))


@overload(_store_word)
def _store_word_compiled(data, at, word):
    def store(data, at, word):
        _store_word_inline(data, np.int64(at), word)

    return store


@overload(_swap_bytes)
def _swap_bytes_compiled(word):
    return lambda word: _swap_bytes_inline(word)


@hot
def _read_window(row, window, data):
    word = _load_word(data, np.int64(row["window_byte"][window]))
    return _swap_bytes(word) if row["big_endian"] != 0 else word


@hot
def extract_bits(signals, index, data):
    """The raw bits of one signal, not sign-extended (uint64); `data` holds 64 bytes or more."""
    row = signals[index]
    value = np.uint64(0)
    for window in range(np.int64(row["window_count"])):
        part = (_read_window(row, window, data) >> np.uint64(row["window_shift"][window])) & row["window_mask"][window]
        value |= part << np.uint64(row["window_place"][window])
    return value


@hot
def insert_bits(signals, index, value, data):
    """Write the raw bits (uint64) of one signal; the other bits of the touched bytes stay. `data` holds 64 bytes or more."""
    row = signals[index]
    for window in range(np.int64(row["window_count"])):
        mask = row["window_mask"][window]
        shift = np.uint64(row["window_shift"][window])
        part = (value >> np.uint64(row["window_place"][window])) & mask
        word = (_read_window(row, window, data) & ~(mask << shift)) | (part << shift)
        if row["big_endian"] != 0:
            word = _swap_bytes(word)
        _store_word(data, np.int64(row["window_byte"][window]), word)


@hot
def number_of_bits(signals, index, bits):
    """The number on the wire: raw integer or float value, as float64 (NaN if the float is NaN)."""
    kind = signals[index]["kind"]
    if kind == KIND_FLOAT32:
        return np.float64(np.uint32(bits).view(np.float32))
    if kind == KIND_FLOAT64:
        return np.uint64(bits).view(np.float64)
    if bits & signals[index]["sign_bit"]:
        magnitude = ((~bits) & signals[index]["bit_mask"]) + np.uint64(1)
        return -np.float64(magnitude)
    return np.float64(bits)


@hot
def bits_of_number(signals, index, number):
    """Raw bits of a number that is finite and within the signal's range; integers must be whole already."""
    kind = signals[index]["kind"]
    if kind == KIND_FLOAT32:
        return np.uint64(np.float32(number).view(np.uint32))
    if kind == KIND_FLOAT64:
        return np.float64(number).view(np.uint64)
    if number < 0.0:
        return ((~np.uint64(-number)) + np.uint64(1)) & signals[index]["bit_mask"]
    return np.uint64(number) & signals[index]["bit_mask"]


@hot
def decode_number(signals, index, data):
    """The number on the wire of one signal; compare with number_min/number_max before use."""
    return number_of_bits(signals, index, extract_bits(signals, index, data))


@hot
def encode_si(signals, index, value, data):
    """Write an SI value: wrapped if the signal wraps, else clamped to its range; NaN is sent as the number nearest to 0.

    Rounds half to even, the rule of IEEE 754 and of `rint` in C. Returns whether the number on the wire is another one than the
    value asks for, rounding aside.
    """
    number = (value - signals[index]["offset"]) / signals[index]["scale"]
    no_number = math.isnan(number)
    if no_number:
        number = 0.0
    if signals[index]["kind"] <= KIND_SIGNED:
        number = np.rint(number)
    modulus = signals[index]["modulus"]
    if modulus > 0.0 and math.isfinite(number):
        number -= math.floor(number / modulus) * modulus
    sent = min(max(number, signals[index]["number_min"]), signals[index]["number_max"])
    insert_bits(signals, index, bits_of_number(signals, index, sent), data)
    return no_number or sent != number
