"""Virtual time as the bench holds it: the shared region, the bench's side of the bus, and the firmware processes.

One region is one run. `World` is made before tick 0; inside the loop only the three C functions whose addresses it gives are called
(realtime.virtual). Afterwards it tells what became of the firmware.
"""

import ctypes
import mmap
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from hilrunner.base.errors import UsageError
from hilrunner.base.units import NS_PER_S
from hilrunner.virtual.library import bench_library, preload_library
from hilrunner.virtual.program import check_program

START_MONO_NS = (
    1_000 * NS_PER_S
)  # the virtual clock begins here, so that no program sees a machine that has just started
START_REAL_NS = (
    1_767_225_600 * NS_PER_S
)  # 2026-01-01T00:00:00Z: always the same, because a program may make decisions of its date
NODES_MAX = 16
BUSES_MAX = 8
NAME_LENGTH_MAX = 15  # IFNAMSIZ less its end
_WALL_LIMIT_S = 30.0  # a firmware may compute so long at one moment of virtual time
_END_WAIT_S = 5.0
_FAILURES = {1: "hung", 2: "ended", 3: "refused"}


@dataclass(frozen=True)
class VirtualBus:
    """One CAN bus. `bitrate` 0: ideal, a frame takes no time and never waits; bit/s."""

    name: str = "vcan0"
    fd: bool = True
    bitrate: int = 0
    data_bitrate: int = 0


@dataclass(frozen=True)
class Firmware:
    """One firmware process: its command line and what is added to its environment."""

    command: Sequence[str]
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class FirmwareEnd:
    """How a firmware process ended: its exit code (negative: a signal), and what it lost on the way."""

    command: tuple[str, ...]
    exit_code: int | None  # None: it had to be killed
    frames_dropped: int  # arrived and found its queue full
    frames_refused: int  # sent while its queue was full (it saw ENOBUFS)
    refusal: str  # what could not be followed in virtual time; empty where nothing was

    @property
    def said(self) -> str:
        """In words."""
        words = "had to be killed" if self.exit_code is None else f"ended with {self.exit_code}"
        if self.frames_refused:
            words += f", {self.frames_refused} frames found its transmit queue full"
        if self.frames_dropped:
            words += f", {self.frames_dropped} frames found its receive queue full"
        return words

    def as_dict(self) -> dict:
        """As JSON values."""
        return {**asdict(self), "command": list(self.command), "said": self.said}


class World:
    """One run's clock, bus and firmware."""

    def __init__(self, buses: Sequence[VirtualBus], firmware: Sequence[Firmware], wall_limit_s: float = _WALL_LIMIT_S):
        """Check the programs and lay the region out; nothing runs yet.

        Raises:
            UsageError: too many nodes or buses, a bus name that is none, or a program that cannot be followed.
        """
        _check(buses, firmware)
        self.firmware = list(firmware)
        self._library = _load(bench_library())
        self._preload = preload_library()
        self._fd = os.memfd_create("hilrunner-virtual")
        size = self._library.vb_region_size()
        os.ftruncate(self._fd, size)
        self._memory = mmap.mmap(self._fd, size)
        self._anchor = ctypes.c_char.from_buffer(self._memory)
        self._region = ctypes.addressof(self._anchor)
        self._hub = ctypes.create_string_buffer(self._library.vb_hub_size())
        self._processes: list[subprocess.Popen] = []
        # where each side has a core of its own, a short look saves two changes of context
        spins = 300 if (os.cpu_count() or 1) > 1 else 0
        self._library.vb_hub_init(self.hub, self._region, round(wall_limit_s * NS_PER_S), spins)
        for index, bus in enumerate(buses):
            self._library.vb_set_bus(
                self._region, index, bus.name.encode(), bus.fd, _bit_ps(bus.bitrate), _bit_ps(bus.data_bitrate)
            )
        self._library.vb_set_clock(self._region, START_MONO_NS, START_REAL_NS - START_MONO_NS, len(self.firmware))

    @property
    def hub(self) -> int:
        """Address of the bench's side."""
        return ctypes.addressof(self._hub)

    @property
    def addresses(self) -> dict[str, int]:
        """Addresses of the C functions that the loop calls: advance, receive, send."""
        names = ("advance", "receive", "send")
        return {name: ctypes.cast(getattr(self._library, f"vb_{name}"), ctypes.c_void_p).value or 0 for name in names}

    def start(self) -> None:
        """Start the firmware processes; each waits for its first turn at its first meeting with time or CAN.

        Raises:
            UsageError: a program cannot be started.
        """
        for index, one in enumerate(self.firmware):
            environment = dict(os.environ, **one.environment)
            before = environment.get("LD_PRELOAD")
            environment["LD_PRELOAD"] = f"{self._preload}:{before}" if before else str(self._preload)
            environment["HILRUNNER_VIRTUAL_REGION"] = f"/proc/{os.getpid()}/fd/{self._fd}"
            environment["HILRUNNER_VIRTUAL_NODE"] = str(index)
            try:
                process = subprocess.Popen(
                    list(one.command), env=environment, stdin=subprocess.DEVNULL, start_new_session=True
                )
            except OSError as error:
                self.close()
                raise UsageError(
                    f"firmware {one.command[0]!r}", f"cannot be started: {error.strerror}", remedy="name a program"
                ) from None
            self._processes.append(process)
            self._library.vb_set_starter(self._region, index, process.pid)

    def failure(self) -> str:
        """Why virtual time came to a stand, in words; empty while it has not."""
        kind = self._library.vb_failure(self.hub)
        if kind == 0:
            return ""
        node = self._library.vb_failed_node(self.hub)
        name = " ".join(self.firmware[node].command)
        if _FAILURES[kind] == "refused":
            return f"virtual time cannot follow {name!r}: {self._text(node)}"
        if not self._library.vb_node_loaded(self._region, node):
            return f"nothing could be preloaded into {name!r}: virtual time cannot follow it"
        return f"{name!r} did not sleep for {_WALL_LIMIT_S:g} s of wall-clock time: it hangs, or it waits for what virtual time cannot see"

    def bus_load(self, bus: int = 0) -> tuple[int, float]:
        """Frames that the bus has carried, and for how long it was busy; s."""
        return self._library.vb_bus_carried(self.hub, bus), self._library.vb_bus_busy_ns(self.hub, bus) / NS_PER_S

    @property
    def turns(self) -> int:
        """How often a node was given the turn."""
        return self._library.vb_turns(self.hub)

    @property
    def frames_dropped(self) -> int:
        """Frames that the bench's own queue had no room for."""
        return self._library.vb_inbox_dropped(self.hub)

    def stop(self) -> list[FirmwareEnd]:
        """End every firmware process as SIGTERM does, wait for it, and tell what became of it."""
        self._library.vb_stop(self.hub)
        limit_s = time.monotonic() + _END_WAIT_S
        ends = []
        for index, process in enumerate(self._processes):
            try:
                code: int | None = process.wait(max(limit_s - time.monotonic(), 0.1))
            except subprocess.TimeoutExpired:
                _kill(process)
                code = None
            ends.append(
                FirmwareEnd(
                    command=tuple(self.firmware[index].command),
                    exit_code=code,
                    frames_dropped=self._library.vb_node_dropped(self._region, index),
                    frames_refused=self._library.vb_node_refused(self._region, index),
                    refusal=self._text(index),
                )
            )
        return ends

    def close(self) -> None:
        """Nothing of the run stays: no process, no memory."""
        for process in self._processes:
            if process.poll() is None:
                _kill(process)
        self._processes.clear()
        if self._fd >= 0:
            os.close(self._fd)  # the mapping itself goes with the object: compiled code may still hold its address
            self._fd = -1

    def _text(self, node: int) -> str:
        return self._library.vb_node_text(self._region, node).decode(errors="replace")


def _kill(process: subprocess.Popen) -> None:
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        process.kill()
    process.wait()


def _bit_ps(bitrate: int) -> int:
    """Length of a bit in ps; 0 stays 0: no bit time at all."""
    return round(1_000_000_000_000 / bitrate) if bitrate else 0


def _check(buses: Sequence[VirtualBus], firmware: Sequence[Firmware]) -> None:
    if not 1 <= len(buses) <= BUSES_MAX:
        raise UsageError("virtual time", f"{len(buses)} buses", f"1 to {BUSES_MAX}", "name fewer")
    if not 1 <= len(firmware) <= NODES_MAX:
        raise UsageError("virtual time", f"{len(firmware)} firmware processes", f"1 to {NODES_MAX}", "name fewer")
    for bus in buses:
        if not 1 <= len(bus.name.encode()) <= NAME_LENGTH_MAX or "/" in bus.name or bus.name.isspace():
            raise UsageError(
                f"bus {bus.name!r}", "not the name of an interface", f"1 to {NAME_LENGTH_MAX} characters", "shorten it"
            )
    for one in firmware:
        if not one.command:
            raise UsageError("virtual time", "a firmware without a command", remedy="name a program after --")
        check_program(one.command[0])


def _load(path: Path) -> ctypes.CDLL:
    """The bench's library with its signatures."""
    library = ctypes.CDLL(str(path))
    pointer, number, long, unsigned = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64, ctypes.c_uint64
    signatures = {
        "hub_size": (ctypes.c_size_t, []),
        "region_size": (ctypes.c_size_t, []),
        "hub_init": (None, [pointer, pointer, long, number]),
        "set_bus": (None, [pointer, number, ctypes.c_char_p, number, long, long]),
        "set_clock": (None, [pointer, long, long, number]),
        "set_starter": (None, [pointer, number, ctypes.c_int32]),
        "advance": (long, [pointer, long]),
        "receive": (long, [pointer, pointer, pointer, pointer, long]),
        "send": (long, [pointer, pointer, pointer, long]),
        "stop": (None, [pointer]),
        "failure": (number, [pointer]),
        "failed_node": (number, [pointer]),
        "turns": (long, [pointer]),
        "inbox_dropped": (unsigned, [pointer]),
        "bus_carried": (unsigned, [pointer, number]),
        "bus_busy_ns": (long, [pointer, number]),
        "bus_refused": (unsigned, [pointer, number]),
        "node_state": (number, [pointer, number]),
        "node_loaded": (number, [pointer, number]),
        "node_text": (ctypes.c_char_p, [pointer, number]),
        "node_dropped": (unsigned, [pointer, number]),
        "node_refused": (unsigned, [pointer, number]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(library, f"vb_{name}")
        function.restype, function.argtypes = result, arguments
    return library
