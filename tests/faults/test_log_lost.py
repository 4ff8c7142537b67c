"""What befalls a log while it is written is noticed then, told then, and told again at the end; a name is written by one run at a time."""

import errno
import os
import signal
import subprocess
import time

import pytest
from recorder_producer import Producer, ring_shape

from hilrunner.base import exit_codes, ring, status
from hilrunner.base.errors import LogError, UsageError
from hilrunner.commands.targets import check_new_log, claim_log
from hilrunner.record import launch, mcap_file, process, run_watch
from hilrunner.record.config import RecorderConfig
from hilrunner.record.drain import Drain
from hilrunner.record.file_lock import is_locked
from hilrunner.record.mcap_log import LogWriter
from hilrunner.record.recorder import Recorder
from tests.tools import socket_bench


class Bench:
    """A recorder in this process, its producer, and what it told."""

    def __init__(self, folder):
        shape = ring_shape()
        self.path = folder / "a.mcap"
        self.block, block_ring = launch.create_ring(shape)
        settings = RecorderConfig(self.block.fd, list(shape), ["boom"], 1_000_000, os.getpid(), str(self.path))
        self.producer = Producer(block_ring, shape)
        self.recorder = Recorder(settings, Drain(block_ring, shape), process.open_log(settings))
        self.told = []
        self.recorder.event = lambda level, text: self.told.append(text)

    def cycle(self, ticks=50):
        """What the recorder does in a second."""
        self.producer.publish(ticks)
        self.recorder.drain.consume(self.recorder.drain.snapshot(), self.recorder)
        self.recorder.account()
        self.recorder.log.flush()

    def lacks(self):
        return self.producer.word(ring.WORD_LOG_LACKS)


@pytest.fixture
def bench(tmp_path):
    return Bench(tmp_path)


def replace(path):
    path.with_name("other").write_text("somebody else's")
    os.replace(path.with_name("other"), path)


@pytest.mark.parametrize("harm", [os.unlink, replace, lambda path: path.parent.rename(path.parent.with_name("moved"))])
def test_a_log_that_is_gone_is_noticed_while_the_run_goes_on(bench, harm):
    bench.cycle()
    assert bench.lacks() == 0 and bench.told == []
    harm(bench.path)
    bench.cycle()
    bench.cycle()
    assert bench.lacks() == ring.LOG_LACKS_NAME
    assert bench.told == [ring.LOG_LACKS_TEXTS[0]], "once"
    bench.recorder.finish(status.EXIT_DURATION)
    assert bench.recorder.summary(status.EXIT_DURATION)["log_lacks"] == [ring.LOG_LACKS_TEXTS[0]]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.ENOTCONN, errno.ESTALE, errno.ETIMEDOUT])
def test_a_disk_that_refuses_is_told_at_once_whatever_its_reason(bench, monkeypatch, code):
    bench.cycle()

    def refuse(fd, data):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(mcap_file.os, "write", refuse)
    bench.cycle()
    bench.recorder.account()
    monkeypatch.undo()
    assert bench.lacks() == ring.LOG_LACKS_DATA
    assert len(bench.told) == 1 and "disk refused" in bench.told[0]


def test_a_disk_that_is_gone_still_gives_a_summary(bench, monkeypatch):
    bench.cycle()

    def gone(*_):
        raise OSError(errno.EIO, "gone")

    for name in ("write", "ftruncate"):
        monkeypatch.setattr(mcap_file.os, name, gone)
    bench.cycle()
    bench.recorder.finish(status.EXIT_DURATION)
    assert bench.recorder.summary(status.EXIT_DURATION)["lost_bytes"] > 0


def test_a_name_is_written_by_one_run_at_a_time(tmp_path):
    path = tmp_path / "a.mcap"
    first = LogWriter(path, ["boom"])
    size_bytes = path.stat().st_size
    assert is_locked(path)
    with pytest.raises(LogError, match="another run is writing this log"):
        LogWriter(path, ["boom"])
    for take in (lambda: claim_log(path, overwrite=True), lambda: check_new_log(path, overwrite=True)):
        with pytest.raises(UsageError, match="writing this log now"):
            take()
    assert path.stat().st_size == size_bytes, "and nothing of it was touched"
    first.close()
    assert not is_locked(path)
    LogWriter(path, ["boom"]).close()


def test_what_befalls_a_run_is_told_once_and_in_words(bench, monkeypatch):
    bench.cycle()
    assert bench.told == []
    for word, value in (
        (ring.WORD_CAN_DROPPED, 7),
        (ring.WORD_KERNEL_DROPPED, 3),
        (ring.WORD_STALL_COUNT, 2),
        (ring.WORD_STALL_NS_LAST, 250_000_000),
        (ring.WORD_STALL_TICK_LAST, 77),
    ):
        bench.producer.store(word, value)
    bench.producer.ring.frame_count[1, status.FRAME_OWN_ID] = 5
    before_ns = bench.recorder._watch._offset_ns
    monkeypatch.setattr(run_watch, "_clock_offset_ns", lambda: before_ns + 3_600_000_000_000)
    bench.cycle()
    bench.cycle()
    assert [text.split(":")[0] for text in bench.told] == [
        "ring full",
        "the receive buffer of the socket was full",
        "another bench is on this bus",
        "the bench stalled",
        "the wall clock was set by +3600.000 s near tick 99; the times of this log go on by the old one",
    ]
    assert "250.0 ms before tick 77; 2 stalls" in bench.told[3]
    assert bench.recorder._closing_metadata(status.EXIT_DURATION, None)["run"]["clock_sets"] == "1"


def run_with(folder, harm, duration_s=3.0):
    """A run whose log meets `harm(log, pid of the recorder)` half a second after its first tick."""
    log = folder / "run.mcap"
    ours, theirs = socket_bench.peers()
    with ours, theirs:
        firmware = socket_bench.Firmware(theirs)
        profile = folder / "limited.toml"
        stalls = '\n[deadline.stall_ms]\naction = "warn"\n\n[limits]\npressure_mpa_max = 60.0\n'
        from hilrunner.setup.profile import load_profile

        profile.write_text(load_profile("amc-lift").text + stalls)
        bench = socket_bench.BenchOnSocket(
            ours, "--profile", str(profile), "--log", str(log), "--duration", str(duration_s)
        )
        bench.wait_armed()
        time.sleep(0.5)
        listed = subprocess.run(["pgrep", "-P", str(bench.process.pid)], capture_output=True, text=True).stdout.split()
        harm(log, [int(pid) for pid in listed])
        code, summary, told = bench.end()
        firmware.end()
    return code, summary, told


def test_a_run_whose_log_is_deleted_says_so_at_once_and_is_judged_all_the_same(tmp_path):
    code, summary, told = run_with(tmp_path, lambda log, _: log.unlink())
    assert code == exit_codes.VERDICT_FAILED and summary["tick_count"] > 0
    assert f"hilrunner: {ring.LOG_LACKS_TEXTS[0]}" in told
    assert any("is gone from its place" in text for text in summary["verdict"]["causes"])


def test_a_run_whose_recorder_dies_says_so_at_once(tmp_path):
    def kill(log, children):
        for pid in children:
            os.kill(pid, signal.SIGKILL)

    code, summary, told = run_with(tmp_path, kill)
    assert code == exit_codes.VERDICT_FAILED
    assert "hilrunner: the recorder has ended" in told
    assert summary["tick_count"] > 0 and summary["recorder"]["error"]
