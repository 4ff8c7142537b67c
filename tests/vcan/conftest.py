"""Tests of this folder need a real vcan0. Without one they fail and say how to get it: they are never left out."""

import subprocess
from pathlib import Path

import pytest

from tests.tools import vcan_bench

NO_BUS = "no vcan0 here; run: tools/vcan_lab -- .venv/bin/python -m pytest tests/vcan"


def pytest_collection_modifyitems(items):
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.vcan)


def pytest_runtest_logreport(report):
    """What failed is told at once: a lab that has to be switched off must not take the reasons with it."""
    if report.failed:
        print(f"\n{report.nodeid} ({report.when}, {report.duration:.1f} s):\n{report.longreprtext}", flush=True)


@pytest.fixture(autouse=True)
def real_vcan0():
    """A vcan0 that is up before and after every test."""
    if not Path("/sys/class/net/vcan0").exists():
        pytest.fail(NO_BUS, pytrace=False)
    subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)


@pytest.fixture(scope="session")
def firmware_built():
    """The reference firmware, built once."""
    folder = vcan_bench.FIRMWARE.parent.parent
    subprocess.run(["make", "-s", "-C", str(folder), "reference_firmware"], check=True)


@pytest.fixture
def bench(tmp_path):
    """Start benches: bench("--duration", "3"); whatever still runs at the end is killed."""
    started = []

    def start(*options, **settings):
        process = vcan_bench.BenchProcess(tmp_path, *options, **settings)
        started.append(process)
        return process

    yield start
    for process in started:
        process.stop()


@pytest.fixture
def firmware(firmware_built):
    """Start firmwares, with the same care."""
    started = []

    def start(*options):
        process = vcan_bench.Firmware(*options)
        started.append(process)
        return process

    yield start
    for process in started:
        if process.process.poll() is None:
            process.kill()
