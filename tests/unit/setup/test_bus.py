"""The pump between any python-can backend and the loop's descriptor, and what a missing interface says."""

import os
import time

import can
import pytest

from hilrunner.base.errors import CanError, UsageError
from hilrunner.setup.bus import open_bus, pack_frame, unpack_frame


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
