"""Bits of a frame to raw integers and back, for signals of any start, either byte order and up to 64 bits.

A signal is cut into segments when it is loaded, one for each byte it touches; so the loop knows no byte order.
Raw values are uint64 all the way (a mixed int64/uint64 expression would silently become a float in compiled code);
a negative number is held as its two's complement, extended to 64 bits.
"""

import math

import numpy as np

from hilrunner.base.compiled import hot

SEGMENT_COUNT_MAX = 9  # 64 bits that start inside a byte touch nine bytes
KIND_UNSIGNED = 0
KIND_SIGNED = 1
KIND_FLOAT32 = 2
KIND_FLOAT64 = 3

# One row a signal. Owner: the tables; read-only after loading.
SIGNAL = np.dtype(
    [
        ("segment_count", "i8"),
        ("segment_byte", "i8", (SEGMENT_COUNT_MAX,)),  # data byte
        ("segment_shift", "u8", (SEGMENT_COUNT_MAX,)),  # bits to the right of the segment in that byte
        ("segment_mask", "u8", (SEGMENT_COUNT_MAX,)),  # as wide as the segment, at bit 0
        ("segment_place", "u8", (SEGMENT_COUNT_MAX,)),  # its lowest bit in the raw value
        ("kind", "i8"),
        ("bit_mask", "u8"),  # all bits of the signal
        ("sign_bit", "u8"),  # 0 unless signed
        ("scale", "f8"),  # SI value = raw * scale + offset
        ("offset", "f8"),
        ("number_min", "f8"),  # range as a number on the wire: raw for integers, physical for floats
        ("number_max", "f8"),
        ("modulus", "f8"),  # > 0: the number wraps (counters, time stamps) instead of being clamped
    ],
    align=True,
)


@hot
def extract_bits(signals, index, data):
    """The raw bits of one signal, not sign-extended (uint64)."""
    value = np.uint64(0)
    for segment in range(signals[index]["segment_count"]):
        byte = np.uint64(data[signals[index]["segment_byte"][segment]])
        part = (byte >> signals[index]["segment_shift"][segment]) & signals[index]["segment_mask"][segment]
        value |= part << signals[index]["segment_place"][segment]
    return value


@hot
def insert_bits(signals, index, value, data):
    """Write the raw bits (uint64) of one signal; the other bits of the touched bytes stay."""
    for segment in range(signals[index]["segment_count"]):
        mask = signals[index]["segment_mask"][segment]
        shift = signals[index]["segment_shift"][segment]
        part = (value >> signals[index]["segment_place"][segment]) & mask
        place = signals[index]["segment_byte"][segment]
        kept = np.uint64(data[place]) & ~(mask << shift)
        data[place] = np.uint8((kept | (part << shift)) & np.uint64(0xFF))


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

    Rounds half to even, the rule of IEEE 754 and of `rint` in C.
    """
    number = (value - signals[index]["offset"]) / signals[index]["scale"]
    if math.isnan(number):
        number = 0.0
    if signals[index]["kind"] <= KIND_SIGNED:
        number = np.rint(number)
    modulus = signals[index]["modulus"]
    if modulus > 0.0 and math.isfinite(number):
        number -= math.floor(number / modulus) * modulus
    number = min(max(number, signals[index]["number_min"]), signals[index]["number_max"])
    insert_bits(signals, index, bits_of_number(signals, index, number), data)
