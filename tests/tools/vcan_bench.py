"""The runner as a process on vcan0, for tests: started, awaited by its first frame, ended, its summary and log read."""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

from hilrunner.evidence.reader import read_run

INTERFACE = "vcan0"
STATUS_ID = 0x381
MOTION_ID = 0x281
COMMAND_ID = 0x201
START_LIMIT_S = 180.0
END_LIMIT_S = 120.0
FIRMWARE = Path(__file__).resolve().parents[2] / "firmware_iface" / "c" / "build" / "reference_firmware"


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
    """`hilrunner --can vcan0 --json` with a log in a folder."""

    def __init__(
        self, folder: Path, *options: str, wait: bool = True, log: str | None = "run.mcap", json_: bool = True
    ) -> None:
        self.log = folder / log if log else None
        words = [] if any(word in options for word in ("--can", "-i")) else ["--can", INTERFACE]
        words += ["--log", str(self.log)] if log else ["--no-log"]
        words += ["--json"] if json_ else []
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
