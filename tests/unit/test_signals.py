"""setup.signals: an own DBC by mapping, units and ranges, cycle times, protection, and every refusal with its words."""

import msgspec
import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.base.errors import DbcError
from hilrunner.realtime import bits, decode, encode
from hilrunner.setup import signal_layout, signals
from tests.tools import codec_entries, contract
from tests.tools.make_dbc import Msg, Sig, write

IDS = " ".join(str(value) for value in range(1, 17))
VALVE = Sig("Valve", 16, 16, signed=True, scale="0.1", minimum="-100", maximum="100", unit="%")
COMMAND = Msg("CMD", 0x300, 8, [VALVE, Sig("Mode", 12, 4), Sig("Time", 32, 32, unit="us")], data_ids=IDS)
PRESSURE = Sig("P1", 7, 12, big_endian=True, scale="0.5", maximum="600", unit="bar")
SENSORS = Msg(
    "SENS", 0x18FEF100, 8, [PRESSURE, Sig("Alive", 24, 8), Sig("X", 32, 32, float_bits=32, unit="mm")], extended=True,
    cycle_ms=5, starts=(("Alive", 0x5A),),
)  # fmt: skip


def own_mapping(**changes):
    command = signals.CommandMapping("CMD", "Valve", control="Mode", timestamp="Time")
    sensors = signals.MeasurementMapping("SENS", {"chamber_1_pressure": "P1", "rod_position": "X"})
    return [
        signals.AxisMapping(
            msgspec.structs.replace(command, **changes.get("command", {})),
            [msgspec.structs.replace(sensors, **changes.get("sensors", {}))],
        )
    ]


def load(tmp_path, messages=(COMMAND, SENSORS), period_ns=1_000_000, **changes):
    return signals.load_signals(write(tmp_path, list(messages)), own_mapping(**changes), period_ns)


def refused(tmp_path, messages=(COMMAND, SENSORS), **changes) -> str:
    with pytest.raises(DbcError) as caught:
        load(tmp_path, messages, **changes)
    assert caught.value.place.startswith("own.dbc") and caught.value.exit_code == 2
    return str(caught.value)


def test_the_default_mapping_is_the_contract():
    command, measurement = signals.load_signals(contract.DBC, signals.default_mapping(2))
    assert [hex(value) for value in command.can_id] == ["0x201", "0x202"]
    assert [hex(value) for value in measurement.can_id] == [
        "0x181",
        "0x281",
        "0x381",
        "0x481",
        "0x182",
        "0x282",
        "0x382",
        "0x482",
    ]
    assert list(measurement.axes) == [1, 1, 1, 1, 2, 2, 2, 2], "bit k: axis k"
    assert list(measurement.period_ticks) == [1, 1, 10, 10, 1, 1, 10, 10]
    assert np.all(measurement.protected == 1) and np.all(command.protected == 1) and not np.any(measurement.fd)
    assert measurement.message_count == 8
    assert len({int(measurement.phase[index]) for index in (2, 3, 6, 7)}) == 4, (
        "slow messages do not fall on the same tick"
    )


def test_tables_cannot_be_written():
    for table in contract.tables(2):
        for part in table:
            if isinstance(part, np.ndarray):
                with pytest.raises(ValueError, match="read-only"):
                    part[...] = 0


def test_an_own_dbc_by_mapping(tmp_path):
    command, measurement = load(tmp_path)
    assert command.can_id[0] == 0x300 and command.protected[0] == 1 and list(command.data_ids[0]) == list(range(1, 17))
    row = command.signals[0]
    assert command.fields[0]["role"] == decode.INPUT_SETPOINT
    assert row["scale"] == 0.001 and (row["number_min"], row["number_max"]) == (-1000, 1000)
    assert measurement.can_id[0] == 0x18FEF100 | decode.CAN_EFF_FLAG and measurement.period_ticks[0] == 5
    quantities = encode.no_quantities(1)
    quantities[0, encode.QUANTITY_CHAMBER_1_PRESSURE] = 9.05e6  # 90.5 bar = raw 181 = 0x0B5
    quantities[0, encode.QUANTITY_ROD_POSITION] = 0.6005  # float32 600.5 = 0x44162000
    data, counters = codec_entries.padded(b""), encode.send_counters(measurement)
    assert codec_entries.encode_one(measurement, 0, quantities, counters, data) == 8
    # 12 bits big-endian from byte 0 bit 7: 0B 5x; start value of the unmapped signal in byte 3; the float little-endian
    assert bytes(data[:8]) == bytes.fromhex("0B 50 00 5A 00 20 16 44")
    assert counters[0] == 0, "an unprotected message has no counter"


def test_fd_messages_are_marked(tmp_path):
    _, measurement = load(tmp_path, (COMMAND, SENSORS._replace(length=24)))
    assert measurement.fd[0] == 1 and measurement.length[0] == 24


def test_fd_messages_need_an_fd_bus(tmp_path):
    path = write(tmp_path, [COMMAND, SENSORS._replace(length=24)])
    with pytest.raises(DbcError, match=r"SENS: is a CAN FD message \(24 bytes\).*fd = true"):
        signals.load_signals(path, own_mapping(), fd=False)
    assert "25 data bytes" in refused(tmp_path, (COMMAND, SENSORS._replace(length=25)))


def test_an_unprotected_command_without_control_word_is_active(tmp_path):
    plain = COMMAND._replace(data_ids="")
    command, _ = load(tmp_path, (plain, SENSORS), command={"control": None, "timestamp": None})
    fresh, last = decode.fresh_commands(1), decode.no_counters(1)
    data = codec_entries.padded(bytes.fromhex("FFFF F401 FFFFFFFF"))  # 500 * 0.1 % = 50 %
    for _ in range(2):  # nothing repeats where nothing counts
        assert codec_entries.decode_one(command, 0x300, 8, data, last, fresh) == (0, status.FRAME_VALID)
    assert fresh[0]["valve_command"] == 0.5 and fresh[0]["control"] == status.CONTROL_ACTIVE
    assert fresh[0]["counter"] == 0 and last[0] == -1


def test_control_values_of_another_device(tmp_path):
    plain = COMMAND._replace(data_ids="")
    values = {"disabled": 0, "hold": 3, "active": 7, "reset": 15}
    command, _ = load(tmp_path, (plain, SENSORS), command={"control_values": values})
    found = {}
    for raw in range(16):
        fresh, last = decode.fresh_commands(1), decode.no_counters(1)
        data = codec_entries.padded(bytes([0, raw << 4, 0, 0, 0, 0, 0, 0]))
        code = codec_entries.decode_one(command, 0x300, 8, data, last, fresh)[1]
        found[raw] = int(fresh[0]["control"]) if code == status.FRAME_VALID else code
    assert found == {raw: {0: 0, 3: 1, 7: 2, 15: 3}.get(raw, status.FRAME_BAD_CONTROL) for raw in range(16)}


def test_units_can_be_given_where_the_dbc_has_none(tmp_path):
    bare = COMMAND._replace(signals=[VALVE._replace(unit="widgets"), *COMMAND.signals[1:]])
    assert "unit 'widgets' is not one of a ratio" in refused(tmp_path, (bare, SENSORS))
    mapped = signals.SignalMapping("Valve", unit="%")
    command, _ = load(tmp_path, (bare, SENSORS), command={"valve_command": mapped})
    assert command.signals[0]["scale"] == 0.001
    mapped = signals.SignalMapping("Valve", factor=-0.01)
    command, _ = load(tmp_path, (bare, SENSORS), command={"valve_command": mapped})
    assert command.signals[0]["scale"] == -0.001, "a sign change belongs to the mapping"


@pytest.mark.parametrize(
    "unit, value_si", [("Pa", 1.0), ("kPa", 1e3), ("bar", 1e5), ("MPa", 1e6), ("hPa", 100.0), ("mbar", 100.0)]
)
def test_pressure_units(tmp_path, unit, value_si):
    one = Sig("P1", 0, 32, unit=unit)
    _, measurement = load(tmp_path, (COMMAND, SENSORS._replace(signals=[one, SENSORS.signals[2]])))
    assert measurement.signals[0]["scale"] == value_si


def test_command_range_is_cut_to_full_valve(tmp_path):
    wide = COMMAND._replace(signals=[VALVE._replace(minimum="-200", maximum="200"), *COMMAND.signals[1:]])
    command, _ = load(tmp_path, (wide, SENSORS))
    row = command.signals[0]
    assert (row["number_min"], row["number_max"]) == (-1000, 1000)


def test_cycle_times_in_periods(tmp_path):
    for period_ns, cycle, expected in (
        (1_000_000, 5, 5),
        (2_000_000, 5, 2),
        (10_000_000, 5, 1),
        (500_000, 5, 10),
        (3_000_000, 5, 2),
    ):
        _, measurement = load(tmp_path, period_ns=period_ns, sensors={"cycle_ms": float(cycle)})
        assert measurement.period_ticks[0] == expected
    _, measurement = load(tmp_path, (COMMAND, SENSORS._replace(cycle_ms=None)))
    assert measurement.period_ticks[0] == 1


def test_wrapping_quantities_wrap_at_the_width(tmp_path):
    _, measurement = contract.tables(1)
    modulus = {
        encode.QUANTITY_NAMES[q]: s["modulus"] for q, s in zip(measurement.quantity, measurement.signals, strict=True)
    }
    assert {name for name, value in modulus.items() if value > 0} == {"tick", "echoed_timestamp"}
    assert modulus["tick"] == modulus["echoed_timestamp"] == 65536.0


def test_refusals_name_the_place_and_what_would_do(tmp_path):
    assert "no such message" in refused(tmp_path, command={"message": "NOPE"})
    assert "no signal 'Nope'" in refused(tmp_path, command={"valve_command": "Nope"})
    assert "Mode, Valve, Time" in refused(tmp_path, command={"control": "Nope"})
    assert "no quantity 'pressure'" in refused(tmp_path, sensors={"signals": {"pressure": "P1"}})
    assert "mapped twice" in refused(tmp_path, sensors={"message": "CMD", "signals": {"tick": "Time"}})
    assert "E2EProfile 'P22'" in refused(tmp_path, (COMMAND._replace(profile="P22"), SENSORS))
    assert "16 numbers" in refused(tmp_path, (COMMAND._replace(data_ids="1 2 3"), SENSORS))
    assert "16 numbers" in refused(tmp_path, (COMMAND._replace(data_ids=IDS.replace("16", "x")), SENSORS))
    assert "1..14" in refused(tmp_path, command={"max_counter_delta": 15})
    assert "one value twice" in refused(tmp_path, command={"control_values": {"hold": 1, "active": 1}})


def test_layouts_that_cannot_work(tmp_path):
    def with_valve(**changes):
        return COMMAND._replace(signals=[VALVE._replace(**changes), *COMMAND.signals[1:]]), SENSORS

    assert "share bits" in refused(tmp_path, with_valve(start=8)), "on the counter"
    assert "share bits" in refused(tmp_path, with_valve(start=24)), "on the time stamp"
    assert "reaches beyond" in refused(tmp_path, with_valve(start=56))
    assert "scale of 0" in refused(tmp_path, with_valve(scale="0"))
    assert "holds nothing between -1 and 1" in refused(tmp_path, with_valve(minimum="150", maximum="200"))
    assert "holds no value" in refused(tmp_path, with_valve(minimum="4000", maximum="5000"))
    stamp = COMMAND._replace(signals=[*COMMAND.signals[:2], Sig("Time", 32, 32, scale="0.5", unit="us")])
    assert "whole microseconds" in refused(tmp_path, (stamp, SENSORS))


def test_files_that_are_no_dbc(tmp_path):
    mapping = signals.default_mapping(1)
    with pytest.raises(DbcError, match="no such file"):
        signals.load_signals(tmp_path / "missing.dbc", mapping)
    for number, content in enumerate((b"", b"hello", b"\x00\xff\x00", b"BO_ 1 M: 8 X\n SG_ broken")):
        path = tmp_path / f"{number}.dbc"
        path.write_bytes(content)
        with pytest.raises(DbcError):
            signals.load_signals(path, mapping)


def test_more_axes_than_the_dbc_has():
    with pytest.raises(DbcError, match=r"VALVE_COMMAND_5: no such message.*make_axes"):
        signals.load_signals(contract.DBC, signals.default_mapping(5))


def test_more_axes_made_for_it(tmp_path):
    path = tmp_path / "many.dbc"
    path.write_text(contract.make_axes().with_axes(contract.DBC.read_text(), 12))
    command, measurement = signals.load_signals(path, signals.default_mapping(12))
    assert command.can_id[11] == 0x20C and measurement.message_count == 48


def test_mappings_come_from_toml():
    text = """
    [command]
    message = "CMD"
    valve_command = { signal = "Valve", unit = "%" }
    control = "Mode"
    control_values = { hold = 1, active = 2 }
    protection = "none"
    [[measurements]]
    message = "SENS"
    signals = { chamber_1_pressure = "P1", rod_position = { signal = "X", unit = "mm" } }
    cycle_ms = 5
    protection = { data_id_list = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16] }
    """
    mapped = msgspec.toml.decode(text, type=signals.AxisMapping)
    assert mapped.command.valve_command.unit == "%" and mapped.measurements[0].protection.data_id_list[15] == 16
    with pytest.raises(msgspec.ValidationError, match="unknown field"):
        msgspec.toml.decode(text.replace("control =", "contrl ="), type=signals.AxisMapping)


def test_a_signal_of_nine_bytes_is_read_through_two_windows():
    places = signal_layout.bit_places(3, 64, "little_endian")
    assert signal_layout.windows(places, False) == [(0, 3, 61, 0), (8, 0, 3, 61)]
    assert len(places) == 64 and places[-1] // 8 == 8
    assert bits.WINDOW_COUNT_MAX * 8 * bits.WINDOW_BYTES >= 64 + 7


@pytest.mark.parametrize("byte_order", ["little_endian", "big_endian"])
def test_no_window_reaches_beyond_the_data(byte_order):
    for start in range(512):
        for length in (1, 12, 57, 64):
            places = signal_layout.bit_places(start, length, byte_order)
            if not 0 <= min(places) <= max(places) < 512:
                continue
            cut = signal_layout.windows(places, byte_order == "big_endian")
            assert 1 <= len(cut) <= bits.WINDOW_COUNT_MAX
            assert all(0 <= first <= 56 and 0 <= shift < 64 for first, shift, _, _ in cut)
            assert sum(width for _, _, width, _ in cut) == length
