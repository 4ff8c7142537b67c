"""`hilrunner run` on a bus made of two connected UDP sockets: everything of a real run but CAN, wherever the tests run.

    socket_bench.py DESCRIPTOR START_DELAY_S OPTION …      the bench; its end of the bus is the inherited DESCRIPTOR

The kernel stamps what it receives (SO_TIMESTAMPNS) and counts what it drops (SO_RXQ_OVFL), as a raw CAN socket does, and the sender
may go on while the bench stands still. For tests: `Peers` makes the pair, `BenchOnSocket` starts the bench, `Firmware` sends.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

from hilrunner.base import status

ROOT = Path(__file__).resolve().parents[2]
COMMAND_ID = 0x201
START_LIMIT_S = 240.0
END_LIMIT_S = 120.0


def peers() -> tuple[socket.socket, socket.socket]:
    """(end of the bench, end of the firmware)."""
    ends = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for end in ends:
        end.bind(("127.0.0.1", 0))
    ends[0].connect(ends[1].getsockname())
    ends[1].connect(ends[0].getsockname())
    return ends[0], ends[1]


class Firmware:
    """Commands every `every_s`, from now to `end`; `sent_mono_s` says when each was."""

    def __init__(self, end: socket.socket, every_s: float = 0.005) -> None:
        from tests.tools import contract

        self._frame = contract.command_frame
        self._end, self._every_s = end, every_s
        self.sent_mono_s: list[float] = []
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._stopping.is_set():
            k = len(self.sent_mono_s)
            percent = 20.0 if k // 200 % 2 == 0 else -20.0
            data = bytes(self._frame(1, control=status.CONTROL_ACTIVE, setpoint_percent=percent, counter=k % 16))
            try:
                self._end.send(COMMAND_ID.to_bytes(4, "little") + bytes([8, 0, 0, 0]) + data)
            except ConnectionRefusedError:  # the bench has closed its end
                return
            self.sent_mono_s.append(time.monotonic())
            next_s += self._every_s
            time.sleep(max(next_s - time.monotonic(), 0.0))

    def end(self) -> None:
        """Say nothing more."""
        self._stopping.set()
        self._thread.join()


class BenchOnSocket:
    """The bench as a process; `json` summaries are read at its end."""

    def __init__(self, end: socket.socket, *options: str, start_delay_s: float = 0.02, environment=None) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).resolve()), str(end.fileno()), str(start_delay_s), *options],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, pass_fds=(end.fileno(),), cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT), **(environment or {})},
        )  # fmt: skip
        self.told = []  # lines of stderr before the clock ran

    def wait_armed(self) -> None:
        """Until the deadline of tick 0 is fixed."""
        limit = threading.Timer(START_LIMIT_S, self.process.kill)
        limit.start()
        try:
            for line in self.process.stderr:
                self.told.append(line)
                if line.startswith("armed"):
                    return
        finally:
            limit.cancel()
        raise AssertionError(f"the bench did not start: {''.join(self.told)}")

    def stand_still(self, seconds: float) -> None:
        """Stop the process as a host would: all of its threads, in the middle of whatever they do."""
        self.process.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        self.process.send_signal(signal.SIGCONT)

    def end(self, limit_s: float = END_LIMIT_S) -> tuple[int, dict, str]:
        """(exit code, summary, what it said on stderr)."""
        try:
            out, err = self.process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        lines = out.strip().splitlines()
        return self.process.returncode, json.loads(lines[-1]) if lines else {}, "".join(self.told) + err


class _Inherited:
    """What an OpenBus closes."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    def shutdown(self) -> None:
        self._end.close()


def _main() -> int:
    from hilrunner import cli
    from hilrunner.setup import bus, session

    end = socket.socket(fileno=int(sys.argv[1]))
    end.setblocking(False)
    end.setsockopt(socket.SOL_SOCKET, bus._SO_TIMESTAMPNS, 1)
    end.setsockopt(socket.SOL_SOCKET, bus._SO_RXQ_OVFL, 1)
    end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, bus._RECEIVE_BUFFER_BYTES)
    session.open_bus = lambda *_, **__: bus.OpenBus(_Inherited(end), end.fileno(), "udp")
    session._START_DELAY_NS = int(float(sys.argv[2]) * 1e9)
    prepare = session.Session._prepare

    def prepared(self) -> None:
        prepare(self)
        sys.stderr.write("armed\n")
        sys.stderr.flush()

    session.Session._prepare = prepared
    return cli.main(["run", "--can", "udp", "--json", "--priority", "0", *sys.argv[3:]])


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(_main())
