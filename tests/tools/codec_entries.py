"""Compiled entry points of the codec for tests, and a many-frame version; kept on disk like those of the runner."""

import numpy as np

from hilrunner.base import status
from hilrunner.base.compiled import entry
from hilrunner.realtime import bits, decode, e2e, encode


def decode_with(table, can_id, length, data, tick, receiver):
    """decode.decode_command with the arguments of one type, so that it is compiled once."""
    return decode.decode_command(table, int(can_id), int(length), data, int(tick), receiver)


def decode_one(table, can_id, length, data, last_counter, fresh):
    """One frame through decode_command, for tests that keep counters and commands themselves; lines and parts begin anew."""
    receiver = decode.new_receiver(table, len(fresh))._replace(last_counter=last_counter, fresh=fresh)
    return decode_with(table, can_id, length, data, 0, receiver)


@entry
def _decode_many(table, can_ids, lengths, frames, receiver, codes, changed):
    for index in range(can_ids.shape[0]):
        valve = receiver.fresh[0]["valve_command"]
        stamp = receiver.fresh[0]["timestamp_us"]
        control = receiver.fresh[0]["control"]
        counter = receiver.fresh[0]["counter"]
        last = receiver.last_counter[0]
        axis, code = decode.decode_command(table, can_ids[index], lengths[index], frames[index], index, receiver)
        codes[index, 0] = axis
        codes[index, 1] = code
        if code != status.FRAME_VALID:
            same = receiver.fresh[0]["valve_command"] == valve and receiver.fresh[0]["timestamp_us"] == stamp
            same = same and receiver.fresh[0]["control"] == control and receiver.fresh[0]["counter"] == counter
            if not same:
                changed[0] += 1
            if receiver.last_counter[0] != last and code != status.FRAME_LOST_COUNTER:
                changed[1] += 1


def decode_many(table, can_ids, lengths, frames, last_counter, fresh, codes, changed):
    """Decode frames one after the other.

    Args:
        codes: i8[frame, 2], axis and status of each. changed: i8[2], frames that were not valid but changed `fresh`
        of axis 0 (0) or its `last_counter` other than by resynchronising (1).
    """
    receiver = decode.new_receiver(table, len(fresh))._replace(last_counter=last_counter, fresh=fresh)
    _decode_many(table, can_ids, lengths, frames, receiver, codes, changed)


@entry
def encode_one(table, message, quantities, counter, data):
    """encode.encode_measurement as Python can call it; what it clamps is not told."""
    clamped = np.zeros(table.signals.shape[0], np.int64)
    return encode.encode_measurement(table, message, quantities, counter, clamped, data)


@entry
def encode_counting(table, message, quantities, counter, clamped, data):
    """encode.encode_measurement as Python can call it, with its count of clamped values."""
    return encode.encode_measurement(table, message, quantities, counter, clamped, data)


@entry
def insert_one(signals, index, value, data):
    """bits.insert_bits as Python can call it."""
    bits.insert_bits(signals, index, value, data)


@entry
def extract_one(signals, index, data):
    """bits.extract_bits as Python can call it."""
    return bits.extract_bits(signals, index, data)


@entry
def number_one(signals, index, data):
    """bits.decode_number as Python can call it."""
    return bits.decode_number(signals, index, data)


@entry
def encode_si_one(signals, index, value, data):
    """bits.encode_si as Python can call it."""
    return bits.encode_si(signals, index, value, data)


@entry
def crc_one(data, length, data_id):
    """e2e.crc_p02 as Python can call it."""
    return e2e.crc_p02(data, length, data_id)


def padded(data: bytes) -> np.ndarray:
    """u1[64] with the data bytes in front and 0xA5 behind, which nobody may read."""
    out = np.full(64, 0xA5, np.uint8)
    out[: len(data)] = np.frombuffer(bytes(data), np.uint8)
    return out
