"""What `hilrunner check` says of a mapping: every message and signal as understood, and what is odd, with the remedy."""

from hilrunner.setup.contract import wiring
from hilrunner.setup.profile import load_profile
from hilrunner.setup.wire_text import whole_bus_load, wiring_dict, wiring_lines, wiring_notes
from tests.tools.make_dbc import Msg, Sig, write

FLOW = Msg("CMD", 0x18FE3021, 8, [
    Sig("Flow", 0, 8, scale="0.4", minimum="0", maximum="100", unit="%"), Sig("State", 16, 4), Sig("Ia", 24, 12, unit="mA"),
], extended=True, cycle_ms=10)  # fmt: skip
SENSORS = Msg("SENS", 200, 8, [
    Sig("P1", 7, 16, big_endian=True, scale="0.1", minimum="0", maximum="6553.5", unit="bar"), Sig("COUNTER", 48, 4), Sig("CHECKSUM", 56, 8),
])  # fmt: skip
PROFILE = """name = "told"
[[axis]]
name = "boom"
[can]
dbc = "own.dbc"
bitrate = 250000
[[can.mapping]]
[can.mapping.command]
message = "CMD"
%s
[[can.mapping.measurements]]
message = "SENS"
cycle_ms = 20
signals = { chamber_1_pressure = "P1"%s }
%s
"""


def understood(folder, command, more="", protection=""):
    write(folder, [FLOW, SENSORS])
    (folder / "p.toml").write_text(PROFILE % (command, more, protection))
    loaded = load_profile(str(folder / "p.toml"))
    return loaded, wiring(loaded)


DIRECTED = 'magnitude = "Flow"\ndirection = { signal = "State", extend = 1, retract = 2 }'


def test_every_message_and_signal_is_told(tmp_path):
    loaded, found = understood(tmp_path, DIRECTED)
    text = "\n".join(wiring_lines(loaded, found))
    assert "received CMD 0x18FE3021, 8 bytes, every 10 ms, protection: none" in text
    assert "Flow: magnitude of axis 1; 0|8 Intel unsigned; 0.4 x %, 0 to 100" in text
    assert "State: direction (1 extend, 2 retract; others: refused) of axis 1; 16|4 Intel" in text
    assert "P1: chamber_1_pressure of axis 1; 7|16 Motorola unsigned; 0.1 x bar, 0 to 6553.5" in text
    assert "stays constant: COUNTER = 0, CHECKSUM = 0" in text
    told = wiring_dict(found)
    assert told["received"][0]["id"] == 0x18FE3021 and told["sent"][0]["cycle_ms"] == 20
    assert 0 < whole_bus_load(loaded) < 0.1


def test_counters_and_checksums_nobody_fills_are_named(tmp_path):
    loaded, found = understood(tmp_path, DIRECTED)
    (note,) = wiring_notes(loaded, found)
    assert "SENS: COUNTER = 0, CHECKSUM = 0 looks like a counter or checksum that nobody fills" in note
    protection = 'protection = { counter = "COUNTER", checksum = "CHECKSUM", algorithm = "xor" }'
    assert wiring_notes(*understood(tmp_path, DIRECTED, protection=protection)) == []


def test_a_command_that_can_only_extend_is_told(tmp_path):
    notes = wiring_notes(*understood(tmp_path, 'valve_command = "Flow"'))
    assert any("(Flow) goes from 0 to 1 and can only extend" in note and "`magnitude`" in note for note in notes)
    notes = wiring_notes(*understood(tmp_path, 'current_a = { signal = "Ia", deadband = 300, full = 700 }'))
    assert any("can only extend" in note for note in notes)


def test_the_tick_is_no_counter_of_frames(tmp_path):
    notes = wiring_notes(*understood(tmp_path, DIRECTED, ', tick = "COUNTER"'))
    assert any("moves by 20 from frame to frame" in note and 'counter = "COUNTER"' in note for note in notes)


def test_a_flat_part_of_a_characteristic_is_told(tmp_path):
    loaded, found = understood(tmp_path, 'current_a = { signal = "Ia", deadband = 300, full = 700 }')
    assert any(
        "curve 0 to 0, 300 to 0, 700 to 1 (every value of 0..300 asks for the same)" in line
        for line in wiring_lines(loaded, found)
    )
