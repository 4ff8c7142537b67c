"""Messages by name: what cantools and autosar-e2e make of the same values, and refusals in words."""

import pytest

from hilrunner.base.errors import DbcError
from hilrunner.evidence.signals import Messages
from tests.tools import contract


@pytest.fixture
def messages():
    return Messages(contract.DBC)


def test_frames_are_those_of_an_independent_encoder(messages):
    for counter in range(20):
        made = messages.encode("VALVE_COMMAND_1", {"control": "Active", "valve_setpoint": 50.0, "timestamp_us": 7})
        wanted = contract.command_frame(1, setpoint_percent=50.0, timestamp_us=7, counter=counter % 16)
        assert made == bytes(wanted)


def test_a_test_can_send_a_wrong_crc_or_counter_on_purpose(messages):
    right = messages.encode("VALVE_COMMAND_1", {"alive_counter": 5})
    assert right == bytes(contract.command_frame(1, control=0, counter=5))
    assert messages.encode("VALVE_COMMAND_1", {"crc8": 0, "alive_counter": 5})[0] == 0


def test_decoded_values_are_numbers_and_words(messages):
    frame = messages.encode("BENCH_STATUS_1", {"bench_state": "fail-safe", "tick": 3})
    name, values = messages.decode(0x381, False, frame)
    assert name == "BENCH_STATUS_1"
    assert (values["bench_state"], values["tick"]) == ("fail-safe", 3)
    assert messages.decode(0x381, True, frame) is None
    assert messages.decode(0x381, False, frame[:3]) is None
    assert messages.decode(0x7FF, False, frame) is None


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("VALVE_COMAND_1", {}, "no such message.*VALVE_COMMAND_1"),
        ("VALVE_COMMAND_1", {"speed": 1}, "speed.*no such signal.*valve_setpoint"),
        ("VALVE_COMMAND_1", {"valve_setpoint": 200}, "cannot be encoded"),
        ("VALVE_COMMAND_1", {"control": "Fast"}, "cannot be encoded"),
    ],
)
def test_mistakes_are_refused_in_words(messages, name, values, words):
    with pytest.raises(DbcError, match=words):
        messages.encode(name, values)


def test_a_missing_dbc_is_refused(tmp_path):
    with pytest.raises(DbcError, match="none.dbc: no such file; remedy: "):
        Messages(tmp_path / "none.dbc")
