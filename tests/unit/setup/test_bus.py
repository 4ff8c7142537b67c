"""The pump between any python-can backend and the loop's descriptor, and what a missing interface says."""

import contextlib
import os
import socket
import struct
import threading
import time

import can
import pytest

from hilrunner.base.errors import CanError, UsageError
from hilrunner.setup import bus_open
from hilrunner.setup.bus import OwnFrames, Pump, drain_stale_frames, open_bus
from hilrunner.setup.bus_open import close_bus, open_backend
from hilrunner.setup.can_frame import pack_frame, unpack_frame


def read_within(descriptor, seconds=5.0):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            return os.read(descriptor, 128)
        except BlockingIOError:
            time.sleep(0.002)
    raise AssertionError("nothing arrived")


@pytest.mark.parametrize(
    "message",
    [
        can.Message(arbitration_id=0x201, data=[1, 2, 3], is_extended_id=False),
        can.Message(arbitration_id=0x18FF1234, data=range(8), is_extended_id=True),
        can.Message(arbitration_id=0x201, is_remote_frame=True, dlc=4, is_extended_id=False),
        can.Message(arbitration_id=0x7FF, data=range(64), is_fd=True, is_extended_id=False, bitrate_switch=True),
    ],
)
def test_a_frame_survives_both_ways(message):
    packet = pack_frame(message)
    assert len(packet) == (72 if message.is_fd else 16)
    back = unpack_frame(packet)
    assert (back.arbitration_id, back.is_extended_id, back.is_fd) == (
        message.arbitration_id, message.is_extended_id, message.is_fd,
    )  # fmt: skip
    if not message.is_remote_frame:
        assert bytes(back.data) == bytes(message.data)


def test_the_pump_carries_frames_both_ways():
    bus = open_bus("virtual", "pump-test")
    peer = can.Bus(interface="virtual", channel="pump-test")
    try:
        peer.send(can.Message(arbitration_id=0x201, data=[9, 8, 7], is_extended_id=False))
        packet = read_within(bus.descriptor)
        assert len(packet) == 16 and packet[4] == 3 and packet[8:11] == bytes([9, 8, 7])
        os.write(bus.descriptor, pack_frame(can.Message(arbitration_id=0x181, data=[1], is_extended_id=False)))
        answer = peer.recv(timeout=5.0)
        assert answer is not None and answer.arbitration_id == 0x181 and bytes(answer.data) == b"\x01"
    finally:
        peer.shutdown()
        bus.close()
    assert bus.lost == ""


def test_a_backend_that_fails_is_told():
    bus = open_bus("virtual", "pump-lost")
    try:
        bus.bus.shutdown()
        deadline = time.monotonic() + 5.0
        while not bus.lost and time.monotonic() < deadline:
            time.sleep(0.01)
        assert bus.lost
    finally:
        bus.close()


def test_a_missing_interface_and_backend():
    with pytest.raises(CanError, match="no such network interface") as caught:
        open_bus("socketcan", "can99")
    assert caught.value.exit_code == 4
    with pytest.raises((UsageError, CanError)):
        open_bus("no-such-backend", "x")


def frame(number):
    return can.Message(arbitration_id=number, data=[number & 0xFF], is_extended_id=False)


def received(descriptor, seconds=0.5):
    """Identifiers of all frames that reach the loop's end within a while."""
    found, deadline = [], time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            found.append(int.from_bytes(os.read(descriptor, 128)[:4], "little"))
        except BlockingIOError:
            time.sleep(0.005)
    return found


def test_own_frames_that_a_bus_gives_back_are_no_traffic():
    """`virtual` marks its own frames when asked for them."""
    bus = open_bus("virtual", "own-frames", options={"receive_own_messages": True})
    peer = can.Bus(interface="virtual", channel="own-frames")
    try:
        os.write(bus.descriptor, pack_frame(frame(0x181)))
        assert peer.recv(timeout=5.0).arbitration_id == 0x181
        peer.send(frame(0x201))
        assert received(bus.descriptor) == [0x201]
    finally:
        peer.shutdown()
        bus.close()


class EchoingBus:
    """A backend that gives back what is sent without saying that it is its own, as multicast does."""

    def __init__(self):
        self.waiting = []
        self.calls = 0

    def send(self, message):
        self.waiting.append(message)

    def recv(self, timeout):
        self.calls += 1
        return self.waiting.pop(0) if self.waiting else None

    def shutdown(self):
        raise can.CanError("gone")


def test_frames_that_come_back_unmarked_are_taken_once():
    backend = EchoingBus()
    pump = Pump(backend, echoes=True)
    try:
        os.write(pump.loop_end.fileno(), pack_frame(frame(0x181)))
        assert received(pump.loop_end.fileno()) == []
        backend.waiting += [frame(0x181), frame(0x201)]  # the first is another's now: ours was given back already
        assert received(pump.loop_end.fileno()) == [0x181, 0x201]
    finally:
        pump.stop()
    assert backend.calls < 2000, "a backend that does not wait must not take a whole core"
    close_bus(backend)  # what it raises is nobody's business any more


def test_a_frame_sent_long_ago_is_not_waited_for(monkeypatch):
    own, clock = OwnFrames(), [0.0]
    monkeypatch.setattr("hilrunner.setup.bus.time.monotonic", lambda: clock[0])
    own.add(b"a")
    assert own.take(b"a") and not own.take(b"a")
    own.add(b"a")
    clock[0] = 2.0
    assert not own.take(b"a")


@pytest.mark.parametrize(
    ("raised", "kind", "told"),
    [
        (NameError("name 'canGetNumberOfChannels' is not defined"), CanError, "library of interface virtual.*canGetNumber.*install"),
        (ImportError("no libusb"), CanError, "library of interface virtual"),
        (can.CanInterfaceNotImplementedError("not on Linux"), CanError, "not on Linux"),
        (TypeError("missing 1 required positional argument: 'host'"), UsageError, "'host'.*--bus-option KEY=VALUE"),
        (OSError(19, "No such device"), CanError, "No such device"),
        (can.CanInitializationError("bus off"), CanError, "cannot be opened: bus off"),
        (ZeroDivisionError("oops"), CanError, "ZeroDivisionError: oops"),
        (SystemExit(3), CanError, "SystemExit: 3"),
    ],
)  # fmt: skip
def test_whatever_a_backend_raises_is_one_error(monkeypatch, raised, kind, told):
    def fail(**_):
        can.log.warning("the driver said this")
        raise raised

    monkeypatch.setattr(can, "Bus", fail)
    with pytest.raises(kind, match=told) as refused:
        open_backend("virtual", "x", {})
    assert "the driver said this" in str(refused.value) and len(str(refused.value).splitlines()) == 1


def test_a_backend_that_never_opens_is_given_up_and_closed_should_it_open_after_all(monkeypatch):
    go_on, closed = threading.Event(), threading.Event()

    class Late:
        def shutdown(self):
            closed.set()

    monkeypatch.setattr(can, "Bus", lambda **_: go_on.wait(30.0) and Late())
    with pytest.raises(CanError, match="did not open within 0.05 s"):
        open_backend("virtual", "x", {}, limit_s=0.05)
    go_on.set()
    assert closed.wait(10.0)


def test_a_backend_that_never_closes_holds_nothing_up(monkeypatch):
    monkeypatch.setattr(bus_open, "_CLOSE_LIMIT_S", 0.05)
    for_ever = threading.Event()

    class Stuck:
        def shutdown(self):
            for_ever.wait(30.0)

    close_bus(Stuck())
    for_ever.set()


def test_options_reach_the_backend():
    bus = open_bus("virtual", "options", options={"rx_queue_size": 7})
    try:
        assert bus.bus.queue.maxsize == 7
    finally:
        bus.close()


def pair():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    return ours, theirs


def test_stale_frames_are_taken_away_and_another_bench_is_noticed():
    ours, theirs = pair()
    with ours, theirs:
        for can_id in (0x201, 0x281, 0x7FF):
            theirs.send(struct.pack("<IB3x8s", can_id, 8, b""))
        assert drain_stale_frames(ours.fileno(), {0x181, 0x281}) == 0x281
        assert drain_stale_frames(ours.fileno(), {0x181, 0x281}) == -1


def test_a_flooded_bus_does_not_keep_tick_0_away():
    ours, theirs = pair()
    with ours, theirs:
        stopping = threading.Event()

        def flood():
            with contextlib.suppress(OSError):
                while not stopping.is_set():
                    theirs.send(bytes(16))

        flooder = threading.Thread(target=flood, daemon=True)
        flooder.start()
        try:
            began_s = time.thread_time(), time.monotonic()
            drain_stale_frames(ours.fileno(), set(), limit_s=0.1)
            assert time.thread_time() - began_s[0] < 5.0, "bounded by its limit, whatever comes"
        finally:
            stopping.set()
            ours.close()
            flooder.join(timeout=5.0)


def test_a_bus_that_went_before_tick_0_is_an_error_of_the_bus():
    ours, theirs = pair()
    ours.send(b"unread")
    theirs.close()
    with ours, pytest.raises(OSError, match="reset"):
        drain_stale_frames(ours.fileno(), set())
