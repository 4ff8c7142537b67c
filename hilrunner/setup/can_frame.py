"""`struct can_frame` and `struct canfd_frame` of a python-can message, and back: the bytes that the loop reads and writes."""

import struct
from typing import Any

EFF, RTR, ERR = 0x80000000, 0x40000000, 0x20000000
FDF, BRS, ESI = 0x04, 0x01, 0x02
FD_SIZE_BYTES = 72


def pack_classic(can_id: int, length: int, data: bytes) -> bytes:
    """`struct can_frame`; `can_id` with its flags."""
    return struct.pack("<IBxxx8s", can_id, length, data)


def pack_fd(can_id: int, flags: int, data: bytes) -> bytes:
    """`struct canfd_frame`; `can_id` and `flags` as in the kernel."""
    return struct.pack("<IBBxx64s", can_id, len(data), FDF | flags, data)


def pack_frame(message: Any) -> bytes:
    """`struct can_frame` or `struct canfd_frame` of a python-can message."""
    can_id = message.arbitration_id
    can_id |= EFF if message.is_extended_id else 0
    can_id |= RTR if message.is_remote_frame else 0
    can_id |= ERR if message.is_error_frame else 0
    data = bytes(message.data)
    if message.is_fd:
        flags = (BRS if message.bitrate_switch else 0) | (ESI if message.error_state_indicator else 0)
        return pack_fd(can_id, flags, data)
    return pack_classic(can_id, message.dlc, data)


def unpack_frame(packet: bytes) -> Any:
    """The python-can message of a `struct can_frame` or `struct canfd_frame`."""
    import can

    can_id, length, flags = struct.unpack_from("<IBB", packet)
    extended, fd = bool(can_id & EFF), len(packet) == FD_SIZE_BYTES
    return can.Message(
        arbitration_id=can_id & (0x1FFFFFFF if extended else 0x7FF),
        is_extended_id=extended,
        is_fd=fd,
        bitrate_switch=fd and bool(flags & BRS),
        data=packet[8 : 8 + length],
        check=False,
    )
