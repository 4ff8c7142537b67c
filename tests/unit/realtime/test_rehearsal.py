"""A rehearsal leaves no trace: the same bits with and without it, no frame taken, nothing counted."""

import errno
import socket
import struct
import time

import numpy as np
import pytest

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.realtime import loop, rehearsal
from hilrunner.setup import arm as arming
from hilrunner.setup import axes as axis_setup
from hilrunner.setup.profile import load_profile
from tests.tools.contract import command_frame, database

TICKS = 40
PROFILE = """
name = "rehearsal"
[bench]
period_us = 2000
warm_up_ticks = 0
overrun = "catch-up"
[[axis]]
name = "boom"
model = "lift-flow.onnx"
[axis.load]
kind = "constant"
force_kn = 600.0
[[fault]]
kind = "sensor-stuck"
axis = "boom"
quantity = "chamber_1_pressure"
at_s = 0.01
duration_s = 0.02
[crosscheck]
enabled = false
"""


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    path = tmp_path_factory.mktemp("profile") / "rehearsal.toml"
    path.write_text(PROFILE)
    loaded = load_profile(str(path))
    return loaded, axis_setup.build_axes(loaded, status.ENGINE_SURROGATE)


def run(parts, spin_ns: int) -> dict:
    """TICKS ticks, all frames waiting before tick 0; everything a run leaves behind."""
    loaded, axes = parts
    ring = arming.local_ring(arming.ring_shape(loaded, seconds=0.2))
    armed = arming.arm(loaded, axes, ring, record=True, spin_ns=spin_ns)
    ours, peer = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    can_id = database().get_message_by_name("VALVE_COMMAND_1").frame_id
    peer.send(struct.pack("<IB3x8s", can_id, 8, bytes(command_frame(1, setpoint_percent=30.0, counter=1))))
    loop.run_loop(armed.bench, ours.fileno(), time.monotonic_ns() + 3_000_000, TICKS)
    sent = []
    peer.setblocking(False)
    try:
        while True:
            sent.append(peer.recv(128))
    except BlockingIOError:
        pass
    ours.close()
    peer.close()
    # the status frame counts deadline misses, which are no business of the plant
    status_id = database().get_message_by_name("BENCH_STATUS_1").frame_id
    written = ring_layout.word(ring, ring_layout.WORD_TICK_WRITTEN)
    return {
        "ticks": written,
        "state": ring.state[:written].tobytes(),
        "command": ring.command[:written].tobytes(),
        "frames": ring.frame_count.tolist(),
        "sent": [frame for frame in sent if struct.unpack("<I", frame[:4])[0] != status_id],
        "end": armed.bench.state.tobytes(),
        "faults": armed.bench.faults.tobytes(),
        "received": int(armed.bench.progress[0]["frames_received"]),
        "evaluations": armed.bench.plant_scratch[17:19].tolist(),
        "rehearsal_ns": int(armed.bench.progress[0]["rehearsal_ns"]),
    }


def test_a_run_with_rehearsals_gives_the_same_bits(parts):
    without, with_them = run(parts, 0), run(parts, 1_500_000)
    assert without.pop("rehearsal_ns") == 0 and with_them.pop("rehearsal_ns") > 0
    assert without["received"] == 1 and without["ticks"] == TICKS
    assert with_them == without
    assert len(without["sent"]) > TICKS


SILENT = """
[[fault]]
kind = "measurement-lost"
axis = "boom"
at_s = 0.0
"""


def test_an_error_of_the_bus_met_by_the_rehearsal_is_not_lost(parts, tmp_path):
    """The kernel gives a pending error away with the first call: the tick after it would see a quiet bus."""
    path = tmp_path / "silent.toml"
    path.write_text(PROFILE + SILENT)  # a bench that sends would learn it from sending
    armed = arming.arm(
        load_profile(str(path)), parts[1], arming.local_ring(arming.ring_shape(parts[0], seconds=0.2)),
        record=True, spin_ns=50_000_000,  # a late wake-up on a busy host still leaves room
    )  # fmt: skip
    loop.run_loop(armed.bench, loop.NO_BUS, 0, 0)  # compiles or loads, which would make tick 0 late
    armed.bench.phase_ns[0] = 100_000  # as if a tick had run: what tells that there is room for a rehearsal
    ours, peer = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.send(b"unread")
    peer.close()
    reason = loop.run_loop(armed.bench, ours.fileno(), time.monotonic_ns() + 60_000_000, TICKS)
    ours.close()
    assert armed.bench.progress[0]["rehearsal_ns"] > 0 and armed.bench.progress[0]["tick_count"] == 1
    assert (reason, armed.bench.progress[0]["bus_errno"]) == (status.EXIT_CAN_LOST, errno.ECONNRESET)


def test_the_shadow_owns_everything_a_period_writes(parts):
    loaded, axes = parts
    armed = arming.arm(loaded, axes, arming.local_ring(arming.ring_shape(loaded, seconds=0.2)), record=True)
    shadow = rehearsal.rehearsal_of(armed.bench)
    shared = {name for name in armed.bench._fields if getattr(shadow, name) is getattr(armed.bench, name)}
    scratch = {"fresh", "field_value", "inbox", "outbox", "frame_axis", "frame_status", "frame_period", "phase_ns", "rusage", "schedstat_text",
               "usage_before", "usage_after", "clock"}  # fmt: skip
    constant = {"config", "plant", "command_table", "measurement_table", "wave", "stimulus"}
    assert shared == scratch | constant
    assert not np.shares_memory(shadow.ring.frame_count, armed.bench.ring.frame_count)
    assert not np.shares_memory(shadow.ring.clamped_count, armed.bench.ring.clamped_count)
