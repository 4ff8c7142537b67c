"""What a mapping is accepted for it carries: over drawn databases and mappings no wrong bit is sent, and no value is clamped unseen."""

import math
import tempfile
from pathlib import Path

import cantools
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hilrunner.base import status
from hilrunner.base.errors import DbcError
from hilrunner.base.units import WIRE_UNITS
from hilrunner.realtime import decode, encode
from hilrunner.setup import signals
from hilrunner.setup.mapping import AxisMapping, CommandMapping, MeasurementMapping, Protection, SignalMapping
from hilrunner.setup.quantities import QUANTITY_KINDS
from tests.tools import codec_entries
from tests.tools.make_dbc import Msg, Sig, write

STEADY = settings(max_examples=60, deadline=None, derandomize=True, database=None)
QUANTITIES = [
    name for name, kind in QUANTITY_KINDS.items() if kind in ("pressure", "length", "velocity", "force", "ratio")
]
SCALES = ("1", "0.5", "0.1", "0.001", "0.006103515625", "-0.25", "3")


@st.composite
def layouts(draw, length_bytes, count):
    """Signals that do not overlap: each takes a run of bits of its own, in either byte order."""
    # whole bytes, because the byte orders number the bits of one byte differently
    count = min(count, length_bytes)
    cuts = [
        8 * cut
        for cut in sorted(draw(st.lists(st.integers(1, length_bytes), min_size=count, max_size=count, unique=True)))
    ]
    found = []
    for number, (first, end) in enumerate(zip([0, *cuts[:-1]], cuts, strict=True)):
        width = min(draw(st.integers(1, 64)), end - first)
        big_endian = draw(st.booleans())
        is_float = width >= 32 and draw(st.booleans())
        width = 32 if is_float else width
        start = first // 8 * 8 + 7 - first % 8 if big_endian else first
        kind = draw(st.sampled_from(QUANTITIES))
        unit = draw(st.sampled_from([name for name in WIRE_UNITS[QUANTITY_KINDS[kind]] if name.isascii()]))
        scale, offset = (
            ("1", "0") if is_float else (draw(st.sampled_from(SCALES)), draw(st.sampled_from(("0", "-40", "12.5"))))
        )
        limits = draw(st.sampled_from([("0", "0"), ("0", "1"), ("-100", "100"), ("0", "6000")]))
        signed = draw(st.booleans())
        signal = Sig(
            f"s{number}", start, width, big_endian, signed, scale, offset, *limits, unit, 32 if is_float else 0
        )
        found.append((signal, kind))
    return found


@st.composite
def buses(draw):
    """A message with mapped and unmapped signals, and values for the quantities."""
    length = draw(st.sampled_from((8, 8, 8, 5, 16, 64)))
    found = draw(layouts(length, draw(st.integers(1, 5))))
    mapped = {kind: signal.name for signal, kind in found if draw(st.booleans())}
    values = {kind: draw(st.floats(-1e8, 1e8) | st.sampled_from([0.0, 9.05e6, 0.6, math.nan])) for kind in mapped}
    starts = tuple((signal.name, draw(st.integers(0, 1))) for signal, _ in found if not signal.float_bits)
    return length, [signal for signal, _ in found], mapped, values, starts


def wired(message, command, measurement):
    with tempfile.TemporaryDirectory() as folder:
        path = write(
            Path(folder), [Msg("CMD", 1, 8, [Sig("Valve", 0, 16, signed=True, scale="0.01", unit="%")]), message]
        )
        database = cantools.database.load_file(path, strict=False)
        return database, signals.wire(path, [AxisMapping(command, [measurement])])


@STEADY
@given(buses())
def test_sent_signals_carry_their_value_or_are_counted(bus):
    length, layout, mapped, values, starts = bus
    command = CommandMapping("CMD", valve_command=SignalMapping("Valve", range=(-100.0, 100.0)))
    try:
        database, wiring = wired(
            Msg("SENS", 2, length, layout, starts=starts), command, MeasurementMapping("SENS", mapped)
        )
    except DbcError:
        return
    table, described = wiring.measurements, database.get_message_by_name("SENS")
    quantities, clamped = encode.no_quantities(1), np.zeros(max(len(wiring.sent), 1), np.int64)
    for name, value in values.items():
        quantities[0, encode.QUANTITY_NAMES.index(name)] = value
    data = codec_entries.padded(b"")
    assert codec_entries.encode_counting(table, 0, quantities, encode.send_counters(table), clamped, data) == length
    decoded = described.decode(bytes(data[:length]), decode_choices=False)
    raw = described.decode(bytes(data[:length]), decode_choices=False, scaling=False)
    for sent, count in zip(wiring.sent, clamped, strict=False):
        unit = float(WIRE_UNITS[QUANTITY_KINDS[sent.quantity]][sent.signal.unit])
        wanted = values[sent.quantity] / unit
        step = abs(float(sent.signal.scale)) * (0 if sent.signal.is_float else 0.5)
        near = abs(decoded[sent.signal.name] - wanted) <= step * (1 + 1e-9) + 1e-6 * abs(wanted) + 1e-9
        assert count == 1 or near, (sent.name, wanted, decoded[sent.signal.name])
        if count:
            ends = (sent.row["number_min"], sent.row["number_max"])
            number = raw[sent.signal.name] if not sent.signal.is_float else decoded[sent.signal.name]
            assert math.isnan(wanted) or any(abs(number - end) <= 1e-6 * abs(end) for end in ends), (
                "the end of the range"
            )
    for name, start in starts:
        if name not in mapped.values():
            signal = described.get_signal_by_name(name)
            full = -1 if signal.is_signed and signal.length == 1 and start else start
            assert raw[name] == full, "nobody writes into another signal's bits"


PROTECTIONS = st.sampled_from([
    "none", Protection(profile="P01", data_id=0x123), Protection(profile="P05", data_id=0x4321), Protection(profile="P06", data_id=0x77),
    Protection(profile="J1939"), Protection(counter="Alive"), Protection(counter="Alive", checksum="Check", algorithm="xor"),
    Protection(checksum="Check", algorithm="CRC-8/SAE-J1850", include=["id"]),
])  # fmt: skip


@STEADY
@given(
    PROTECTIONS, st.lists(st.tuples(st.floats(-1.2, 1.2), st.booleans(), st.integers(0, 63)), min_size=1, max_size=30)
)
def test_received_commands_are_those_sent_or_refused(protection, stream):
    """The bench's own frames are taken; one with a bit turned over never moves the valve, unless nothing protects it."""
    layout = [Sig("Valve", 40, 16, signed=True, scale="0.01", minimum="-100", maximum="100", unit="%")]
    if (
        not isinstance(protection, str)
        and protection.counter
        or not isinstance(protection, str)
        and protection.checksum
    ):
        layout += [Sig("Alive", 8, 4), Sig("Check", 16, 8)]
    message = Msg("SENS", 2, 8, layout)
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder), [message, Msg("CMD", 3, 8, layout)])
        sent = MeasurementMapping("SENS", {"valve_command": "Valve"}, protection=protection)
        out = signals.wire(path, [AxisMapping(CommandMapping("CMD", valve_command="Valve"), [sent])]).measurements
        back = CommandMapping("SENS", valve_command="Valve", protection=protection)
        table = signals.wire(path, [AxisMapping(back, [])]).commands
    quantities, counters, clamped = encode.no_quantities(1), encode.send_counters(out), np.zeros(1, np.int64)
    receiver = decode.new_receiver(table, 1)
    guarded = protection != "none" and not (
        not isinstance(protection, str) and protection.counter and not protection.checksum
    )
    for tick, (value, turned, bit) in enumerate(stream):
        quantities[0, encode.QUANTITY_VALVE_COMMAND] = value
        data = codec_entries.padded(b"")
        codec_entries.encode_counting(out, 0, quantities, counters, clamped, data)
        before = receiver.fresh[0]["valve_command"]
        if turned and guarded:
            broken = data.copy()
            broken[bit // 8] ^= np.uint8(1 << bit % 8)
            code = codec_entries.decode_with(table, 2, 8, broken, tick, receiver)[1]
            assert code != status.FRAME_VALID
            assert receiver.fresh[0]["valve_command"] == before
            receiver.last_counter[0] = (
                receiver.last_counter[0] if code != status.FRAME_LOST_COUNTER else decode.e2e.NO_COUNTER
            )
        assert codec_entries.decode_with(table, 2, 8, data, tick, receiver)[1] == status.FRAME_VALID
        assert abs(receiver.fresh[0]["valve_command"] - min(max(value, -1.0), 1.0)) <= 0.5001e-4
