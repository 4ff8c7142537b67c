"""Random values and frames through four codecs: ours, cantools, the generated C, and autosar-e2e for the protection."""

import e2e.p02
import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.base.units import WIRE_UNITS
from hilrunner.realtime import decode, encode
from hilrunner.setup import signals
from tests.tools import codec_entries, contract, firmware_c

SEED = 4711
KINDS = ("VALVE_COMMAND", "PRESSURES", "MOTION", "BENCH_STATUS", "HEAVE")
COUNT = 400


def random_values(message, rng) -> dict[str, float]:
    """Physical values within the ranges, on and off the grid of the wire."""
    values = {}
    for signal in message.signals:
        if signal.name in ("crc8", "alive_counter"):
            continue
        value = rng.uniform(signal.minimum, signal.maximum)
        values[signal.name] = value if signal.scale != 1 else float(int(value))
    return values


def c_packed(lib, ffi, kind: str, axis: int, values: dict[str, float], counter: int) -> bytes:
    struct = ffi.new(f"actuator_{kind.lower()}_t *")
    for name, value in values.items():
        setattr(struct, name, value if isinstance(getattr(struct, name), float) else int(value))
    data, count = ffi.new("uint8_t[8]"), ffi.new("uint8_t *", (counter - 1) % 16)
    assert getattr(lib, f"actuator_{kind.lower()}_pack")(data, axis, count, struct) == 8
    return bytes(data)


@pytest.mark.parametrize("kind", KINDS)
def test_c_and_cantools_make_the_same_frames(kind):
    ffi, lib = firmware_c.load()
    rng = np.random.default_rng(SEED)
    for number in range(COUNT):
        axis, counter = 1 + number % 4, number % 16
        message = contract.database().get_message_by_name(f"{kind}_{axis}")
        values = random_values(message, rng)
        data = c_packed(lib, ffi, kind, axis, values, counter)
        expected = contract.protected(message.name, message.encode({**values, "crc8": 0, "alive_counter": counter}))
        assert data == bytes(expected), values


@pytest.mark.parametrize("kind", KINDS[1:])
def test_our_measurements_are_those_of_cantools(kind):
    _, table = contract.tables(4)
    rng = np.random.default_rng(SEED)
    counters = encode.send_counters(table)
    for number in range(COUNT):
        axis = 1 + number % 4
        message = contract.database().get_message_by_name(f"{kind}_{axis}")
        index = int(np.flatnonzero(table.can_id == message.frame_id)[0])
        values = random_values(message, rng)
        quantities = encode.no_quantities(4)
        mapped = signals.default_mapping(4)[axis - 1].measurements[KINDS.index(kind) - 1]
        for quantity, name in mapped.signals.items():
            unit = message.get_signal_by_name(name).unit or ""
            factor = float(WIRE_UNITS[signals.QUANTITY_KINDS[quantity]][unit])
            quantities[axis - 1, encode.QUANTITY_NAMES.index(quantity)] = values[name] * factor
        data = codec_entries.padded(b"")
        codec_entries.encode_one(table, index, quantities, counters, data)
        values |= {"crc8": 0, "alive_counter": int(counters[index])}
        assert bytes(data[:8]) == bytes(contract.protected(message.name, message.encode(values)))


def test_our_commands_are_those_of_cantools():
    table, _ = contract.tables(4)
    rng = np.random.default_rng(SEED)
    fresh, last = decode.fresh_commands(4), decode.no_counters(4)
    for number in range(COUNT):
        axis, counter = 1 + number % 4, (number // 4 + 1) % 16
        frame = contract.command_frame(
            axis,
            control=int(rng.integers(0, 4)),
            setpoint_percent=rng.uniform(-100, 100),
            timestamp_us=int(rng.integers(0, 1 << 32)),
            counter=counter,
        )
        got = codec_entries.decode_one(table, 0x200 + axis, 8, codec_entries.padded(frame), last, fresh)
        assert got == (axis - 1, status.FRAME_VALID)
        read = contract.database().decode_message(0x200 + axis, bytes(frame), decode_choices=False)
        taken = fresh[axis - 1]
        assert taken["valve_command"] * 100 == pytest.approx(read["valve_setpoint"], abs=1e-12)
        assert (taken["control"], taken["timestamp_us"]) == (read["control"], read["timestamp_us"])


def test_c_and_ours_judge_the_same_frames_alike():
    """A stream of mutated frames through both decoders: same verdict on each, same values, same counters after it."""
    ffi, lib = firmware_c.load()
    table, _ = contract.tables(1)
    rng = np.random.default_rng(SEED)
    fresh, last = decode.fresh_commands(1), decode.no_counters(1)
    receiver, values = ffi.new("e2e_p02_receiver_t *"), ffi.new("actuator_valve_command_t *")
    lib.e2e_p02_receiver_init(receiver, signals.MAX_COUNTER_DELTA)
    seen = set()
    for _ in range(5000):
        frame = contract.command_frame(counter=int(rng.integers(0, 16)))
        frame[1:8] = bytes([frame[1] & 0x2F | int(rng.integers(0, 6)) << 4]) + rng.bytes(7 - 1)
        if rng.random() < 0.8:
            frame = contract.protected("VALVE_COMMAND_1", frame)
        length = 8 if rng.random() < 0.95 else int(rng.integers(0, 8))
        ours = codec_entries.decode_one(table, 0x201, length, codec_entries.padded(frame), last, fresh)[1]
        theirs = lib.actuator_valve_command_unpack(bytes(frame), length, 1, receiver, values)
        assert ours == theirs
        seen.add(ours)
        assert last[0] == (receiver.last_counter if receiver.begun else -1)
        assert fresh[0]["valve_command"] * 100 == pytest.approx(values.valve_setpoint, abs=1e-12)
        assert (fresh[0]["control"], fresh[0]["timestamp_us"]) == (values.control, values.timestamp_us)
    assert seen == {
        status.FRAME_VALID, status.FRAME_WRONG_LENGTH, status.FRAME_BAD_CRC, status.FRAME_REPEATED_COUNTER,
        status.FRAME_LOST_COUNTER, status.FRAME_OUT_OF_RANGE, status.FRAME_BAD_CONTROL,
    }  # fmt: skip


@pytest.mark.parametrize("length", [2, 3, 8, 12, 48, 64])
def test_crc_of_any_length_is_that_of_autosar_e2e(length):
    ffi, lib = firmware_c.load()
    rng = np.random.default_rng(SEED + length)
    for counter in range(16):
        ids, frame = rng.bytes(16), bytearray(rng.bytes(length))
        frame[1] = frame[1] & 0xF0 | counter
        e2e.p02.e2e_p02_protect(frame, ids, increment_counter=False)
        assert codec_entries.crc_one(codec_entries.padded(frame), length, ids[counter]) == frame[0]
        assert lib.e2e_p02_crc(bytes(frame), length, ids[counter]) == frame[0]


def test_c_encodes_stay_in_range_and_round_to_even():
    ffi, lib = firmware_c.load()
    for value, raw in (
        (float("nan"), 0), (float("inf"), 20_000_000), (-float("inf"), -20_000_000), (1e300, 20_000_000),
        (0.0005, 0), (0.0015, 2), (-0.0005, 0), (-0.0015, -2), (0.00051, 1), (19999.9996, 20_000_000),
    ):  # fmt: skip
        data = c_packed(lib, ffi, "MOTION", 1, {"rod_position_mm": value}, 1)
        assert int.from_bytes(data[2:6], "little", signed=True) == raw, value


def test_c_sends_no_neighbour_of_an_unknown_control_word():
    ffi, lib = firmware_c.load()
    for control in range(256):
        data = c_packed(lib, ffi, "VALVE_COMMAND", 1, {"control": control}, 1)
        assert data[1] >> 4 == (control if control <= 3 else 0)


def test_c_refuses_an_axis_the_dbc_does_not_have():
    ffi, lib = firmware_c.load()
    data, counter, values = ffi.new("uint8_t[8]"), ffi.new("uint8_t *", 5), ffi.new("actuator_motion_t *")
    receiver = ffi.new("e2e_p02_receiver_t *")
    for axis in (0, 5, 0xFFFFFFFF):
        assert lib.actuator_motion_pack(data, axis, counter, values) == 0
        assert lib.actuator_motion_unpack(data, 8, axis, receiver, values) == status.FRAME_UNKNOWN_ID
    assert bytes(data) == bytes(8) and counter[0] == 5
