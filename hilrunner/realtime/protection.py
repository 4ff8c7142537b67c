"""Counter and checksum of a frame by its row of GUARD: written where the bench sends, judged where it receives.

E2E profile 2, which the shipped contract uses, has a path of its own (realtime.e2e); everything else goes through here. The rule for
received counters is the one of realtime.decode.
"""

import ctypes

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.extending import intrinsic

from hilrunner.base import status
from hilrunner.base.compiled import hot
from hilrunner.realtime import bits
from hilrunner.realtime.checksum import ALGORITHM_NONE, ALGORITHM_USER, NO_ROW, checksum_of
from hilrunner.realtime.e2e import NO_COUNTER

USER_SENDS = 1
USER_RECEIVES = 0
# what a user's function answers for a frame that must not be used
USER_BAD_CHECKSUM = -1
USER_REPEATED = -2
USER_LOST = -3


@intrinsic
def _call_compiled(typing, function, data, length, counter, sent):
    """Call `int64 function(uint8 *data, int64 length, int64 counter, int64 sent)` at an address."""
    signature = types.int64(types.int64, types.intp, types.int64, types.int64, types.int64)

    def generate(context, builder, sig, arguments):
        word = ir.IntType(64)
        kind = ir.FunctionType(word, [word, word, word, word])
        return builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])

    return signature, generate


def _call_interpreted(function, data, length, counter, sent):
    kind = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)
    return kind(int(function))(int(data), int(length), int(counter), int(sent))


_call = _call_interpreted if config.DISABLE_JIT else _call_compiled


@hot
def _ask_user(guards, guard, data, length, counter, sent):
    function = np.int64(guards[guard]["function"])
    return np.int64(_call(function, data.ctypes.data, np.int64(length), np.int64(counter), np.int64(sent)))


@hot
def protect(guards, guard, signals, data, length, counter):
    """Write counter and checksum into a frame that is otherwise complete; returns the counter it carries.

    Args:
        guards: GUARD[...]. signals: bits.SIGNAL rows of counters and checksums. data: u1[64], written.
        counter: of the frame sent before.
    """
    row = guards[guard]
    if row["algorithm"] == ALGORITHM_USER:
        return _ask_user(guards, guard, data, length, counter, USER_SENDS)
    counter = (counter + 1) % row["counter_modulus"]
    if row["counter_row"] != NO_ROW:
        bits.insert_bits(signals, np.int64(row["counter_row"]), np.uint64(counter), data)
    if row["algorithm"] != ALGORITHM_NONE:
        at = np.int64(row["checksum_row"])
        if row["blanked"] != 0:
            bits.insert_bits(signals, at, np.uint64(0), data)
        bits.insert_bits(signals, at, checksum_of(guards, guard, data, counter), data)
    return counter


@hot
def judge(guards, guard, signals, data, length, last_counter):
    """(status.FRAME_*, counter) of a received frame; the counter is 0 where the message has none.

    Args:
        data: u1[64], read; as it was when this returns. last_counter: of the last accepted frame, NO_COUNTER: none yet.
    """
    row = guards[guard]
    if row["algorithm"] == ALGORITHM_USER:
        return _judge_by_user(guards, guard, data, length, last_counter)
    for index in range(np.int64(row["fixed_count"])):
        if data[np.int64(row["fixed_byte"][index])] & row["fixed_mask"][index] != row["fixed_value"][index]:
            return np.int64(status.FRAME_BAD_CRC), np.int64(0)
    counter = np.int64(0)
    if row["counter_row"] != NO_ROW:
        counter = np.int64(bits.extract_bits(signals, np.int64(row["counter_row"]), data))
    if row["algorithm"] != ALGORITHM_NONE:
        at = np.int64(row["checksum_row"])
        told = bits.extract_bits(signals, at, data)
        if row["blanked"] != 0:
            bits.insert_bits(signals, at, np.uint64(0), data)
        expected = checksum_of(guards, guard, data, counter)
        if row["blanked"] != 0:
            bits.insert_bits(signals, at, told, data)
        if told != expected:
            return np.int64(status.FRAME_BAD_CRC), counter
    if row["counter_row"] == NO_ROW:
        return np.int64(status.FRAME_VALID), counter
    return _judge_counter(row, counter, last_counter), counter


@hot
def _judge_counter(row, counter, last_counter):
    modulus = row["counter_modulus"]
    if counter >= modulus:  # a value the counter never takes, as 15 of profile 1
        return np.int64(status.FRAME_BAD_CRC)
    if last_counter == NO_COUNTER:
        return np.int64(status.FRAME_VALID)
    step = (counter - last_counter) % modulus
    if step == 0:
        return np.int64(status.FRAME_REPEATED_COUNTER)
    if step > row["counter_delta_max"]:
        return np.int64(status.FRAME_LOST_COUNTER)
    return np.int64(status.FRAME_VALID)


@hot
def _judge_by_user(guards, guard, data, length, last_counter):
    answer = _ask_user(guards, guard, data, length, last_counter, USER_RECEIVES)
    if answer >= 0:
        return np.int64(status.FRAME_VALID), answer
    if answer == USER_REPEATED:
        return np.int64(status.FRAME_REPEATED_COUNTER), np.int64(0)
    if answer == USER_LOST:
        return np.int64(status.FRAME_LOST_COUNTER), np.int64(0)
    return np.int64(status.FRAME_BAD_CRC), np.int64(0)
