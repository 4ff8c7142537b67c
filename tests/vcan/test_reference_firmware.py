"""The reference firmware as a program on a real vcan0: frames on the bus, end by signal and duration, loss of the bus.

The bench here is a few lines of python-can, cantools and autosar-e2e; none of the runner's code is in it.
"""

import json
import signal
import subprocess
import time

import can
import pytest

from tests.tools import contract, firmware_c

pytestmark = pytest.mark.vcan

PERIOD_S = 0.002


@pytest.fixture(scope="module")
def firmware():
    """The program, by the Makefile a firmware team would use; built before, this costs nothing (the lab compiles slowly)."""
    subprocess.run(["make", "-s", "-C", str(firmware_c.FOLDER), "reference_firmware"], check=True)
    return firmware_c.FOLDER / "build" / "reference_firmware"


class TinyBench:
    """A rod that obeys the set point, and the three measurement messages."""

    def __init__(self) -> None:
        self.bus = can.Bus("vcan0", interface="socketcan", can_filters=[{"can_id": 0x201, "can_mask": 0xFFF}])
        self.position_mm, self.velocity_mmps, self.counter = 600.0, 0.0, 0
        self.state, self.echo = 0, 0
        self.commands: list[bytes] = []

    def _send(self, name: str, **values) -> None:
        message = contract.database().get_message_by_name(f"{name}_1")
        data = message.encode({"crc8": 0, "alive_counter": self.counter, **values}, strict=False)
        self.bus.send(can.Message(arbitration_id=message.frame_id, is_extended_id=False,
                                  data=contract.protected(message.name, data)))  # fmt: skip

    def period(self) -> None:
        """Take what came, move the rod, send."""
        while (frame := self.bus.recv(0)) is not None:
            self.commands.append(bytes(frame.data))
            read = contract.database().decode_message(0x201, frame.data, decode_choices=False)
            self.velocity_mmps = 22.5 * read["valve_setpoint"] / 100 if read["control"] == 2 else 0.0
            self.echo = read["timestamp_us"] & 0xFFFF
            if self.state != 6 or read["control"] == 3:
                self.state = {0: 1, 2: 3}.get(read["control"], 2)
        self.position_mm += self.velocity_mmps * PERIOD_S
        self.counter = (self.counter + 1) % 16
        self._send("PRESSURES", chamber_1_pressure_kpa=9200, chamber_2_pressure_kpa=800, supply_pressure_kpa=30000)
        self._send("MOTION", rod_position_mm=self.position_mm, rod_velocity_mmps=self.velocity_mmps)
        self._send(
            "BENCH_STATUS", bench_state=self.state, flags=0, deadline_misses=0, tick=0, echoed_timestamp_us=self.echo
        )

    def run(self, seconds: float, until=lambda bench: False) -> None:
        """Periods on an absolute grid for some time or until a condition."""
        start = time.monotonic()
        tick = 0
        while time.monotonic() - start < seconds and not until(self):
            tick += 1
            self.period()
            time.sleep(max(0.0, start + tick * PERIOD_S - time.monotonic()))

    def controls(self) -> list[int]:
        """Control words in the order they came."""
        return [data[1] >> 4 for data in self.commands]


@pytest.fixture
def bench():
    """The tiny bench on vcan0."""
    tiny = TinyBench()
    yield tiny
    tiny.bus.shutdown()


def started(firmware, *words):
    return subprocess.Popen(
        [firmware, "-i", "vcan0", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def finished(process) -> dict:
    """The program's JSON line; it must have ended by itself or by the signal already sent."""
    out, err = process.communicate(timeout=30)
    assert out.count("\n") == 1, err
    return json.loads(out)


def test_it_drives_the_bench_and_ends_after_its_duration(firmware, bench):
    process = started(firmware, "--duration-s", "10", "--ramp-s", "0.5", "--period-us", "5000")
    bench.run(60, until=lambda _: process.poll() is not None)
    report = finished(process)
    bench.period()
    assert process.returncode == 0 and report["exit_code"] == 0
    assert report["active_periods"] > 100 and report["reference_mm_rms"] > 0
    assert report["frames_sent"] == len(bench.commands) == report["periods"] + 1
    assert report["frames_rejected"] == 0 and report["frames_received"] > 100
    assert report["round_trip_us_max"] > 0
    for number, data in enumerate(bench.commands, 1):
        assert data[1] & 0x0F == number % 16 and bytes(contract.protected("VALVE_COMMAND_1", data)) == data
    assert 2 in bench.controls() and bench.controls()[-1] == 0, "Active, and Disabled at the end"
    assert bench.position_mm != 600.0


def test_it_resets_a_latched_fail_safe(firmware, bench):
    bench.state = 6
    process = started(firmware, "--period-us", "5000")
    bench.run(20, until=lambda b: b.controls()[-3:] == [2, 2, 2])
    process.send_signal(signal.SIGTERM)
    report = finished(process)
    assert process.returncode == 0 and report["fail_safes_seen"] == 1 and report["reset_frames"] >= 1
    controls = bench.controls()
    assert controls.index(3) < controls.index(2)


def test_without_a_bench_it_stays_disabled(firmware, bench):
    process = started(firmware, "--duration-s", "0.5")
    assert finished(process)["state"] == "start"
    while (frame := bench.bus.recv(0.1)) is not None:
        bench.commands.append(bytes(frame.data))
    assert len(bench.commands) > 10 and set(bench.controls()) == {0}


def test_it_notices_that_the_bench_is_gone(firmware, bench):
    process = started(firmware, "--period-us", "5000")
    bench.run(20, until=lambda b: 2 in b.controls())
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and bench.controls()[-1] != 1:
        if (frame := bench.bus.recv(0.1)) is not None:
            bench.commands.append(bytes(frame.data))
    process.send_signal(signal.SIGINT)
    report = finished(process)
    assert report["measurement_timeouts"] == 1 and report["state"] == "hold"


def test_a_lost_interface_ends_it_with_4(firmware):
    subprocess.run(["ip", "link", "add", "dev", "vcanfw", "type", "vcan"], check=True)
    try:
        subprocess.run(["ip", "link", "set", "vcanfw", "up"], check=True)
        process = subprocess.Popen(
            [firmware, "-i", "vcanfw"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        time.sleep(0.3)
        subprocess.run(["ip", "link", "set", "vcanfw", "down"], check=True)
        out, err = process.communicate(timeout=30)
    finally:
        subprocess.run(["ip", "link", "del", "vcanfw"], check=True)
    assert process.returncode == 4 and "vcanfw lost" in err
    assert json.loads(out)["exit_code"] == 4
