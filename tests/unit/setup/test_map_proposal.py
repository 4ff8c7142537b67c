"""What `hilrunner map` proposes: the right signals for their names, units and ranges, in a text that the profile's reader accepts."""

import pytest

from hilrunner import cli
from hilrunner.base.errors import DbcError
from hilrunner.setup.map_proposal import profile_text, propose
from hilrunner.setup.map_scores import words
from hilrunner.setup.profile import load_profile, parse_profile
from hilrunner.setup.signals import wire
from tests.tools import contract
from tests.tools.make_dbc import Msg, Sig, write

VALVE = Msg("VlvCmd", 0x18FE3021, 8, [
    Sig("FlowCmd", 0, 8, scale="0.4", minimum="0", maximum="100", unit="%"), Sig("ValveState", 16, 4), Sig("ValveEnable", 24, 2),
    Sig("RollingCounter", 48, 4), Sig("CRC8", 56, 8),
], extended=True, cycle_ms=10)  # fmt: skip
SENSORS = Msg("Sensors", 0x200, 8, [
    Sig("PressureBoreSide", 0, 16, scale="0.1", unit="bar"), Sig("PressureRodSide", 16, 16, scale="0.1", unit="bar"),
    Sig("CylPosition", 32, 16, scale="0.1", unit="mm"), Sig("OilTemp", 48, 8, offset="-40", unit="degC"),
])  # fmt: skip
TWO = Msg("HydraulicCommand", 0x300, 8, [
    Sig(f"{name}Cmd", 16 * k, 16, signed=True, scale="0.01", minimum="-100", maximum="100", unit="%") for k, name in enumerate(("Boom", "Stick"))
])  # fmt: skip
COILS = Msg(
    "SolenoidCurrents",
    0x310,
    8,
    [Sig("I_A", 0, 12, maximum="800", unit="mA"), Sig("I_B", 12, 12, maximum="800", unit="mA")],
)


def proposed(folder, messages, node=None):
    path = write(folder, messages)
    found = propose(path, node)
    text = profile_text(found, path.name, "proposal")
    profile = parse_profile(text, "proposal")
    return found, text, wire(path, list(profile.can.mapping))


def uses(axis):
    return {use: one.signal.name for use, one in (axis.command | axis.measurements).items()}


def test_magnitude_direction_enable_and_protection(tmp_path):
    found, text, _ = proposed(tmp_path, [VALVE, SENSORS])
    assert uses(found.axes[0]) == {
        "magnitude": "FlowCmd", "direction": "ValveState", "enable": "ValveEnable", "chamber_1_pressure": "PressureBoreSide",
        "chamber_2_pressure": "PressureRodSide", "rod_position": "CylPosition",
    }  # fmt: skip
    assert 'counter = "RollingCounter", checksum = "CRC8"' in text and "a guess" in text
    assert "# the name, unit bar" in text and "OilTemp" not in text


def test_each_actuator_of_a_common_frame_is_an_axis(tmp_path):
    sensors = [
        Msg(f"{name}Sensors", 0x200 + k, 8, [Sig("P1", 0, 16, scale="0.1", unit="bar")])
        for k, name in enumerate(("Boom", "Stick"))
    ]
    found, _, wiring = proposed(tmp_path, [TWO, *sensors])
    assert [axis.name for axis in found.axes] == ["boom", "stick"]
    assert [axis.measurements["chamber_1_pressure"].message.name for axis in found.axes] == [
        "BoomSensors",
        "StickSensors",
    ]
    assert len(wiring.commands.frames) == 1 and len(wiring.commands.groups) == 2


def test_currents_come_in_pairs_with_a_characteristic(tmp_path):
    found, text, _ = proposed(tmp_path, [COILS, SENSORS])
    assert uses(found.axes[0])["current_a"] == "I_A" and uses(found.axes[0])["current_b"] == "I_B"
    assert "full = 800" in text


def test_the_shipped_contract_is_found_again(tmp_path):
    found = propose(contract.DBC, "FIRMWARE")
    assert len(found.axes) == 4
    mapped = uses(found.axes[1])
    assert mapped["valve_command"] == "valve_setpoint" and mapped["control"] == "control"
    assert mapped["chamber_1_pressure"] == "chamber_1_pressure_kpa" and mapped["rod_velocity"] == "rod_velocity_mmps"
    assert found.axes[1].measurements["rod_position"].message.name == "MOTION_2"


def test_nothing_to_propose_is_one_line(tmp_path):
    with pytest.raises(DbcError, match="no signal that looks like a valve command.*Sensors.*--node"):
        propose(write(tmp_path, [SENSORS]))
    with pytest.raises(DbcError, match="no node 'ECU'"):
        propose(write(tmp_path, [VALVE]), "ECU")


@pytest.mark.parametrize(
    "name, text",
    [
        ("PressureBoreSide", "pressure bore side"),
        ("P1_Cyl", "p 1 cyl"),
        ("I_A", "i a"),
        ("pA", "p a"),
        ("CRC8", "crc 8"),
        ("HTTPPort2", "http port 2"),
    ],
)
def test_words_of_a_name(name, text):
    assert words(name) == text


def test_the_command_writes_a_profile_that_check_reads(tmp_path, capsys):
    path = write(tmp_path, [VALVE, SENSORS])
    assert cli.main(["map", str(path), "--out", str(tmp_path / "bench.toml")]) == 0
    assert load_profile(str(tmp_path / "bench.toml")).profile.can.dbc == "own.dbc"
    assert "written" in capsys.readouterr().err


def test_a_mapping_as_a_dbc_of_its_own(tmp_path):
    (tmp_path / "p.toml").write_text("""name = "own"
[[axis]]
name = "boom"
[can]
dbc = "own.dbc"
[[can.mapping]]
command = { message = "VlvCmd", magnitude = "FlowCmd", direction = { signal = "ValveState", extend = 1, retract = 2 } }
measurements = [{ message = "Sensors", cycle_ms = 20, signals = { chamber_1_pressure = { signal = "PressureBoreSide", scale = 0.2, range = [0, 600] } } }]
""")
    write(tmp_path, [VALVE, SENSORS, TWO])
    assert cli.main(["map", str(tmp_path / "p.toml"), "--dbc", str(tmp_path / "out.dbc")]) == 0
    import cantools

    database = cantools.database.load_file(tmp_path / "out.dbc")
    assert {message.name for message in database.messages} == {"VlvCmd", "Sensors"}
    sensors = database.get_message_by_name("Sensors")
    signal = sensors.get_signal_by_name("PressureBoreSide")
    assert (signal.scale, signal.maximum, signal.unit, sensors.cycle_time) == (0.2, 600, "bar", 20)
    assert "chamber_1_pressure" in signal.comment and sensors.senders == ["BENCH"]
    assert database.get_message_by_name("VlvCmd").frame_id == 0x18FE3021
