"""vcan with a queue and a rate (tc tbf): what a plain vcan never shows. Lost and doubled frames: tests/faults/test_frames.py."""

import signal
import subprocess
import time

import pytest

from hilrunner.base import exit_codes
from tests.vcan.test_main_job import complete


@pytest.fixture
def shape():
    """Put a queue discipline on vcan0; taken away afterwards."""

    def add(*words):
        subprocess.run(["tc", "qdisc", "add", "dev", "vcan0", "root", *words], check=True)

    yield add
    subprocess.run(["tc", "qdisc", "del", "dev", "vcan0", "root"], capture_output=True)


def test_a_full_transmit_queue_costs_frames_not_the_run(bench, shape):
    """ENOBUFS: more frames than the bus takes are counted as not sent; the loop neither blocks nor ends."""
    running = bench()
    shape("tbf", "rate", "20kbit", "burst", "32", "limit", "48")
    time.sleep(2.0)
    assert running.end(signal.SIGINT) == exit_codes.VERDICT_FAILED, "no firmware was there"
    summary = running.summary()
    assert summary["frames_unsent"] > 500
    assert summary["frames_sent"] > 100
    run = running.run()
    complete(run)
    assert len(run.can_tx) == summary["frames_sent"]
