"""actuator.dbc keeps what the contract promises: names, units, ranges, comments, attributes; axes alike but for ids."""

import itertools
import re

import pytest

from hilrunner.base import status
from tests.tools import contract

BASES = {"VALVE_COMMAND": 0x200, "PRESSURES": 0x180, "MOTION": 0x280, "BENCH_STATUS": 0x380, "HEAVE": 0x480}
UNIT_OF_SUFFIX = {"kpa": "kPa", "mm": "mm", "mmps": "mm/s", "us": "us"}
MESSAGES = contract.database().messages
SIGNALS = [(message, signal) for message in MESSAGES for signal in message.signals]


def signal_names(pairs):
    return [f"{message.name}.{signal.name}" for message, signal in pairs]


def test_messages_and_identifiers():
    assert len(MESSAGES) == 20
    for message in MESSAGES:
        name, axis = re.fullmatch(r"(\w+)_(\d)", message.name).groups()
        assert message.frame_id == BASES[name] + int(axis) and not message.is_extended_frame
        assert message.length == 8 and not message.is_fd and message.comment and message.send_type == "Cyclic"
        firmware = name == "VALVE_COMMAND"
        assert message.senders == (["FIRMWARE"] if firmware else ["BENCH"])
        assert message.receivers == ({"BENCH"} if firmware else {"FIRMWARE"})
        assert message.cycle_time == (10 if name in ("BENCH_STATUS", "HEAVE") else 1)


def test_nodes_are_named_and_explained():
    assert {node.name for node in contract.database().nodes} == {"FIRMWARE", "BENCH"}
    assert all(node.comment for node in contract.database().nodes)


@pytest.mark.parametrize("message, signal", SIGNALS, ids=signal_names(SIGNALS))
def test_every_signal_says_what_it_is(message, signal):
    assert signal.comment and signal.minimum is not None and signal.minimum < signal.maximum
    assert signal.receivers and signal.byte_order == "little_endian"
    assert signal.raw_initial == 0
    assert re.fullmatch(r"[a-z][a-z0-9_]*", signal.name)
    suffix = signal.name.rsplit("_", 1)[-1]
    if suffix in UNIT_OF_SUFFIX:
        assert signal.unit == UNIT_OF_SUFFIX[suffix]
    elif signal.name == "valve_setpoint":
        assert signal.unit == "%" and signal.scale * 16384 == 100
    else:
        assert not signal.unit and signal.scale == 1
    full = ((1 << signal.length) - 1) if not signal.is_signed else (1 << signal.length - 1) - 1
    assert signal.maximum <= full * signal.scale + signal.offset


def test_protection_is_declared_and_in_its_place():
    for message in MESSAGES:
        assert message.dbc.attributes["E2EProfile"].value == "P02"
        crc, counter = message.get_signal_by_name("crc8"), message.get_signal_by_name("alive_counter")
        assert (crc.start, crc.length, counter.start, counter.length) == (0, 8, 8, 4)


def test_data_ids_differ_between_any_two_messages_at_every_counter():
    lists = [contract.data_ids(message.name) for message in MESSAGES]
    assert all(len(ids) == 16 for ids in lists)
    for one, other in itertools.combinations(lists, 2):
        assert all(a != b for a, b in zip(one, other, strict=True))


def test_data_ids_stay_apart_for_the_most_axes_make_axes_allows():
    make_axes = contract.make_axes()
    for counter in range(16):
        ids = [make_axes.data_id_list(name, axis)[counter] for axis in range(1, 51) for name in make_axes.MESSAGES]
        assert len(set(ids)) == len(ids) == 250 and max(ids) <= 250


def test_value_tables_are_those_of_the_status_codes():
    choices = contract.database().get_message_by_name("BENCH_STATUS_1").get_signal_by_name("bench_state").choices
    assert [str(choices[mode]) for mode in range(len(status.MODE_NAMES))] == list(status.MODE_NAMES)
    choices = contract.database().get_message_by_name("BENCH_STATUS_1").get_signal_by_name("flags").choices
    sent = [(bit, name) for bit, name in enumerate(status.FLAG_NAMES) if status.BUS_FLAGS >> bit & 1]
    assert len(sent) == 7 and [str(choices[1 << bit]) for bit, _ in sent] == [name for _, name in sent]
    choices = contract.database().get_message_by_name("VALVE_COMMAND_1").get_signal_by_name("control").choices
    codes = (status.CONTROL_DISABLED, status.CONTROL_HOLD, status.CONTROL_ACTIVE, status.CONTROL_RESET)
    assert [str(choices[code]) for code in codes] == ["Disabled", "Hold", "Active", "Reset"]


def test_axes_are_made_from_axis_1_and_the_file_is_up_to_date():
    make_axes, text = contract.make_axes(), contract.DBC.read_text(encoding="utf-8")
    assert make_axes.with_axes(text, 4) == text
    alone = make_axes.with_axes(text, 1)
    assert "_2" not in alone.replace("chamber_2", "") and make_axes.with_axes(alone, 4) == text
    for count in (0, 51):
        with pytest.raises(ValueError, match="1..50"):
            make_axes.with_axes(text, count)
