"""Every path of the codec that no shipped contract takes: pages, lines, directions, curves, checksums, a function of the user's own."""

import tempfile
from pathlib import Path

import numpy as np

from hilrunner.realtime import decode, encode
from hilrunner.setup import signals
from hilrunner.setup.mapping import (
    AxisMapping,
    CommandMapping,
    DirectionMapping,
    LineMapping,
    MeasurementMapping,
    Protection,
    SignalMapping,
)
from tests.tools import codec_entries
from tests.tools.make_dbc import Msg, Sig, write

OWN = "def check(data, length, counter, sent):\n    if sent:\n        data[7] = data[0] + 1\n        return counter + 1\n    return counter + 1 if data[7] == data[0] + 1 else -1\n"
VALVE = Sig("Valve", 0, 16, signed=True, scale="0.01", minimum="-100", maximum="100", unit="%")
PROTECTIONS = (
    "none",
    "mine.py:check",
    Protection(profile="P01", data_id=0x123, data_id_mode="alternating", offset_bytes=4),
    Protection(profile="P06", data_id=0x123, offset_bytes=3),
    Protection(profile="J1939"),
    Protection(counter="Alive", checksum="Check", algorithm="xor"),
    Protection(counter="Alive", checksum="Check", algorithm="nibble-sum", negated=True),
    Protection(counter="Alive", checksum="Check", algorithm="CRC-8/MAXIM-DOW", data_id_list=list(range(16))),
    Protection(checksum="Half", polynomial=0x3, reflect_out=True),
)


def guarded(folder, protection):
    """Both tables of one protected layout."""
    layout = [VALVE, Sig("Alive", 48, 4), Sig("Half", 52, 4), Sig("Check", 56, 8)]
    path = write(folder, [Msg("CMD", 1, 8, layout), Msg("SENS", 2, 8, layout)])
    (folder / "mine.py").write_text(OWN)
    command = CommandMapping("CMD", valve_command="Valve", protection=protection)
    return signals.load_signals(
        path, [AxisMapping(command, [MeasurementMapping("SENS", {"valve_command": "Valve"}, protection=protection)])]
    )


def exchange(commands, measurements, receiver, value, counters, tick):
    """One frame sent and one received with the same bytes; what came of both."""
    quantities = encode.no_quantities(2)
    quantities[:] = value
    clamped = np.zeros(16, np.int64)
    data = np.zeros(64, np.uint8)
    length = codec_entries.encode_counting(measurements, 0, quantities, counters, clamped, data)
    axis, code = codec_entries.decode_with(commands, int(commands.can_id[0]), length, data, tick, receiver)
    return [axis, code, *data[:8], *clamped[:4]]


def forms(folder):
    """Tables of one bus with lines, a direction, pages and curves."""
    path = write(folder, [
        Msg("CMD", 1, 8, [
            Sig("Page", 0, 4, multiplex="M "), Sig("Flow", 8, 8, scale="0.4", unit="%", multiplex="m1 "), Sig("State", 16, 4, multiplex="m1 "),
            Sig("Ia", 8, 12, unit="mA", multiplex="m2 "), Sig("Ib", 20, 12, unit="mA", multiplex="m2 "), Sig("Stop", 40, 2),
        ]),
        Msg("LINES", 3, 1, [Sig("On", 0, 2), Sig("Dump", 2, 2), Sig("Reset", 4, 2)]),
        Msg("SENS", 2, 8, [Sig("Loop", 0, 12, scale="0.01", unit="mA"), Sig("Machine", 16, 8)]),
    ])  # fmt: skip
    flow = CommandMapping(
        "CMD", magnitude="Flow", direction=DirectionMapping("State", extend=1, retract=2), safety="Stop",
        enable=LineMapping("On", message="LINES"), dump=LineMapping("Dump", message="LINES"), reset=LineMapping("Reset", message="LINES"),
    )  # fmt: skip
    coils = CommandMapping(
        "CMD", current_a=SignalMapping("Ia", full=700.0, deadband=300.0), current_b=SignalMapping("Ib", full=700.0)
    )
    loop = SignalMapping("Loop", curve=[(4.0, 0.0), (20.0, 400.0)], unit="bar")
    state = SignalMapping("Machine", values={"active": 7}, other=9)
    sent = MeasurementMapping("SENS", {"chamber_1_pressure": loop, "bench_state": state})
    return signals.load_signals(path, [AxisMapping(flow, [sent]), AxisMapping(coils, [])])


def wire_forms(out):
    """Everything above into `out`, name -> array."""
    seen = []
    with tempfile.TemporaryDirectory() as folder:
        for number, protection in enumerate(PROTECTIONS):
            commands, measurements = guarded(Path(folder), protection)
            receiver, counters = decode.new_receiver(commands, 1), encode.send_counters(measurements)
            for tick, value in enumerate((0.25, -0.5, 2.0, np.nan)):
                seen.append(exchange(commands, measurements, receiver, value, counters, tick))
            out[f"wire fresh {number}"] = receiver.fresh["valve_command"].copy()
        commands, measurements = forms(Path(folder))
    receiver, counters = decode.new_receiver(commands, 2), encode.send_counters(measurements)
    fresh = []
    for tick, (can_id, text) in enumerate((
        (1, "01 64 01 00 00 00 00 00"), (3, "01"), (1, "01 64 02 00 00 00 00 00"), (3, "05"), (3, "11"), (3, "00"), (3, "02"),
        (1, "02 F4 81 25 00 00 00 00"), (1, "01 64 05 00 00 00 00 00"), (1, "03 00 00 00 00 01 00 00"), (1, "02 F4 01 00 00 00 00 00"),
    )):  # fmt: skip
        data = codec_entries.padded(bytes.fromhex(text))
        fresh.append([*codec_entries.decode_with(commands, can_id, len(bytes.fromhex(text)), data, tick, receiver)])
        fresh.append([*receiver.fresh["valve_command"], *receiver.fresh["control"], *receiver.fresh["valid_tick"]])
    for value in (3.0, 1e7, 9e7, np.nan):
        seen.append(exchange(commands, measurements, receiver, value, counters, 50))
    out["wire frames"] = np.array(seen, np.int64)
    out["wire fresh"] = np.array([number for row in fresh for number in row], np.float64)
