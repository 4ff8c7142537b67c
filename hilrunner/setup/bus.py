"""Open the bus with python-can and hand the loop one file descriptor of `struct can_frame`.

SocketCAN: the raw socket itself. Any other python-can backend: a pump thread moves frames between the bus and one end of an
AF_UNIX datagram socketpair whose other end goes into the loop. The loop has no second path.
"""

import collections
import contextlib
import os
import socket
import threading
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from hilrunner.base.errors import CanError
from hilrunner.setup.bus_open import close_bus, open_backend
from hilrunner.setup.can_frame import pack_frame, unpack_frame

_SO_RCVBUFFORCE = 33
_SO_RXQ_OVFL = 40
_SO_TIMESTAMPNS = 35
_RECEIVE_BUFFER_BYTES = 16 << 20  # the kernel takes twice that: 10 s of stall at 4,000 frames a second
DRAIN_LIMIT_S = 0.25
_PACKET_SIZE_MAX = 128
_IFF_UP = 1
_RECEIVE_WAIT_S, _PAUSE_S = 0.1, 0.001
_ECHOING = ("udp_multicast",)  # python-can knows no way to keep its own datagrams out
_OWN_FRAME_AGE_S, _OWN_FRAMES_MAX = 1.0, 4096


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
        close_bus(self.bus)


def open_bus(
    interface: str,
    channel: str | None,
    bitrate: int | None = None,
    fd: bool = False,
    options: dict[str, Any] | None = None,
) -> OpenBus:
    """Open a bus by python-can's names.

    Args:
        options: further arguments of the python-can backend (host, port, data_bitrate, ...); they go before `bitrate`.

    Raises:
        CanError: the interface is missing, down, does not answer, or does not carry what is asked of it.
        UsageError: no such python-can backend, or options it does not take.
    """
    if interface == "socketcan":
        with _lost_on_the_way(str(channel)):
            _check_interface(str(channel), fd)
    arguments: dict[str, Any] = {"fd": fd} if fd else {}
    if bitrate and interface not in ("socketcan", "virtual", "udp_multicast"):
        arguments["bitrate"] = bitrate
    arguments |= {"receive_own_messages": False, **(options or {})}
    if interface in _ECHOING:
        arguments["receive_own_messages"] = False  # it refuses to be told what it does anyway
    bus = open_backend(interface, channel, arguments)
    if interface == "socketcan":
        try:
            with _lost_on_the_way(str(channel)):
                _prepare_socket(bus.socket, str(channel), fd)
        except BaseException:
            close_bus(bus)
            raise
        return OpenBus(bus, bus.fileno(), f"socketcan:{channel}")
    pump = Pump(bus, echoes=interface in _ECHOING or bool(arguments["receive_own_messages"]))
    return OpenBus(bus, pump.loop_end.fileno(), f"{interface}:{channel}", pump)


@contextlib.contextmanager
def _lost_on_the_way(channel: str) -> Iterator[None]:
    """An interface may be taken away at any moment: whatever call notices it first, the bus is lost."""
    try:
        yield
    except OSError as error:
        raise lost_before_start(channel, error) from None


def lost_before_start(channel: str, error: OSError) -> CanError:
    """The bus went between its opening and tick 0."""
    what = errno_text(error.errno) if error.errno else str(error)
    return CanError(
        str(channel), f"lost before the first tick: {what}", remedy="bring the interface up and start again"
    )


def drain_stale_frames(descriptor: int, own_ids: Collection[int], limit_s: float = DRAIN_LIMIT_S) -> int:
    """Take away what arrived before tick 0 and belongs to no tick; an identifier of `own_ids` found there, or -1.

    Ends when nothing waits, and after `limit_s` in any case: a bus that is flooded faster than this reads shall not keep tick 0
    away. What is left then is taken by tick 0. Raises OSError when the bus is gone.
    """
    found = -1
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        try:
            frame = os.read(descriptor, _PACKET_SIZE_MAX)
        except (BlockingIOError, InterruptedError):
            break
        if not frame:  # the other end of a socketpair is closed: the loop notices it in its first tick
            break
        can_id = int.from_bytes(frame[:4], "little")
        if can_id in own_ids:
            found = can_id
    return found


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
    sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_RECV_OWN_MSGS, 0)  # the loop has no use for what it has sent
    try:  # a queued frame counts some 800 bytes: room for 40,000, or for about 500 where the limits of an ordinary user hold
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER_BYTES)
    except PermissionError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
    if fd and not sock.getsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES):
        raise CanError(
            f"--can {channel}", "the kernel refused CAN FD on this socket", remedy="use an FD-capable interface"
        )


class OwnFrames:
    """Frames sent a moment ago that the bus may give back, each of them once."""

    def __init__(self) -> None:
        self._sent: collections.deque[tuple[float, bytes]] = collections.deque(maxlen=_OWN_FRAMES_MAX)
        self._lock = threading.Lock()

    def add(self, packet: bytes) -> None:
        """A frame that is about to be sent."""
        with self._lock:
            self._sent.append((time.monotonic(), packet))

    def take(self, packet: bytes) -> bool:
        """Whether a received frame is one of them; each is taken once."""
        with self._lock:
            oldest_s = time.monotonic() - _OWN_FRAME_AGE_S
            while self._sent and self._sent[0][0] < oldest_s:
                self._sent.popleft()
            for index, (_, sent) in enumerate(self._sent):
                if sent == packet:
                    del self._sent[index]
                    return True
        return False


class Pump:
    """Moves frames between a python-can bus and the loop's end of a socketpair, in two threads.

    Args:
        echoes: the bus gives back what is sent on it; such frames are no traffic of others and do not go to the loop.
    """

    def __init__(self, bus: Any, echoes: bool = False) -> None:
        self.bus = bus
        self.lost = ""
        self._own = OwnFrames() if echoes else None
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
                begin_s = time.monotonic()
                message = self.bus.recv(timeout=_RECEIVE_WAIT_S)
                if message is None:
                    if time.monotonic() - begin_s < _RECEIVE_WAIT_S / 10:  # a backend that does not wait
                        self._stopping.wait(_PAUSE_S)
                    continue
                packet = pack_frame(message)
                if self._own is None or (message.is_rx and not self._own.take(packet)):
                    self.bus_end.send(packet)
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
                message = unpack_frame(packet)
                if self._own is not None:
                    self._own.add(pack_frame(message))
                self.bus.send(message)
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
