"""What a running bench says of the bus: what it waits for, and which identifiers arrive that nobody mapped."""

import numpy as np

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.records import CAN_FRAME_SENT
from hilrunner.commands.run_waiting import UnknownIds, waits_for
from hilrunner.realtime import command, decode
from hilrunner.setup import signals
from hilrunner.setup.arm import local_ring
from hilrunner.setup.database import load_database
from hilrunner.setup.mapping import AxisMapping, CommandMapping, LineMapping
from tests.tools.make_dbc import Msg, Sig, write

EFF = decode.CAN_EFF_FLAG
MESSAGES = [
    Msg("CMD", 0x0CFE3010, 8, [Sig("Valve", 0, 16, signed=True, scale="0.01", unit="%")], extended=True),
    Msg("LINES", 0x123, 1, [Sig("On", 0, 1)]),
    Msg("OTHER", 0x200, 8, [Sig("X", 0, 8)]),
]  # fmt: skip


class Bench:
    """The parts of a bench that are looked at."""

    def __init__(self, folder):
        path = write(folder, MESSAGES)
        mapped = CommandMapping("CMD", valve_command="Valve", enable=LineMapping("On", message="LINES"))
        self.command_table, _ = signals.load_signals(path, [AxisMapping(mapped, [])])
        self.group_tick = np.full(2, decode.NEVER)
        self.commands = command.make_command_state(1, 1, 1)
        self.ring = local_ring(ring_layout.RingShape(1, 16, 16, 64, 8, 10, 64))
        self.database = load_database(path)
        self.written = 0

    def arrives(self, can_id, mono_ms, code=status.FRAME_UNKNOWN_ID, flags=0):
        row = self.ring.can[self.written % 64]
        row["can_id"], row["mono_ns"], row["status"], row["flags"] = can_id, mono_ms * 1_000_000, code, flags
        self.written += 1
        self.ring.header[ring_layout.WORD_CAN_WRITTEN * ring_layout.HEADER_STRIDE] = self.written


def test_identifiers_nobody_mapped_are_told_once_with_rate_and_hint(tmp_path):
    bench = Bench(tmp_path)
    unknown = UnknownIds(bench, bench.database)
    news = []
    for tick in range(150):
        bench.arrives(0x18FE3021 | EFF, 10 * tick)
        bench.arrives(0x200, 10 * tick)
        bench.arrives(0x18FE3021 | EFF, 10 * tick, flags=CAN_FRAME_SENT)
        bench.arrives(0x123, 10 * tick, status.FRAME_VALID)
        unknown.update()
        news += unknown.news()
    assert sorted(news) == [
        "0x18FE3021 arrives at 100 Hz and is mapped to nothing: did you mean 0x0CFE3010? It is the same parameter group with another "
        "priority or source address",
        "0x200 arrives at 100 Hz and is mapped to nothing: the database calls it OTHER, which the profile does not map",
    ]
    found = {one["id"]: one for one in unknown.summary()}
    assert found["0x200"]["count"] == 150 and found["0x18FE3021"]["rate_hz"] == 100.0 and len(found) == 2


def test_the_same_number_with_other_bits_and_a_near_number(tmp_path):
    bench = Bench(tmp_path)
    unknown = UnknownIds(bench, bench.database)
    for can_id in (0x123 | EFF, 0x124, 0x7FF):
        bench.arrives(can_id, 1)
    unknown.update()
    hints = {one["id"]: one["hint"] for one in unknown.summary()}
    assert "same number, but came with 29 bits" in hints["0x00000123"]
    assert hints["0x124"] == "did you mean 0x123?" and hints["0x7FF"] == ""


def test_what_is_waited_for_is_named(tmp_path):
    bench = Bench(tmp_path)
    names = ["CMD", "LINES"]
    assert waits_for(bench, names) == "waits for CMD 0x0CFE3010, LINES 0x123"
    bench.group_tick[0] = 5
    assert waits_for(bench, names) == "waits for LINES 0x123"
    for mode, text in (
        (status.MODE_ACTIVE, ""), (status.MODE_FAIL_SAFE, "waits for Reset"), (status.MODE_STALE_HOLD, "waits for a newer command"),
    ):  # fmt: skip
        bench.commands[0]["mode"] = mode
        assert waits_for(bench, names) == text
