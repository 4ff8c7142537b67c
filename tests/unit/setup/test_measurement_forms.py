"""Every form a measurement may go out in: pages, curves, tables of states, constants, several axes in one frame; cantools reads them."""

import cantools
import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.base.errors import DbcError
from hilrunner.realtime import encode
from hilrunner.setup import signals
from hilrunner.setup.mapping import AxisMapping, CommandMapping, MeasurementMapping, Protection, SignalMapping
from tests.tools import codec_entries
from tests.tools.make_dbc import Msg, Sig, write

COMMAND = CommandMapping("CMD", valve_command="Valve")
MESSAGES = [
    Msg("CMD", 1, 8, [Sig("Valve", 0, 16, signed=True, scale="0.01", minimum="-100", maximum="100", unit="%")]),
    Msg("BOTH", 2, 8, [
        Sig("P1", 7, 16, big_endian=True, scale="0.1", unit="bar"), Sig("P2", 23, 16, big_endian=True, scale="0.1", unit="bar"),
        Sig("Kind", 32, 4), Sig("Temp", 40, 8, scale="0.5", offset="-40", unit="degC"),
    ]),
    Msg("STATE", 3, 4, [Sig("Machine", 0, 8), Sig("Loop", 8, 12, scale="0.01", offset="2", unit="mA"), Sig("Raw", 20, 12, unit="widgets")]),
    Msg("PAGES", 4, 8, [
        Sig("Page", 0, 4, multiplex="M "), Sig("Alive", 4, 4), Sig("Always", 48, 16, unit="bar"),
        Sig("A", 8, 16, scale="0.1", unit="bar", multiplex="m1 "), Sig("B", 8, 32, scale="0.001", unit="mm", multiplex="m5 "),
        Sig("C", 24, 16, scale="0.1", unit="bar", multiplex="m1 "), Sig("Unfilled", 8, 8, multiplex="m7 "),
    ], cycle_ms=10),
]  # fmt: skip


class Rig:
    """A measurement table, and cantools as the receiver."""

    def __init__(self, folder, *measurements_by_axis, more=""):
        path = write(folder, MESSAGES)
        path.write_text(path.read_text() + more)
        self.database = cantools.database.load_file(path, strict=False)
        mapping = [AxisMapping(COMMAND, list(one)) for one in measurements_by_axis]
        self.wiring = signals.wire(path, mapping)
        self.table = self.wiring.measurements
        self.quantities = encode.no_quantities(len(mapping))
        self.counters, self.clamped = (
            encode.send_counters(self.table),
            np.zeros(max(len(self.wiring.sent), 1), np.int64),
        )

    def set(self, axis=0, **values):
        for name, value in values.items():
            self.quantities[axis, encode.QUANTITY_NAMES.index(name)] = value

    def at(self, tick):
        """Message name -> decoded values of what is due at a tick."""
        found = {}
        for message in range(self.table.message_count):
            if tick % self.table.period_ticks[message] == self.table.phase[message]:
                data = codec_entries.padded(b"")
                length = codec_entries.encode_counting(
                    self.table, message, self.quantities, self.counters, self.clamped, data
                )
                described = self.database.get_message_by_frame_id(int(self.table.can_id[message]))
                assert described.name not in found, "one frame of a message a tick"
                found[described.name] = described.decode(bytes(data[:length]), decode_choices=False)
        return found


def test_several_axes_in_one_frame_and_constants(tmp_path):
    rig = Rig(
        tmp_path,
        [MeasurementMapping("BOTH", {"chamber_1_pressure": "P1"}, constants={"Kind": 5, "Temp": 60.5})],
        [MeasurementMapping("BOTH", {"chamber_1_pressure": "P2"})],
    )
    rig.set(0, chamber_1_pressure=91e5)
    rig.set(1, chamber_1_pressure=12.3e5)
    assert rig.table.message_count == 1 and rig.table.axes[0] == 0b11
    assert rig.at(0)["BOTH"] == {"P1": 91.0, "P2": pytest.approx(12.3), "Kind": 5, "Temp": 60.5}
    assert rig.wiring.sent_facts[0].constants == ["Kind = 5", "Temp = 60.5"]


def test_one_quantity_in_two_signals(tmp_path):
    rig = Rig(tmp_path, [MeasurementMapping("BOTH", {"chamber_1_pressure": ["P1", "P2"]})])
    rig.set(chamber_1_pressure=50e5)
    decoded = rig.at(0)["BOTH"]
    assert decoded["P1"] == decoded["P2"] == 50.0


def test_a_transmitter_of_4_to_20_ma(tmp_path):
    curve = SignalMapping("Loop", curve=[(4.0, 0.0), (20.0, 400.0)], unit="bar")
    rig = Rig(tmp_path, [MeasurementMapping("STATE", {"chamber_1_pressure": curve})])
    for bar, current, clamped in ((0, 4, 0), (100, 8, 0), (400, 20, 0), (401, 20, 1), (-1, 4, 2)):
        rig.set(chamber_1_pressure=bar * 1e5)
        assert rig.at(0)["STATE"]["Loop"] == pytest.approx(current)
        assert rig.clamped[0] == clamped, "beyond the curve's ends counts as clamped"


def test_a_falling_curve_and_one_without_an_inverse(tmp_path):
    falling = SignalMapping("Loop", curve=[(4.0, 2000.0), (12.0, 500.0), (20.0, 0.0)], unit="mm")
    rig = Rig(tmp_path, [MeasurementMapping("STATE", {"rod_position": falling})])
    for millimetres, current in ((2000, 4), (500, 12), (250, 16), (0, 20)):
        rig.set(rod_position=millimetres * 1e-3)
        assert rig.at(0)["STATE"]["Loop"] == pytest.approx(current, abs=0.0051)
    with pytest.raises(DbcError, match="the curve has no inverse"):
        flat = SignalMapping("Loop", curve=[(4.0, 0.0), (5.0, 0.0), (20.0, 400.0)], unit="bar")
        Rig(tmp_path, [MeasurementMapping("STATE", {"chamber_1_pressure": flat})])


def test_the_benchs_state_in_a_table_of_the_firmwares_own(tmp_path):
    more = 'VAL_ 3 Machine 10 "INIT" 20 "RUN" 99 "FAULT" ;\n'
    own = SignalMapping("Machine", values={"waiting": "init", "active": "RUN", "hold": 30}, other="fault")
    rig = Rig(tmp_path, [MeasurementMapping("STATE", {"bench_state": own})], more=more)
    seen = []
    for mode in range(len(status.MODE_NAMES)):
        rig.set(bench_state=mode)
        seen.append(rig.at(0)["STATE"]["Machine"])
    assert seen == [10, 99, 30, 20, 99, 99, 99] and not rig.clamped.any()
    for values, found in (
        ({"waiting": 1}, "says nothing of disabled"),
        ({"asleep": 1}, "no state 'asleep'"),
        ({"waiting": "x"}, "no 'x'"),
    ):
        with pytest.raises(DbcError, match=found):
            other = 0 if "x" in values.values() or "asleep" in values else None
            Rig(
                tmp_path,
                [MeasurementMapping("STATE", {"bench_state": SignalMapping("Machine", values=values, other=other)})],
                more=more,
            )


def test_scale_offset_unit_and_range_of_the_mapping(tmp_path):
    own = SignalMapping("Raw", scale=0.5, offset=-100.0, unit="mm", range=(0.0, 1900.0))
    rig = Rig(tmp_path, [MeasurementMapping("STATE", {"rod_position": own})])
    for metres, raw, clamped in ((0.6, 1400, 0), (0.0, 200, 0), (-0.001, 200, 1), (1.9, 4000, 1), (2.0, 4000, 2)):
        rig.set(rod_position=metres)
        assert rig.at(0)["STATE"]["Raw"] == raw and rig.clamped[0] == clamped


def test_pages_take_turns_and_share_their_counter(tmp_path):
    mapped = {"chamber_1_pressure": "A", "rod_position": "B", "chamber_2_pressure": "C", "supply_pressure": "Always"}
    rig = Rig(tmp_path, [MeasurementMapping("PAGES", mapped, protection=Protection(counter="Alive"))])
    rig.set(chamber_1_pressure=91e5, chamber_2_pressure=5e5, rod_position=0.6005, supply_pressure=300e5)
    frames = []
    for tick in range(200):
        frames += [(tick, values) for values in rig.at(tick).values()]
    assert [tick for tick, _ in frames] == list(range(0, 200, 10)), "the cycle time is that of the frames"
    assert [values["Page"] for _, values in frames] == [1, 5] * 10
    assert [values["Alive"] for _, values in frames] == [number % 16 for number in range(20)]
    assert frames[0][1] == {"Page": 1, "Alive": 0, "Always": 300, "A": 91.0, "C": 5.0}
    assert frames[1][1] == {"Page": 5, "Alive": 1, "Always": 300, "B": pytest.approx(600.5)}
    assert "2 pages in turns" in rig.wiring.sent_facts[0].notes[0]
    assert [sent.name for sent in rig.wiring.sent].count("PAGES.Always") == 2


@pytest.mark.parametrize("entries, found", [
    ([MeasurementMapping("BOTH", {"chamber_1_pressure": "P1", "chamber_2_pressure": "P1"})], "share bits (P1, P1)"),
    ([MeasurementMapping("BOTH", {"pressure": "P1"})], "no quantity 'pressure'"),
    ([MeasurementMapping("CMD", {"valve_command": "Valve"})], "identifier 0x1 is mapped twice"),
    ([MeasurementMapping("STATE", {"rod_position": "Raw"})], "unit 'widgets' is not one of a length"),
    ([MeasurementMapping("STATE", {"rod_position": SignalMapping("Raw", values={"active": 1})})], "`values` with rod_position"),
    ([MeasurementMapping("STATE", {"rod_position": SignalMapping("Raw", unit="mm", full=3.0)})], "belong to commands"),
    ([MeasurementMapping("BOTH", constants={"Temp": 500.0})], "constant 500.0 does not fit"),
    ([MeasurementMapping("BOTH", constants={"Nope": 1})], "no signal 'Nope'"),
    ([MeasurementMapping("BOTH", cycle_ms=5.0), MeasurementMapping("BOTH", cycle_ms=6.0)], "different cycle_ms"),
])  # fmt: skip
def test_measurements_that_cannot_be_sent(tmp_path, entries, found):
    with pytest.raises(DbcError) as error:
        Rig(tmp_path, entries)
    assert found in str(error.value)
