"""Checksums of any kind over chosen bytes of a frame, driven by one row of GUARD: sum, XOR, nibble sum, CRC, J1939.

A CRC takes its parameters as the catalogue of CRC algorithms names them (width, polynomial, start, reflection, final xor). The
register of one that is not reflected stands at the top of 64 bits, so that one table form serves every width.
"""

import numpy as np

from hilrunner.base.compiled import hot

(
    ALGORITHM_NONE,  # a counter alone
    ALGORITHM_SUM,
    ALGORITHM_XOR,
    ALGORITHM_NIBBLE_SUM,
    ALGORITHM_CRC,
    ALGORITHM_CRC_REFLECTED,
    ALGORITHM_J1939,  # SAE J1939-71, message checksum of TSC1
    ALGORITHM_USER,  # a compiled function of the user's own
) = range(8)

EXTRA_COUNT_MAX = 8
FIXED_COUNT_MAX = 16
LISTED_COUNT = 16
NO_ROW = -1

# How the frames of one message are protected; made by setup.protection, read-only.
GUARD = np.dtype(
    [
        ("function", "i8"),  # address of the user's function
        ("counter_modulus", "i8"),  # the counter runs 0 … modulus - 1
        ("counter_delta_max", "i8"),  # received: the largest step that is no loss
        ("width", "i8"),  # of the checksum, bits
        ("mask", "u8"),
        ("start", "u8"),  # CRC: of the register, in its place
        ("final_xor", "u8"),
        ("counter_row", "i2"),  # row of `guard_signals`; NO_ROW: no counter
        ("checksum_row", "i2"),  # NO_ROW: no checksum
        ("first_byte", "i2"),  # the bytes covered: first_byte … end_byte - 1 …
        ("end_byte", "i2"),
        ("skip_first", "i2"),  # … without skip_first … skip_end - 1, where the checksum stands
        ("skip_end", "i2"),
        ("checksum_byte", "i2"),  # a byte the checksum stands in
        ("algorithm", "u1"),
        ("blanked", "u1"),  # 1: the checksum's own bits are covered, as zeros
        ("negated", "u1"),  # SUM: two's complement of the sum
        ("result_reflected", "u1"),
        ("before_count", "u1"),  # bytes that are not sent, taken before the data …
        ("before_listed", "u1"),  # 1: and first of all the list's byte of this counter value
        ("after_count", "u1"),  # … and after them
        ("after_listed", "u1"),
        ("fixed_count", "u1"),  # bytes that must be what they are: lengths and Data IDs of the header
        ("before", "u1", (EXTRA_COUNT_MAX,)),
        ("after", "u1", (EXTRA_COUNT_MAX,)),
        ("listed", "u1", (LISTED_COUNT,)),
        ("fixed_byte", "u1", (FIXED_COUNT_MAX,)),
        ("fixed_mask", "u1", (FIXED_COUNT_MAX,)),
        ("fixed_value", "u1", (FIXED_COUNT_MAX,)),
        ("table", "u8", (256,)),  # CRC of each byte value
    ],
    align=True,
)


@hot
def _absorb(row, register, byte):
    """The register after one more byte."""
    algorithm = row["algorithm"]
    value = np.uint64(byte)
    if algorithm == ALGORITHM_CRC:
        return (register << np.uint64(8)) ^ row["table"][np.int64((register >> np.uint64(56)) ^ value)]
    if algorithm == ALGORITHM_CRC_REFLECTED:
        return (register >> np.uint64(8)) ^ row["table"][np.int64((register ^ value) & np.uint64(0xFF))]
    if algorithm == ALGORITHM_XOR:
        return register ^ value
    if algorithm == ALGORITHM_NIBBLE_SUM:
        return register + (value & np.uint64(0x0F)) + (value >> np.uint64(4))
    return register + value


@hot
def _reflected(value, width):
    out = np.uint64(0)
    for _ in range(width):
        out = (out << np.uint64(1)) | (value & np.uint64(1))
        value = value >> np.uint64(1)
    return out


@hot
def _finished(row, register, counter):
    """The checksum of what the register has taken."""
    algorithm = row["algorithm"]
    if algorithm == ALGORITHM_J1939:
        total = register + np.uint64(counter & 0x0F)
        return (((total >> np.uint64(6)) & np.uint64(0x03)) + (total >> np.uint64(3)) + total) & np.uint64(0x07)
    if algorithm == ALGORITHM_CRC:
        register = register >> np.uint64(64 - row["width"])
    if row["result_reflected"] != 0:
        register = _reflected(register, row["width"])
    if row["negated"] != 0:
        register = ~register + np.uint64(1)
    return (register ^ row["final_xor"]) & row["mask"]


@hot
def checksum_of(guards, guard, data, counter):
    """The checksum of a frame (uint64); a checksum that is covered as zeros must stand there as zeros.

    Args:
        guards: GUARD[...]. data: u1[>= end_byte], read. counter: of this frame, chooses the listed byte.
    """
    row = guards[guard]
    register = row["start"]
    if row["before_listed"] != 0:
        register = _absorb(row, register, row["listed"][counter % LISTED_COUNT])
    for index in range(np.int64(row["before_count"])):
        register = _absorb(row, register, row["before"][index])
    for index in range(np.int64(row["first_byte"]), np.int64(row["end_byte"])):
        if index < row["skip_first"] or index >= row["skip_end"]:
            register = _absorb(row, register, data[index])
    for index in range(np.int64(row["after_count"])):
        register = _absorb(row, register, row["after"][index])
    if row["after_listed"] != 0:
        register = _absorb(row, register, row["listed"][counter % LISTED_COUNT])
    return _finished(row, register, np.int64(counter))
