"""Any DBC layout: our tables against cantools, for random signals of either byte order, width, scale and type."""

import math
from fractions import Fraction

import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilrunner.base import status
from hilrunner.realtime import bits, decode, encode
from hilrunner.setup import signal_layout, signals
from tests.tools import codec_entries, contract
from tests.tools.make_dbc import Msg, Sig, text

STEADY = settings(max_examples=80, deadline=None, derandomize=True, database=None)


ANY_WIDTH = st.integers(1, 64)


@st.composite
def layouts(draw, widths=ANY_WIDTH):
    """(start, length, big_endian, message bytes) of one signal anywhere in a message."""
    length_bytes = 64 if draw(st.booleans()) else 8
    width = draw(widths)
    first = draw(st.integers(0, length_bytes * 8 - width))
    big_endian = draw(st.booleans())
    if not big_endian:
        return first, width, False, length_bytes
    # big-endian bits run on in "network" numbering: byte * 8 + (7 - bit)
    return first // 8 * 8 + 7 - first % 8, width, True, length_bytes


def rows_of(signal: Sig, length: int):
    """(cantools message, one-row table) of a message that holds just this signal."""
    message = cantools.database.load_string(text([Msg("M", 0x100, length, [signal])]), "dbc").messages[0]
    return message, np.array([signal_layout.row("x", message.signals[0], Fraction(1), False)], bits.SIGNAL)


@STEADY
@given(layouts(), st.booleans(), st.data())
def test_raw_bits_are_those_of_cantools(layout, signed, data):
    start, width, big_endian, length = layout
    message, table = rows_of(Sig("s", start, width, big_endian, signed), length)
    raw = data.draw(
        st.integers(-(1 << width - 1), (1 << width - 1) - 1) if signed else st.integers(0, (1 << width) - 1)
    )
    expected = message.encode({"s": raw}, scaling=False, strict=False)
    pattern = data.draw(st.integers(0, 255))
    ours = np.full(64, pattern, np.uint8)
    codec_entries.insert_one(table, 0, np.uint64(raw & (1 << width) - 1), ours)
    mask = message.encode({"s": -1 if signed else (1 << width) - 1}, scaling=False, strict=False)
    kept = bytes(value | pattern & ~own & 0xFF for value, own in zip(expected, mask, strict=True))
    assert bytes(ours[:length]) == kept, "the signal's bits, and no others"
    assert int(codec_entries.extract_one(table, 0, ours)) == raw & (1 << width) - 1
    assert codec_entries.number_one(table, 0, ours) == float(raw)


SCALES = ["1", "0.5", "0.1", "0.001", "0.006103515625", "-0.25", "3", "0.0625", "1e-05"]


@STEADY
@given(
    layouts(st.integers(2, 40)),
    st.booleans(),
    st.sampled_from(SCALES),
    st.sampled_from(["0", "-40", "12.5"]),
    st.data(),
)
def test_values_come_back_within_half_a_bit(layout, signed, scale, offset, data):
    start, width, big_endian, length = layout
    message, table = rows_of(Sig("s", start, width, big_endian, signed, scale, offset), length)
    low, high = float(table["number_min"][0]), float(table["number_max"][0])
    ends = sorted(raw * float(scale) + float(offset) for raw in (low, high))
    value = data.draw(st.floats(*ends, allow_nan=False))
    frame = np.zeros(64, np.uint8)
    codec_entries.encode_si_one(table, 0, value, frame)
    back = message.decode(bytes(frame[:length]))["s"]
    assert abs(back - value) <= abs(float(scale)) * 0.5 * (1 + 1e-9) + 1e-12 * abs(value)
    ours = codec_entries.number_one(table, 0, frame) * table["scale"][0] + table["offset"][0]
    assert ours == pytest.approx(back, rel=1e-12, abs=1e-12)


@STEADY
@given(layouts(st.integers(2, 40)), st.booleans(), st.floats(allow_nan=True, allow_infinity=True))
def test_no_value_leaves_the_range(layout, signed, value):
    start, width, big_endian, length = layout
    low, high = (-1, 1) if signed else (1, 2)
    message, table = rows_of(Sig("s", start, width, big_endian, signed, minimum=str(low), maximum=str(high)), length)
    frame = np.zeros(64, np.uint8)
    codec_entries.encode_si_one(table, 0, value, frame)
    raw = message.decode(bytes(frame[:length]), scaling=False)["s"]
    assert low <= raw <= high
    if math.isnan(value):
        assert raw == max(low, 0), "NaN is sent as the number nearest to 0"


@pytest.mark.parametrize("value, raw", [(math.nan, 5), (math.inf, 9), (-math.inf, 5), (7.4, 7), (7.5, 8), (8.5, 8)])
def test_values_that_are_no_number_or_no_whole_number(value, raw):
    message, table = rows_of(Sig("s", 3, 12, minimum="5", maximum="9"), 8)
    frame = np.zeros(64, np.uint8)
    codec_entries.encode_si_one(table, 0, value, frame)
    assert message.decode(bytes(frame[:8]), scaling=False)["s"] == raw


@STEADY
@given(layouts(st.just(32)), st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_float32_signals(layout, value):
    start, width, big_endian, length = layout
    message, table = rows_of(Sig("s", start, width, big_endian, float_bits=32), length)
    frame = np.zeros(64, np.uint8)
    codec_entries.encode_si_one(table, 0, value, frame)
    assert message.decode(bytes(frame[:length]))["s"] == value
    assert codec_entries.number_one(table, 0, frame) == value


@STEADY
@given(layouts(st.just(64)), st.floats(allow_nan=False, allow_infinity=False))
def test_float64_signals(layout, value):
    start, width, big_endian, length = layout
    message, table = rows_of(Sig("s", start, width, big_endian, float_bits=64), length)
    frame = np.zeros(64, np.uint8)
    codec_entries.encode_si_one(table, 0, value, frame)
    assert message.decode(bytes(frame[:length]))["s"] == value
    assert codec_entries.number_one(table, 0, frame) == value


@pytest.mark.parametrize("width", [32, 64])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1.5, -1.5, 0.5, -1.0])
def test_float_commands(tmp_path, width, value):
    signal = Sig("u", 7, width, big_endian=True, float_bits=width, unit="", minimum="-1", maximum="1")
    path = tmp_path / "own.dbc"
    path.write_text(text([Msg("CMD", 0x18FF0102, 64, [signal], extended=True)]))
    table, _ = signals.load_signals(path, [signals.AxisMapping(signals.CommandMapping("CMD", "u"), [])])
    message = cantools.database.load_file(path, strict=False).messages[0]
    fresh, last = decode.fresh_commands(1), decode.no_counters(1)
    frame = codec_entries.padded(message.encode({"u": value}, strict=False))
    got = codec_entries.decode_one(table, 0x18FF0102 | decode.CAN_EFF_FLAG, 64, frame, last, fresh)
    if math.isnan(value):
        assert got == (0, status.FRAME_NOT_A_NUMBER)
    elif abs(value) > 1:
        assert got == (0, status.FRAME_OUT_OF_RANGE)
    else:
        assert got == (0, status.FRAME_VALID) and fresh[0]["valve_command"] == value
    assert fresh[0]["control"] == (status.CONTROL_ACTIVE if got[1] == status.FRAME_VALID else 0)


@STEADY
@given(st.binary(min_size=0, max_size=64), st.integers(0, 0xFFFFFFFF))
def test_random_bytes_never_reach_the_command_without_a_valid_status(payload, can_id):
    table, _ = contract.tables(1)
    fresh, last = decode.fresh_commands(1), decode.no_counters(1)
    axis, code = codec_entries.decode_one(table, can_id, len(payload), codec_entries.padded(payload), last, fresh)
    assert -1 <= axis <= 0 and 0 <= code < status.FRAME_STATUS_COUNT
    if code != status.FRAME_VALID:
        assert fresh.tobytes() == decode.fresh_commands(1).tobytes() and last[0] == -1


@STEADY
@given(st.lists(st.floats(-1e12, 1e12), min_size=encode.QUANTITY_COUNT, max_size=encode.QUANTITY_COUNT))
def test_every_sent_frame_is_decodable_by_cantools_within_its_ranges(values):
    _, table = contract.tables(1)
    quantities, counters = np.array([values]), encode.send_counters(table)
    for message in range(table.message_count):
        frame = np.zeros(64, np.uint8)
        length = codec_entries.encode_one(table, message, quantities, counters, frame)
        described = contract.database().get_message_by_frame_id(int(table.can_id[message]))
        decoded = described.decode(bytes(frame[:length]), decode_choices=False)
        for signal in described.signals:
            assert signal.minimum <= decoded[signal.name] <= signal.maximum, signal.name
