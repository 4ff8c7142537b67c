"""A signal that cannot carry what its quantity will be is told before the run, and counted while it runs."""

import json

import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.realtime import encode
from hilrunner.setup import signals
from hilrunner.setup.axes import build_axes
from hilrunner.setup.profile import load_profile
from hilrunner.setup.wire_span import wire_warnings
from tests.tools import codec_entries
from tests.tools.make_dbc import Msg, Sig, write

VALVE = Sig("Valve", 0, 16, signed=True, scale="0.01", minimum="-100", maximum="100", unit="%")
PROFILE = """name = "spans"
[[axis]]
name = "boom"
circuit = "lift"
%s
[can]
dbc = "own.dbc"
[[can.mapping]]
[can.mapping.command]
message = "CMD"
valve_command = "Valve"
[[can.mapping.measurements]]
message = "SENS"
signals = { %s }
"""
WAVE = "[axis.wave]\nsignificant_height_m = 8.0\npeak_period_s = 8.0"


def told(folder, sensors, mapped, wave=""):
    write(folder, [Msg("CMD", 100, 8, [VALVE]), Msg("SENS", 200, 8, sensors)])
    (folder / "p.toml").write_text(PROFILE % (wave, mapped))
    loaded = load_profile(str(folder / "p.toml"))
    return wire_warnings(loaded, build_axes(loaded, status.ENGINE_REFERENCE))


def pressure(**words):
    return Sig("P1", 0, 16, scale="0.1", unit="bar", **words)


def test_a_range_left_at_0_1_is_told_with_value_end_and_remedy(tmp_path):
    (text,) = told(tmp_path, [pressure(minimum="0", maximum="1")], 'chamber_1_pressure = "P1"')
    assert "own.dbc: SENS.P1: the chamber 1 pressure starts at 90." in text and "0 bar to 1 bar" in text
    assert "is sent as 1 bar" in text and "range = [lowest, highest]" in text


def test_the_mapping_can_give_the_range(tmp_path):
    sensors = [pressure(minimum="0", maximum="1")]
    assert told(tmp_path, sensors, 'chamber_1_pressure = { signal = "P1", range = [0, 600] }') == []
    assert told(tmp_path, sensors, 'chamber_1_pressure = { signal = "P1", range = [0, 0] }') == []


def test_a_range_that_ends_short_of_the_plant_is_told(tmp_path):
    (text,) = told(tmp_path, [pressure(minimum="0", maximum="250")], 'chamber_1_pressure = "P1"')
    assert "may reach 300 bar" in text and "would be sent as 250 bar" in text
    (text,) = told(tmp_path, [Sig("X", 0, 8, scale="4", unit="mm")], 'rod_position = "X"')
    assert "may reach 2000 mm" in text and "1020 mm" in text
    (text,) = told(tmp_path, [Sig("V", 0, 8, unit="mm/s")], 'rod_velocity = "V"')
    assert "rod velocity may reach -" in text


def test_heave_is_judged_by_the_sea(tmp_path):
    heave = [Sig("Z", 0, 8, signed=True, unit="cm")]
    (text,) = told(tmp_path, heave, 'heave_position = "Z"', WAVE)
    assert "heave position may reach" in text
    assert told(tmp_path, heave, 'heave_position = "Z"') == []


def test_the_shipped_profiles_give_no_warning():
    for name in ("amc-lift", "wave-hs05"):
        loaded = load_profile(name)
        assert wire_warnings(loaded, build_axes(loaded, status.ENGINE_REFERENCE)) == []


@pytest.mark.parametrize(
    "value, count",
    [(0.0, 0), (99.9e5, 0), (100.04e5, 0), (100.06e5, 1), (-0.04e5, 0), (-0.06e5, 1), (np.nan, 1), (np.inf, 1)],
)
def test_a_value_that_is_not_sent_is_counted(tmp_path, value, count):
    path = write(tmp_path, [Msg("CMD", 100, 8, [VALVE]), Msg("SENS", 200, 8, [pressure(minimum="0", maximum="100")])])
    mapped = signals.AxisMapping(
        signals.CommandMapping("CMD", "Valve"), [signals.MeasurementMapping("SENS", {"chamber_1_pressure": "P1"})]
    )
    _, table = signals.load_signals(path, [mapped])
    quantities, clamped = encode.no_quantities(1), np.zeros(1, np.int64)
    quantities[0, encode.QUANTITY_CHAMBER_1_PRESSURE] = value
    data = np.zeros(64, np.uint8)
    for _ in range(3):
        codec_entries.encode_counting(table, 0, quantities, encode.send_counters(table), clamped, data)
    assert clamped.tolist() == [3 * count]


def test_what_was_clamped_is_in_the_recorders_closing_words(tmp_path):
    from hilrunner.base import ring as ring_layout
    from hilrunner.record.statistics import clamped_counts
    from hilrunner.setup.arm import local_ring

    ring = local_ring(ring_layout.RingShape(1, 16, 16, 16, 8, 10, 64, sent_signal_count=3))
    ring.clamped_count[:] = [0, 7, 2]
    assert clamped_counts(ring, ["A.x", "A.y", "B.z"]) == {"A.y": 7, "B.z": 2}
    assert json.dumps(clamped_counts(ring, ["A.x", "A.y", "B.z"]))
