"""The producer's side of the ring: fill the records in place, then publish. Never waits; a full ring drops and counts."""

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from hilrunner.base import ring as layout
from hilrunner.base.compiled import hot

_STRIDE = layout.HEADER_STRIDE


def _store_release(array, index, value):
    """Store so that a reader who sees the value also sees everything written before it."""
    array[index] = value


@intrinsic
def _store_release_atomic(typing_context, array, index, value):
    def codegen(context, builder, signature, args):
        array_type = signature.args[0]
        view = context.make_array(array_type)(context, builder, args[0])
        pointer = cgutils.get_item_pointer(context, builder, array_type, view, [args[1]])
        builder.store_atomic(args[2], pointer, ordering="release", align=8)
        return ir.Constant(ir.IntType(8), 0)

    return types.int8(array, types.int64, types.int64), codegen


@overload(_store_release)
def _store_release_overload(array, index, value):
    def publish(array, index, value):
        _store_release_atomic(array, np.int64(index), np.int64(value))

    return publish


@hot
def has_room(header, written_word, read_word, capacity):
    """Whether one more record fits."""
    return header[written_word * _STRIDE] - header[read_word * _STRIDE] < capacity


@hot
def count_drop(header, dropped_word):
    """Count one dropped record."""
    header[dropped_word * _STRIDE] += 1


@hot
def publish(header, written_word):
    """Make the record just filled visible to the recorder."""
    _store_release(header, written_word * _STRIDE, header[written_word * _STRIDE] + 1)


@hot
def push_can(ring, tick, can_id, flags, length, frame_status, axis, kernel_real_ns, mono_ns, data, data_at):
    """One CAN frame; `data[data_at:data_at + length]` are its bytes."""
    header = ring.header
    capacity = ring.can.shape[0]
    if not has_room(header, layout.WORD_CAN_WRITTEN, layout.WORD_CAN_READ, capacity):
        count_drop(header, layout.WORD_CAN_DROPPED)
        return
    slot = ring.can[header[layout.WORD_CAN_WRITTEN * _STRIDE] & (capacity - 1)]
    slot["tick"] = tick
    slot["kernel_real_ns"] = kernel_real_ns
    slot["mono_ns"] = mono_ns
    slot["can_id"] = can_id
    slot["length"] = length
    slot["flags"] = flags
    slot["status"] = frame_status
    slot["axis"] = axis
    room = slot["data"].shape[0]
    for k in range(room):
        slot["data"][k] = data[data_at + k] if k < length else 0
    publish(header, layout.WORD_CAN_WRITTEN)
