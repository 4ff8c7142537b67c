"""Open the bus with python-can and hand the loop one file descriptor of `struct can_frame`.

SocketCAN: the raw socket itself. Any other python-can backend: a pump thread moves frames between the bus and one end of an
AF_UNIX datagram socketpair whose other end goes into the loop. The loop has no second path.
"""

import os
import socket
import threading
from pathlib import Path
from typing import Any

from hilrunner.base.errors import CanError, UsageError
from hilrunner.setup.can_frame import pack_frame, unpack_frame

_SO_RCVBUFFORCE = 33
_SO_RXQ_OVFL = 40
_SO_TIMESTAMPNS = 35
_RECEIVE_BUFFER_BYTES = 4 << 20
_IFF_UP = 1


class OpenBus:
    """An open bus: `descriptor` for the loop, `close()` afterwards, `lost` when a pump's bus failed."""

    def __init__(self, bus: Any, descriptor: int, name: str, pump: "Pump | None" = None) -> None:
        self.bus = bus
        self.descriptor = descriptor
        self.name = name
        self.pump = pump

    @property
    def lost(self) -> str:
        """Why the pump's bus failed; empty while it works, or without a pump."""
        return self.pump.lost if self.pump else ""

    def close(self) -> None:
        """End the pump and close the bus."""
        if self.pump:
            self.pump.stop()
        self.bus.shutdown()


def open_bus(interface: str, channel: str, bitrate: int | None = None, fd: bool = False) -> OpenBus:
    """Open a bus by python-can's names.

    Raises:
        CanError: the interface is missing, down, or does not carry what is asked of it.
        UsageError: no such python-can backend.
    """
    import can

    if interface == "socketcan":
        _check_interface(channel, fd)
    options: dict[str, Any] = {"fd": fd} if fd else {}
    if bitrate and interface not in ("socketcan", "virtual", "udp_multicast"):
        options["bitrate"] = bitrate
    try:
        bus = can.Bus(interface=interface, channel=channel, receive_own_messages=False, **options)
    except can.CanInterfaceNotImplementedError as error:
        raise UsageError(f"-i {interface}", str(error), remedy="name a python-can interface") from error
    except (OSError, can.CanError, ValueError, ImportError) as error:
        raise CanError(
            f"{interface}:{channel}", f"cannot be opened: {error}", remedy="check the name, the driver and the rights"
        ) from error
    if interface == "socketcan":
        _prepare_socket(bus.socket, channel, fd)
        return OpenBus(bus, bus.fileno(), f"socketcan:{channel}")
    pump = Pump(bus)
    return OpenBus(bus, pump.loop_end.fileno(), f"{interface}:{channel}", pump)


def _check_interface(channel: str, fd: bool) -> None:
    folder = Path("/sys/class/net") / channel
    if not folder.exists():
        raise CanError(
            f"--can {channel}",
            "no such network interface",
            limit=", ".join(sorted(_can_interfaces())) or "none is here",
            remedy=f"ip link add dev {channel} type vcan && ip link set {channel} up mtu 72, or hilrunner lab -- COMMAND",
        )
    if not int((folder / "flags").read_text(), 16) & _IFF_UP:
        raise CanError(f"--can {channel}", "the interface is down", remedy=f"ip link set {channel} up")
    mtu_bytes = int((folder / "mtu").read_text())
    if fd and mtu_bytes < 72:
        raise CanError(
            f"--can {channel}", f"mtu {mtu_bytes} does not carry CAN FD", "mtu 72", f"ip link set {channel} mtu 72"
        )


def _can_interfaces() -> list[str]:
    found = []
    for folder in Path("/sys/class/net").iterdir():
        try:
            if (folder / "type").read_text().strip() == "280":  # ARPHRD_CAN
                found.append(folder.name)
        except OSError:
            continue
    return found


def _prepare_socket(sock: socket.socket, channel: str, fd: bool) -> None:
    """Ask for stamps, drop counts and a deep receive buffer; read back what python-can only logs."""
    sock.setblocking(False)
    sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER_BYTES)
    except PermissionError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
    if fd and not sock.getsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES):
        raise CanError(
            f"--can {channel}", "the kernel refused CAN FD on this socket", remedy="use an FD-capable interface"
        )


class Pump:
    """Moves frames between a python-can bus and the loop's end of a socketpair, in two threads."""

    def __init__(self, bus: Any) -> None:
        self.bus = bus
        self.lost = ""
        self.loop_end, self.bus_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.loop_end.setblocking(False)
        for end in (self.loop_end, self.bus_end):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _RECEIVE_BUFFER_BYTES)
        self._stopping = threading.Event()
        self._threads = [
            threading.Thread(target=target, name=name, daemon=True)
            for target, name in ((self._from_bus, "pump-from-bus"), (self._to_bus, "pump-to-bus"))
        ]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End both threads and close the pair."""
        self._stopping.set()
        for thread in self._threads:
            thread.join(timeout=2.0)
        self.loop_end.close()
        self.bus_end.close()

    def _from_bus(self) -> None:
        while not self._stopping.is_set():
            try:
                message = self.bus.recv(timeout=0.1)
                if message is not None:
                    self.bus_end.send(pack_frame(message))
            except BlockingIOError:
                continue
            except Exception as error:  # whatever a backend raises means the same here: the bus is gone
                self._lose(error)
                return

    def _to_bus(self) -> None:
        self.bus_end.settimeout(0.1)
        while not self._stopping.is_set():
            try:
                packet = self.bus_end.recv(128)
            except TimeoutError:
                continue
            except OSError:
                return
            try:
                self.bus.send(unpack_frame(packet))
            except Exception as error:  # as above
                self._lose(error)
                return

    def _lose(self, error: Exception) -> None:
        if not self._stopping.is_set():
            self.lost = f"{type(error).__name__}: {error}"
            # a closed peer is how a socketpair says that the bus is gone: the loop's next send gives ECONNREFUSED
            self.bus_end.close()


def errno_text(number: int) -> str:
    """`ENETDOWN (Network is down)` for an errno."""
    import errno

    return f"{errno.errorcode.get(number, number)} ({os.strerror(number)})"
