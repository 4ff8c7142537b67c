"""Frames that must not be used: each kind gets its own status, and changes nothing but the caller's counter of it."""

import numpy as np
import pytest
from e2e import p02 as e2e_p02

from hilrunner.base import status
from hilrunner.realtime import decode, e2e
from hilrunner.setup import signals
from tests.tools import codec_entries, contract

VALVE_ID = 0x201


@pytest.fixture
def bench():
    """A bench that has already accepted one frame on axis 0 (counter 1)."""
    return Bench()


class Bench:
    """Decoder state of two axes."""

    def __init__(self) -> None:
        self.table, _ = contract.tables(2)
        self.fresh = decode.fresh_commands(2)
        self.last = decode.no_counters(2)
        assert self.give(contract.command_frame(setpoint_percent=25.0, timestamp_us=7)) == (0, status.FRAME_VALID)

    def give(self, data, can_id=VALVE_ID, length=None):
        frame = codec_entries.padded(data)
        return codec_entries.decode_one(
            self.table, can_id, len(data) if length is None else length, frame, self.last, self.fresh
        )

    def snapshot(self):
        return self.fresh.tobytes(), self.last.tobytes()


def flipped(frame: bytearray, bit: int) -> bytearray:
    out = bytearray(frame)
    out[bit // 8] ^= 1 << bit % 8
    return out


def with_raw(**raw) -> bytearray:
    """A protected frame, counter 2, with raw setpoint or control as given, however wrong."""
    frame = contract.command_frame(counter=2)
    if "setpoint" in raw:
        frame[2:4] = int(raw["setpoint"]).to_bytes(2, "little", signed=True)
    if "control" in raw:
        frame[1] = frame[1] & 0x0F | raw["control"] << 4
    return contract.protected("VALVE_COMMAND_1", frame)


GOOD = contract.command_frame(setpoint_percent=50.0, counter=2)
BAD = {
    "unknown identifier": (GOOD, 0x2FF, -1, status.FRAME_UNKNOWN_ID),
    "29-bit identifier of the same number": (GOOD, VALVE_ID | decode.CAN_EFF_FLAG, -1, status.FRAME_UNKNOWN_ID),
    "one byte short": (GOOD[:7], VALVE_ID, 0, status.FRAME_WRONG_LENGTH),
    "empty": (GOOD[:0], VALVE_ID, 0, status.FRAME_WRONG_LENGTH),
    "longer": (GOOD + bytes(4), VALVE_ID, 0, status.FRAME_WRONG_LENGTH),
    "remote frame": (GOOD, VALVE_ID | decode.CAN_RTR_FLAG, 0, status.FRAME_REMOTE),
    "remote frame of nobody": (GOOD, 0x123 | decode.CAN_RTR_FLAG, -1, status.FRAME_REMOTE),
    "error frame": (GOOD, VALVE_ID | decode.CAN_ERR_FLAG, -1, status.FRAME_ERROR),
    "crc of another counter": (flipped(GOOD, 0), VALVE_ID, 0, status.FRAME_BAD_CRC),
    "another axis' data ids": (
        contract.protected("VALVE_COMMAND_2", GOOD),
        VALVE_ID,
        0,
        status.FRAME_BAD_CRC,
    ),
    "repeated counter": (contract.command_frame(setpoint_percent=90.0), VALVE_ID, 0, status.FRAME_REPEATED_COUNTER),
    "just above the range": (with_raw(setpoint=16385), VALVE_ID, 0, status.FRAME_OUT_OF_RANGE),
    "just below the range": (with_raw(setpoint=-16385), VALVE_ID, 0, status.FRAME_OUT_OF_RANGE),
    "most negative number": (with_raw(setpoint=-32768), VALVE_ID, 0, status.FRAME_OUT_OF_RANGE),
    "control word 4": (with_raw(control=4), VALVE_ID, 0, status.FRAME_BAD_CONTROL),
    "control word 15": (with_raw(control=15), VALVE_ID, 0, status.FRAME_BAD_CONTROL),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_frame_has_its_status_and_changes_nothing(bench, name):
    data, can_id, axis, code = BAD[name]
    before = bench.snapshot()
    assert bench.give(data, can_id) == (axis, code)
    assert bench.snapshot() == before
    assert bench.give(GOOD) == (0, status.FRAME_VALID)  # and the next good frame is none the worse
    assert bench.fresh[0]["valve_command"] == 0.5


def test_every_single_flipped_bit_is_refused(bench):
    before = bench.snapshot()
    for bit in range(64):
        axis, code = bench.give(flipped(GOOD, bit))
        assert (axis, code) == (0, status.FRAME_BAD_CRC), bit
    assert bench.snapshot() == before


def test_bytes_behind_the_frame_are_not_read(bench):
    assert bench.give(GOOD) == (0, status.FRAME_VALID)  # codec_entries.padded puts 0xA5 there
    assert bench.fresh[0]["valve_command"] == 0.5 and bench.fresh[0]["timestamp_us"] == 0


def test_the_ends_of_the_range_are_accepted(bench):
    assert bench.give(with_raw(setpoint=16384)) == (0, status.FRAME_VALID)
    assert bench.fresh[0]["valve_command"] == 1.0
    frame = contract.command_frame(setpoint_percent=-100.0, counter=3)
    assert bench.give(frame) == (0, status.FRAME_VALID)
    assert bench.fresh[0]["valve_command"] == -1.0


def test_the_first_frame_is_accepted_whatever_its_counter():
    table, _ = contract.tables(2)
    for counter in range(16):
        fresh, last = decode.fresh_commands(2), decode.no_counters(2)
        data = codec_entries.padded(contract.command_frame(counter=counter))
        assert codec_entries.decode_one(table, VALVE_ID, 8, data, last, fresh) == (0, status.FRAME_VALID)
        assert last[0] == counter and last[1] == e2e.NO_COUNTER


def test_counter_steps(bench):
    for step in range(1, 16):
        bench.last[0] = 10
        code = bench.give(contract.command_frame(counter=(10 + step) % 16))[1]
        expected = status.FRAME_VALID if step <= signals.MAX_COUNTER_DELTA else status.FRAME_LOST_COUNTER
        assert code == expected, step


@pytest.mark.parametrize("restart", range(16))
def test_a_restarted_firmware_loses_one_frame_at_most(bench, restart):
    bench.last[0] = 5
    before = bench.fresh.tobytes()
    codes = []
    for counter in range(restart, restart + 4):
        codes.append(bench.give(contract.command_frame(setpoint_percent=75.0, counter=counter % 16))[1])
        if codes == [status.FRAME_LOST_COUNTER]:
            assert bench.fresh.tobytes() == before, "a frame that lost the count is not used"
    assert codes[0] in (status.FRAME_VALID, status.FRAME_REPEATED_COUNTER, status.FRAME_LOST_COUNTER)
    assert codes[1:] == [status.FRAME_VALID] * 3


def test_axes_do_not_disturb_each_other(bench):
    frame = contract.command_frame(2, setpoint_percent=-10.0, counter=9)
    assert bench.give(frame, 0x202) == (1, status.FRAME_VALID)
    assert bench.fresh[0]["valve_command"] == 0.25
    assert bench.fresh[1]["valve_command"] == pytest.approx(-0.1, abs=1 / 32768)
    assert list(bench.last) == [1, 9]


FUZZ_COUNT = 100_000
NOT_FROM_THIS_DECODER = {
    status.FRAME_NOT_A_NUMBER,  # integers cannot be NaN; floats: test_codec_layouts
    status.FRAME_OWN_ID,  # the cycle says so of an unknown identifier, for it knows what the bench sends: rules/interpreted_scenario
}


def fuzzed_frames(seed: int, count: int):
    """Random and mutated frames: half random bytes, half good frames with bits flipped, wrong ids, flags and lengths."""
    rng = np.random.default_rng(seed)
    ids = rng.choice(np.array([0x201, 0x202, 0x203, 0x181, 0x7FF], np.uint32), count)
    ids |= rng.choice(np.array([0, decode.CAN_EFF_FLAG, decode.CAN_RTR_FLAG, decode.CAN_ERR_FLAG], np.uint32), count,
                      p=[0.9, 0.04, 0.03, 0.03])  # fmt: skip
    lengths = rng.choice(np.array([8, 0, 1, 7, 12, 64]), count, p=[0.9, 0.02, 0.02, 0.02, 0.02, 0.02])
    frames = rng.integers(0, 256, (count, 64), np.uint8)
    half = count // 2
    good = np.frombuffer(bytes(contract.command_frame(setpoint_percent=60.0, counter=6)), np.uint8)
    frames[:half, :8] = good
    flips = rng.integers(0, 64, (half, 3))
    for column in range(3):
        frames[np.arange(half), flips[:, column] // 8] ^= (1 << flips[:, column] % 8).astype(np.uint8)
    return ids, lengths, frames


def judged_by_others(ids, lengths, frames):
    """(axis, status) of each frame by autosar-e2e and plain Python, written from the contract and not from the decoder."""
    lists = [contract.data_ids("VALVE_COMMAND_1"), contract.data_ids("VALVE_COMMAND_2")]
    last: list[int | None] = [None, None]
    judged = []
    for can_id, length, frame in zip(ids.tolist(), lengths.tolist(), frames, strict=True):
        if can_id & decode.CAN_ERR_FLAG:
            judged.append((-1, status.FRAME_ERROR))
            continue
        remote = bool(can_id & decode.CAN_RTR_FLAG)
        axis = {0x201: 0, 0x202: 1}.get(can_id & ~decode.CAN_RTR_FLAG, -1)
        if remote or axis < 0:
            judged.append((axis, status.FRAME_REMOTE if remote else status.FRAME_UNKNOWN_ID))
            continue
        code = _content_status(bytes(frame[:8]), length, lists[axis], last, axis)
        judged.append((axis, code))
    return np.array(judged)


def _content_status(data, length, ids, last, axis):
    if length != 8:
        return status.FRAME_WRONG_LENGTH
    if not e2e_p02.e2e_p02_check(data, ids, length=8):
        return status.FRAME_BAD_CRC
    counter = data[1] % 16
    if last[axis] is not None:
        if counter == last[axis]:
            return status.FRAME_REPEATED_COUNTER
        if (counter - last[axis]) % 16 > signals.MAX_COUNTER_DELTA:
            last[axis] = counter
            return status.FRAME_LOST_COUNTER
    if abs(int.from_bytes(data[2:4], "little", signed=True)) > 16384:
        return status.FRAME_OUT_OF_RANGE
    if data[1] >> 4 > 3:
        return status.FRAME_BAD_CONTROL
    last[axis] = counter
    return status.FRAME_VALID


def test_fuzzed_frames_change_nothing_but_counters():
    """A CRC of 8 bits lets 1 random frame in 256 through: those are valid by every judge, ours and the others."""
    table, _ = contract.tables(2)
    fresh, last = decode.fresh_commands(2), decode.no_counters(2)
    ids, lengths, frames = fuzzed_frames(20250714, FUZZ_COUNT)
    codes, changed = np.zeros((FUZZ_COUNT, 2), np.int64), np.zeros(2, np.int64)
    codec_entries.decode_many(table, ids, lengths, frames, last, fresh, codes, changed)
    assert list(changed) == [0, 0]
    np.testing.assert_array_equal(codes, judged_by_others(ids, lengths, frames))
    total = np.bincount(codes[:, 1], minlength=status.FRAME_STATUS_COUNT)
    for code in set(range(status.FRAME_STATUS_COUNT)) - NOT_FROM_THIS_DECODER:
        assert total[code] > 0, status.FRAME_STATUS_NAMES[code]
    assert total[status.FRAME_VALID] < FUZZ_COUNT / 256
    assert np.all(np.abs(fresh["valve_command"]) <= 1.0) and np.all(fresh["control"] <= 3)
