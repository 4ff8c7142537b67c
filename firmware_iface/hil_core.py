"""The six functions of c/hil_core.h as a Python class, for prototypes and tests of controllers; needs python-can only.

    with HilCore("vcan0") as hil:
        due_ns = hil.now_ns()
        while hil.wait_until(due_ns):
            for can_id, data in hil.received():
                core.take(can_id, data)
            hil.send(0x201, core.step())
            due_ns += 10_000_000

The same program runs on a real interface, on vcan0, and in virtual time: `hilrunner run --virtual -- python program.py`.
"""

import time
from collections.abc import Iterator

import can


class HilCore:
    """Time and CAN as a controller core needs them."""

    def __init__(self, interface_name: str) -> None:
        """Open a SocketCAN interface. Raises OSError or can.CanError as python-can does."""
        self._bus = can.Bus(interface="socketcan", channel=interface_name)

    def __enter__(self) -> "HilCore":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def now_ns(self) -> int:
        """CLOCK_MONOTONIC, ns."""
        return time.monotonic_ns()

    def wait_until(self, deadline_mono_ns: int) -> bool:
        """Sleep until a point of that clock; True. A KeyboardInterrupt passes through."""
        left_ns = deadline_mono_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns * 1e-9)
        return True

    def send(self, can_id: int, data: bytes, *, extended: bool = False) -> bool:
        """Send without waiting; False when the transmit queue is full."""
        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=extended))
        except can.CanOperationError:
            return False
        return True

    def received(self) -> Iterator[tuple[int, bytes]]:
        """(identifier, data) of every frame that waits, oldest first."""
        while (message := self._bus.recv(0.0)) is not None:
            if not message.is_error_frame and not message.is_remote_frame:
                yield message.arbitration_id, bytes(message.data)

    def close(self) -> None:
        """Close the interface."""
        self._bus.shutdown()
