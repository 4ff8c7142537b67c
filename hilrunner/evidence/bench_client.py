"""A bench started as a user starts it, driven over the bus: what the pytest plugin hands to a test."""

import contextlib
import json
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilrunner.base.errors import CanError
from hilrunner.evidence.signals import Messages
from hilrunner.record.child import module_command
from hilrunner.setup.bus_open import open_backend

START_LIMIT_S = 300.0  # the first start on a machine compiles
STOP_LIMIT_S = 60.0


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    exit_code: int
    summary: dict[str, Any]  # what `hilrunner run --json` printed
    log_path: Path
    messages: str  # its stderr

    def log(self):
        """The run as arrays (evidence.reader.Run)."""
        from hilrunner.evidence.reader import read_run

        return read_run(self.log_path)

    def report(self):
        """The run measured and judged (evidence.report.Report)."""
        from hilrunner.evidence.report import build_report

        return build_report(self.log_path)


class Cyclic:
    """A message sent again and again on a thread of its own; `update` changes signals from the next frame on."""

    def __init__(self, bench: "Bench", period_s: float, name: str, values: dict) -> None:
        self._bench, self._period_s, self._name = bench, period_s, name
        self._values = dict(values)
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=f"send-{name}", daemon=True)
        self._thread.start()

    def update(self, **values) -> None:
        """New values of some signals."""
        with self._lock:
            self._values |= values

    def stop(self) -> None:
        """Send no more."""
        self._stopped.set()
        self._thread.join()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stopped.is_set():
            with self._lock:
                values = dict(self._values)
            try:
                self._bench.send(self._name, **values)
            except Exception as error:  # told by the next wait of the test
                self.failure = error
                return
            due += self._period_s
            now = time.monotonic()
            if due < now:
                due = now  # a test need not catch up
            self._stopped.wait(due - now)


class Bench:
    """A running bench.

    Args:
        command: how it is started, without the log and JSON options.
        log_path: where its log goes. interface, channel: the bus, as in python-can. messages: the contract.
    """

    def __init__(
        self, command: list[str], log_path: Path, interface: str, channel: str, messages: Messages, **bus
    ) -> None:
        self._messages = messages
        self.log_path = log_path
        self._signals: dict[str, dict] = {}
        self._counts: dict[str, int] = {}
        self._news = threading.Condition()
        self._cyclic: list[Cyclic] = []
        self._send_lock = threading.Lock()
        self._output = log_path.with_suffix(".stdout").open("w+")
        self._errors = log_path.with_suffix(".stderr").open("w+")
        self.outcome: Outcome | None = None
        self._bus = open_backend(interface, channel, bus)
        try:
            self._process = subprocess.Popen(
                [*command, "--log", str(log_path), "--json"],
                stdout=self._output,
                stderr=self._errors,
                stdin=subprocess.DEVNULL,
            )
        except BaseException:
            self._bus.shutdown()
            raise
        self._open = True
        self._receiver = threading.Thread(target=self._receive, name="receive", daemon=True)
        self._receiver.start()

    def wait_started(self, timeout_s: float = START_LIMIT_S) -> None:
        """Wait for the first frame of the bench; CanError with its own words when it ends or stays silent."""
        end = time.monotonic() + timeout_s
        with self._news:
            while not self._counts:
                if self._process.poll() is not None or time.monotonic() > end:
                    break
                self._news.wait(0.05)
        if not self._counts:
            self.close()
            raise CanError(
                "hilrunner run", f"sent no frame: {self._said() or 'and said nothing'}", remedy="see its words"
            )

    def send(self, name: str, **values) -> None:
        """Send one frame of a message; signals not given have their start value, counter and CRC are filled in."""
        import can

        message = self._messages.find(name)
        with self._send_lock:
            data = self._messages.encode(name, values)
            self._bus.send(
                can.Message(
                    arbitration_id=message.frame_id,
                    is_extended_id=message.is_extended_frame,
                    is_fd=message.is_fd,
                    data=data,
                )
            )

    def send_every(self, period_s: float, name: str, **values) -> Cyclic:
        """Send a message every `period_s` until `stop` of what is returned, or the end of the test."""
        cyclic = Cyclic(self, period_s, name, values)
        self._cyclic.append(cyclic)
        return cyclic

    def signal(self, message: str, name: str):
        """The newest value of a signal; AssertionError when no frame of its message has come."""
        known = {one.name for one in self._messages.find(message).signals}
        assert name in known, f"{message} has no signal {name}, but {', '.join(sorted(known))}"
        with self._news:
            assert message in self._signals, f"no {message} has been received"
            return self._signals[message][name]

    def count(self, message: str) -> int:
        """Frames of a message received so far."""
        with self._news:
            return self._counts.get(message, 0)

    def wait_until(self, condition: Callable[["Bench"], bool], timeout_s: float = 5.0) -> None:
        """Wait until a condition holds; it is asked at every frame. AssertionError with the newest signals after `timeout_s`."""
        end = time.monotonic() + timeout_s
        while not self._holds(condition):
            left = end - time.monotonic()
            assert left > 0, f"not within {timeout_s:g} s; newest signals: {self.snapshot()}"
            self._check_alive()
            with self._news:
                self._news.wait(min(left, 0.1))

    def holds_for(self, condition: Callable[["Bench"], bool], duration_s: float) -> None:
        """Watch a condition at every frame for a while; AssertionError with the newest signals when it breaks."""
        end = time.monotonic() + duration_s
        while time.monotonic() < end:
            assert self._holds(condition), (
                f"broken after {duration_s - (end - time.monotonic()):.3f} s: {self.snapshot()}"
            )
            self._check_alive()
            with self._news:
                self._news.wait(0.05)

    def snapshot(self) -> dict[str, dict]:
        """The newest signals of every message."""
        with self._news:
            return {name: dict(values) for name, values in self._signals.items()}

    def stop(self) -> Outcome:
        """End the run as Ctrl-C does; its exit code, summary and log."""
        if self.outcome is not None:
            return self.outcome
        for cyclic in self._cyclic:
            cyclic.stop()
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        try:
            code = self._process.wait(STOP_LIMIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        self.close()
        self._output.seek(0)
        summary: dict[str, Any] = {}
        with contextlib.suppress(ValueError):
            summary = json.loads(self._output.read() or "{}")
        self.outcome = Outcome(code, summary, self.log_path, self._said())
        return self.outcome

    def close(self) -> None:
        """Leave nothing running."""
        for cyclic in self._cyclic:
            cyclic.stop()
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        if self._open:
            self._open = False
            self._receiver.join()
            self._bus.shutdown()

    def _check_alive(self) -> None:
        assert self._process.poll() is None, f"the bench ended: {self._said()}"
        for cyclic in self._cyclic:
            if cyclic.failure is not None:
                raise cyclic.failure

    def _said(self) -> str:
        self._errors.flush()
        return Path(self._errors.name).read_text(errors="replace").strip()[-2000:]

    def _holds(self, condition: Callable[["Bench"], bool]) -> bool:
        try:
            return bool(condition(self))
        except AssertionError:  # a signal that has not come yet does not hold
            return False

    def _receive(self) -> None:
        while self._open:
            frame = self._bus.recv(0.05)
            if frame is None or frame.is_error_frame or frame.is_remote_frame:
                continue
            decoded = self._messages.decode(frame.arbitration_id, frame.is_extended_id, bytes(frame.data))
            if decoded is None:
                continue
            with self._news:
                self._signals[decoded[0]] = decoded[1]
                self._counts[decoded[0]] = self._counts.get(decoded[0], 0) + 1
                self._news.notify_all()


def bench_command(interface: str, channel: str, profile: str, options: list[str]) -> list[str]:
    """How a bench is started on a bus."""
    return [*module_command("hilrunner"), "run", "-i", interface, "-c", channel, "--profile", profile, *options]
