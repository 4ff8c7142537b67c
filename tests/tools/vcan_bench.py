"""The runner as a process on vcan0, for tests: started, awaited by its first frame, ended, its summary and log read."""

import ctypes
import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

from hilrunner.evidence.reader import read_run
from hilrunner.setup.profile import load_profile

INTERFACE = "vcan0"
STATUS_ID = 0x381
MOTION_ID = 0x281
COMMAND_ID = 0x201
START_LIMIT_S = 180.0
END_LIMIT_S = 120.0
# User-Mode Linux is one slow core for the bench, its recorder, the firmware and the test: a longer period leaves all of them room
IN_LAB = "User Mode Linux" in Path("/proc/cpuinfo").read_text()
PERIOD_US = 4000 if IN_LAB else 1000
PROFILE = "amc-lift"
AGEING_MS = {
    "stale_after_ms": 250.0,
    "hold_for_ms": 100.0,
    "ramp_for_ms": 200.0,
}  # no pause of a busy host is a lost firmware
# and a pause of a busy host makes the firmware command violently, which surrogates without spool mass follow less exactly
TOLERANCES_MPA = {"pressure_tolerance_mpa": 0.03, "sustained_pressure_tolerance_mpa": 0.015}
STALLS_TOLD_ONLY = '\n[deadline.stall_ms]\naction = "warn"\n'  # a busy host fails no test that is not about stalls
FIRMWARE = Path(__file__).resolve().parents[2] / "firmware_iface" / "c" / "build" / "reference_firmware"


def patient_profile(folder: Path) -> Path:
    """The shipped profile with slower ageing of commands, wider tolerances and stalls that are told only, written into a folder."""
    text = load_profile(PROFILE).text
    for key, value in (AGEING_MS | TOLERANCES_MPA).items():
        text, count = re.subn(rf"(?m)^{key} = .*$", f"{key} = {value}", text)
        assert count == 1, key
    path = folder / f"{PROFILE}.toml"
    path.write_text(text + STALLS_TOLD_ONLY)
    return path


def send_fast(bus: "RawBus", frames: list[tuple[int, bytes, int]]) -> None:
    """Many frames with one call to the kernel; lengths may lie."""
    raw = b"".join(struct.pack("=IB3x8s", can_id, length, data) for can_id, data, length in frames)
    buffer = ctypes.create_string_buffer(raw, len(raw))
    pieces = (IoVec * len(frames))(*((ctypes.addressof(buffer) + 16 * k, 16) for k in range(len(frames))))
    messages = (MMsgHdr * len(frames))()
    for k, message in enumerate(messages):
        message.pieces, message.piece_count = ctypes.pointer(pieces[k]), 1
    done = 0
    while done < len(frames):
        place = ctypes.byref(messages, done * ctypes.sizeof(MMsgHdr))
        count = LIBC.sendmmsg(bus.socket.fileno(), place, len(frames) - done, 0)
        if count < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        done += count


class IoVec(ctypes.Structure):
    """struct iovec"""

    _fields_ = [("base", ctypes.c_void_p), ("size", ctypes.c_size_t)]


class MMsgHdr(ctypes.Structure):
    """struct mmsghdr"""

    _fields_ = [
        ("name", ctypes.c_void_p), ("name_size", ctypes.c_uint), ("pieces", ctypes.POINTER(IoVec)), ("piece_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p), ("control_size", ctypes.c_size_t), ("flags", ctypes.c_int), ("sent", ctypes.c_uint),
    ]  # fmt: skip


LIBC = ctypes.CDLL(None, use_errno=True)


class RawBus:
    """A raw CAN socket; `can_id` None: every frame."""

    def __init__(self, can_id: int | None = None, interface: str = INTERFACE) -> None:
        self.socket = socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        if can_id is not None:
            self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", can_id, 0x7FF))
        self.socket.bind((interface,))

    def __enter__(self) -> "RawBus":
        return self

    def __exit__(self, *_) -> None:
        self.socket.close()

    def send(self, can_id: int, data: bytes, length: int | None = None) -> None:
        """One classic frame; `length` may lie."""
        frame = struct.pack("=IB3x8s", can_id, len(data) if length is None else length, bytes(data))
        self.socket.send(frame)

    def receive(self, limit_s: float) -> bytes | None:
        """The data of the next frame, or None."""
        self.socket.settimeout(limit_s)
        try:
            frame = self.socket.recv(16)
        except TimeoutError:
            return None
        return frame[8 : 8 + frame[4]]


def wait_for_control(control: int, limit_s: float = 60.0) -> None:
    """Until the firmware on the bus sends this control word (high nibble of byte 1 of VALVE_COMMAND)."""
    end_s = time.monotonic() + limit_s
    with RawBus(COMMAND_ID) as bus:
        while time.monotonic() < end_s:
            data = bus.receive(0.5)
            if data and data[1] >> 4 == control:
                return
    raise AssertionError(f"the firmware never sent control word {control}")


class BenchProcess:
    """`hilrunner --can vcan0 --json` with a log in a folder; options given here win over the defaults of the tests."""

    def __init__(
        self, folder: Path, *options: str, wait: bool = True, log: str | None = "run.mcap", json_: bool = True
    ) -> None:
        self.log = folder / log if log else None
        words = [] if any(word in options for word in ("--can", "-i")) else ["--can", INTERFACE]
        words += ["--log", str(self.log)] if log else ["--no-log"]
        words += ["--json"] if json_ else []
        words += ["--profile", str(patient_profile(folder)), "--period-us", str(PERIOD_US)]
        words += ["--priority", "0"] if IN_LAB else []  # SCHED_FIFO on the only core is nobody else's turn
        self._seen = RawBus(STATUS_ID) if wait else None
        self.process = subprocess.Popen(
            [sys.executable, "-m", "hilrunner", *words, *options],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder,
        )  # fmt: skip
        self.out, self.err = "", ""
        if wait:
            self.wait_first_frame()

    def wait_first_frame(self) -> None:
        """Until the bench has sent BENCH_STATUS once."""
        end_s = time.monotonic() + START_LIMIT_S
        with self._seen as bus:
            while time.monotonic() < end_s and self.process.poll() is None:
                if bus.receive(0.5) is not None:
                    return
        self.process.kill()
        out, err = self.process.communicate()
        raise AssertionError(f"the bench sent nothing (exit code {self.process.returncode}):\n{out}\n{err}")

    def signal(self, number: int) -> None:
        """A signal to the runner."""
        os.kill(self.process.pid, number)

    def end(self, number: int | None = None) -> int:
        """Wait for the end, after a signal if one is given; the exit code."""
        if number is not None:
            self.signal(number)
        self.out, self.err = self.process.communicate(timeout=END_LIMIT_S)
        return self.process.returncode

    def summary(self) -> dict:
        """The JSON the runner printed."""
        return json.loads(self.out)

    def run(self):
        """The log, read."""
        return read_run(self.log)

    def stop(self) -> None:
        """Leave nothing behind."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGKILL)
            self.process.communicate()


class Firmware:
    """The reference firmware as a process."""

    def __init__(self, *options: str) -> None:
        self.process = subprocess.Popen([FIRMWARE, "-i", INTERFACE, *options], stdout=subprocess.PIPE, text=True)

    def end(self) -> dict:
        """SIGINT, and its JSON line."""
        self.process.send_signal(signal.SIGINT)
        out, _ = self.process.communicate(timeout=END_LIMIT_S)
        return json.loads(out)

    def kill(self) -> None:
        """As a crash would end it."""
        self.process.kill()
        self.process.communicate()
