"""Frames worked out by hand, against three codecs (ours, cantools, the C) and autosar-e2e.

The expected bytes are in firmware_iface/golden_frames.csv, each with its source; none was made by the code under test.
"""

import e2e.p02
import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.base.units import WIRE_UNITS
from hilrunner.realtime import decode, encode
from hilrunner.setup import signals
from tests.tools import codec_entries, contract, firmware_c

GOLDEN = contract.golden_frames()
COMMANDS = [frame for frame in GOLDEN if frame.message == "VALVE_COMMAND"]
MEASUREMENTS = [frame for frame in GOLDEN if frame.message != "VALVE_COMMAND"]


def names(frames):
    return [f"{frame.message}_{frame.axis}-{frame.data.hex()}" for frame in frames]


def counter_of(frame):
    return frame.data[1] & 0x0F


def test_every_message_and_every_use_is_there():
    assert {frame.message for frame in GOLDEN} == set(contract.make_axes().MESSAGES)
    assert {frame.use for frame in GOLDEN} == {"both", "send", "bench"}
    assert {frame.axis for frame in GOLDEN} == {1, 2, 3, 4}


def test_the_published_vector_of_profile_2():
    assert contract.data_ids("VALVE_COMMAND_1") == bytes(range(1, 17))
    assert COMMANDS[0].data == bytes.fromhex("1B01000000000000")


@pytest.mark.parametrize("frame", GOLDEN, ids=names(GOLDEN))
def test_identifier_and_protection(frame):
    message = contract.database().get_message_by_name(f"{frame.message}_{frame.axis}")
    assert message.frame_id == frame.can_id and message.length == len(frame.data)
    ids = contract.data_ids(message.name)
    assert e2e.p02.e2e_p02_check(frame.data, ids, length=0)
    crc = codec_entries.crc_one(codec_entries.padded(frame.data), len(frame.data), ids[counter_of(frame)])
    assert crc == frame.data[0]
    ffi, lib = firmware_c.load()
    assert lib.e2e_p02_crc(frame.data, len(frame.data), ids[counter_of(frame)]) == frame.data[0]


@pytest.mark.parametrize("frame", COMMANDS, ids=names(COMMANDS))
def test_our_decoder(frame):
    table, _ = contract.tables(4)
    fresh, last = decode.fresh_commands(4), decode.no_counters(4)
    data = codec_entries.padded(frame.data)
    assert codec_entries.decode_one(table, frame.can_id, 8, data, last, fresh) == (frame.axis - 1, status.FRAME_VALID)
    taken = fresh[frame.axis - 1]
    assert taken["valve_command"] == frame.values["valve_setpoint"] / 100
    assert taken["control"] == frame.values["control"]
    assert taken["timestamp_us"] == frame.values["timestamp_us"]
    assert taken["counter"] == last[frame.axis - 1] == counter_of(frame)


@pytest.mark.parametrize("frame", MEASUREMENTS, ids=names(MEASUREMENTS))
def test_our_encoder(frame):
    _, table = contract.tables(4)
    quantities = encode.no_quantities(4)
    mapped = next(
        entry
        for entry in signals.default_mapping(4)[frame.axis - 1].measurements
        if entry.message == f"{frame.message}_{frame.axis}"
    )
    for quantity, signal in mapped.signals.items():
        unit = contract.database().get_message_by_name(mapped.message).get_signal_by_name(signal).unit or ""
        factor = float(WIRE_UNITS[signals.QUANTITY_KINDS[quantity]][unit])
        quantities[frame.axis - 1, encode.QUANTITY_NAMES.index(quantity)] = frame.values[signal] * factor
    counters = encode.send_counters(table)
    message = int(np.flatnonzero(table.can_id == frame.can_id)[0])
    counters[message] = (counter_of(frame) - 1) % 16
    data = codec_entries.padded(b"")
    assert codec_entries.encode_one(table, message, quantities, counters, data) == 8
    assert bytes(data[:8]) == frame.data
    assert np.all(data[8:] == 0xA5)


@pytest.mark.parametrize("frame", GOLDEN, ids=names(GOLDEN))
def test_cantools(frame):
    message = contract.database().get_message_by_name(f"{frame.message}_{frame.axis}")
    decoded = message.decode(frame.data, decode_choices=False)
    if frame.use == "both":
        assert {name: pytest.approx(value, abs=1e-9) for name, value in frame.values.items()} == {
            name: value for name, value in decoded.items() if name in frame.values
        }
    assert decoded["alive_counter"] == counter_of(frame)
    assert message.encode(decoded) == frame.data


def c_prefix(frame):
    return f"actuator_{frame.message.lower()}"


@pytest.mark.parametrize(
    "frame", [f for f in GOLDEN if f.use != "bench"], ids=names(f for f in GOLDEN if f.use != "bench")
)
def test_c_pack(frame):
    ffi, lib = firmware_c.load()
    values = ffi.new(f"{c_prefix(frame)}_t *")
    for name, value in frame.values.items():
        setattr(values, name, value if isinstance(getattr(values, name), float) else int(value))
    data, counter = ffi.new("uint8_t[8]"), ffi.new("uint8_t *", (counter_of(frame) - 1) % 16)
    assert getattr(lib, f"{c_prefix(frame)}_pack")(data, frame.axis, counter, values) == 8
    assert bytes(data) == frame.data
    assert counter[0] == counter_of(frame)


@pytest.mark.parametrize(
    "frame", [f for f in GOLDEN if f.use == "both"], ids=names(f for f in GOLDEN if f.use == "both")
)
def test_c_unpack(frame):
    ffi, lib = firmware_c.load()
    values, receiver = ffi.new(f"{c_prefix(frame)}_t *"), ffi.new("e2e_p02_receiver_t *")
    lib.e2e_p02_receiver_init(receiver, 3)
    unpack = getattr(lib, f"{c_prefix(frame)}_unpack")
    assert unpack(frame.data, 8, frame.axis, receiver, values) == lib.FRAME_VALID
    assert {name: pytest.approx(value, abs=1e-9) for name, value in frame.values.items()} == {
        name: getattr(values, name) for name in frame.values
    }
    assert receiver.begun and receiver.last_counter == counter_of(frame)
