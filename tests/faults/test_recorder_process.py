"""The recorder process against what can happen to it, to the runner and to the disk."""

import contextlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import mcap_doctor
import numpy as np
import pytest
from recorder_producer import ring_shape, start

from hilrunner.base import records, ring, status
from hilrunner.base.errors import LogError
from hilrunner.record import config as recorder_config
from hilrunner.record import launch

PRODUCER = Path(__file__).with_name("recorder_producer.py")
ROOT = Path(__file__).resolve().parents[2]


def ticks_in(found) -> np.ndarray:
    return np.array([int.from_bytes(data[4:12], "little") for *_, data in found.messages["/rt/tick"]], np.int64)


def wait_gone(pid: int, timeout_s: float = 30.0) -> None:
    fd = os.pidfd_open(pid) if Path(f"/proc/{pid}").exists() else None
    if fd is not None:
        import select

        assert select.select([fd], [], [], timeout_s)[0], "the recorder did not end"
        os.close(fd)


class Runner:
    """The producer as a process of its own, to be killed; the ring can be looked at from here, also afterwards."""

    def __init__(self, folder: Path, prefix: tuple[str, ...] = (), **words) -> None:
        self.shape = ring_shape(**words.get("shape", {}))
        self.log_path = Path(words.setdefault("log_path", str(folder / "run.mcap")))
        (folder / "config.json").write_text(json.dumps({"duration_s": 60.0, **words}))
        self.process = subprocess.Popen(
            [*prefix, sys.executable, str(PRODUCER), str(folder / "config.json")],
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            text=True,
        )
        word, pid, fd = self.process.stdout.readline().split()
        assert word == "ready"
        self.recorder_pid = int(pid)
        copy = os.open(f"/proc/{self.process.pid}/fd/{fd}", os.O_RDWR)
        self.block, self.ring = launch.attach_ring(copy, self.shape)

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()


@pytest.mark.parametrize("seed", range(4))
def test_a_killed_runner_leaves_a_finished_log_with_every_tick(tmp_path, seed):
    runner = Runner(tmp_path, period_ns=500_000)
    time.sleep(random.Random(seed).uniform(0.0, 1.5) if seed else 0.0)
    runner.kill()
    published = ring.word(runner.ring, ring.WORD_TICK_WRITTEN)
    wait_gone(runner.recorder_pid)
    found = mcap_doctor.examine(runner.log_path)
    assert found.faults == [] and found.has_summary
    assert ticks_in(found).tolist() == list(range(published))
    assert dict(found.metadata)["run"]["exit_reason"] == "runner killed"
    assert "runner killed" in found.messages["/log"][-1][3].decode(errors="replace")


def test_signals_do_not_end_the_recorder(tmp_path):
    block, producer, handle = start(tmp_path / "a.mcap")
    handle.wait_ready()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        producer.publish(100)
        handle.process.send_signal(number)
        time.sleep(0.1)
    assert handle.poll() is None
    producer.end(status.EXIT_SIGNAL)
    summary = handle.finish()
    assert summary["exit_reason"] == "stopped by signal"
    assert ticks_in(mcap_doctor.examine(tmp_path / "a.mcap")).tolist() == list(range(300))


def test_summary_and_metadata_tell_the_run(tmp_path):
    settings = {"attachments": [recorder_config.Attachment("profile.toml", "application/toml", text="a = 1")]}
    block, producer, handle = start(tmp_path / "a.mcap", ring_shape(axis_count=2), **settings)
    handle.wait_ready()
    producer.publish(1500)
    producer.publish_miss(700, 250_000)
    producer.store(ring.WORD_MISS_TOTAL, 1)
    producer.ring.frame_count[0, status.FRAME_VALID] = 1500
    producer.ring.frame_count[2, status.FRAME_UNKNOWN_ID] = 3
    producer.ring.histogram[0, 40] = 1500
    producer.ring.extreme[0] = (40, 40, 60_000, 1500)
    producer.end()
    summary = handle.finish()
    assert summary["error"] is None
    assert summary["tick_count"] == 1500 and summary["last_tick"] == 1499
    assert summary["messages"]["/axis_2/state"] == 1500 and summary["messages"]["/can/tx"] == 4500
    assert summary["messages"]["/rt/miss"] == 1
    assert summary["frames"] == {"axis_1.valid": "1500", "none.unknown id": "3"}
    assert summary["size_bytes"] == os.path.getsize(tmp_path / "a.mcap")
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == []
    assert found.metadata[0] == ("run", {"profile": "test"})
    tables = dict(found.metadata)
    assert tables["run"]["profile"] == "test" and tables["run"]["tick_count"] == "1500"
    assert tables["host"] == {"mode": "simulated clock"}
    assert found.attachments["profile.toml"] == b"a = 1"
    histograms = json.loads(found.attachments["rt_histograms.json"])
    assert histograms["wake_lateness"] == {"extreme": [40, 40, 60_000, 1500], "buckets": [[40, 1500]]}
    last = np.frombuffer(b"\0" * 4 + found.messages["/rt/statistics"][-1][3], records.STATISTICS)[0]
    assert (last["tick"], last["tick_count"], last["miss_count"]) == (1499, 1500, 1)
    assert last["wake_lateness_ns_p50"] == last["wake_lateness_ns_max"] == 40


def test_a_full_ring_is_counted_and_told_and_the_rest_is_there(tmp_path):
    block, producer, handle = start(tmp_path / "a.mcap", ring_shape(tick_capacity=1024))
    handle.wait_ready()
    producer.publish_all(2000)
    while producer.word(ring.WORD_TICK_READ) < 2000:
        time.sleep(0.005)
    handle.process.send_signal(signal.SIGSTOP)
    while Path(f"/proc/{handle.process.pid}/stat").read_text().rpartition(")")[2].split()[0] != "T":
        time.sleep(0.005)
    for _ in range(20):
        producer.publish(100)
    dropped = producer.word(ring.WORD_TICK_DROPPED)
    assert dropped == 2000 - 1024
    handle.process.send_signal(signal.SIGCONT)
    while producer.word(ring.WORD_TICK_READ) < 2000 + 1024:
        time.sleep(0.005)
    producer.publish_all(3000)
    producer.end()
    summary = handle.finish()
    assert summary["dropped_ticks"] == dropped
    assert summary["dropped_frames"] == 4 * dropped
    assert summary["ring_fill_ratio_max"] == 1.0
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == []
    assert ticks_in(found).tolist() == [*range(3024), *range(4000, 7000)]
    assert any(b"976 ticks dropped" in data for *_, data in found.messages["/log"])
    assert dict(found.metadata)["run"]["dropped_ticks"] == "976"


def test_ticks_are_whole_where_the_ring_wraps(tmp_path):
    block, producer, handle = start(tmp_path / "a.mcap", ring_shape(axis_count=3, tick_capacity=256))
    handle.wait_ready()
    producer.publish_all(1200, batch=97)
    producer.end()
    handle.finish()
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == []
    assert ticks_in(found).tolist() == list(range(1200))
    for axis in range(3):
        rows = np.frombuffer(
            b"".join(b"\0" * 4 + data for *_, data in found.messages[f"/axis_{axis + 1}/command"]), records.COMMAND
        )
        assert (rows["tick"] == np.arange(1200)).all()
        assert (rows["valve_command"] == np.sin(np.arange(1200) * 1e-3 + axis)).all()


def test_a_file_size_limit_in_the_middle_of_the_run(tmp_path):
    """A real refusal by the kernel (EFBIG): the run goes on, the log ends readable, the loss is counted and told."""
    block, producer, handle = start(tmp_path / "a.mcap", ring_shape(tick_capacity=1024))
    handle.wait_ready()
    _, hard_limit = resource.prlimit(handle.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(handle.process.pid, resource.RLIMIT_FSIZE, (900_000, hard_limit))
    producer.publish_all(12_000)
    producer.end()
    summary = handle.finish()
    assert_loss_told(tmp_path / "a.mcap", producer, summary, 12_000)


def assert_loss_told(path, producer, summary, published: int) -> None:
    found = mcap_doctor.examine(path)
    assert [fault for fault in found.faults if "sequence gap" not in fault] == [] and found.has_summary
    assert any(b"disk refused" in data for *_, data in found.messages["/log"])
    kept = ticks_in(found)
    assert 0 < len(kept) < published
    assert kept[0] == 0 and (np.diff(kept) > 0).all()
    assert summary["tick_count"] == published and summary["exit_reason"] == "duration reached"
    assert summary["lost_bytes"] > 0
    told = summary["messages"]
    own = told["/rt/statistics"] + told["/log"]
    # a chunk that is lost may hold statistics and events, too
    assert 0 <= summary["lost_messages"] + sum(told.values()) - own - 7 * published <= 10
    assert told["/axis_1/state"] == told["/axis_1/command"] == len(kept)
    assert summary["messages"]["/rt/tick"] == len(kept)
    if producer is not None:
        assert producer.word(ring.WORD_RECORDER_LOST_BYTES) == summary["lost_bytes"]


def test_a_full_disk_under_the_log(tmp_path):
    """A real file system of 1 MiB, filled by the run itself."""
    (tmp_path / "disk").mkdir()
    mount = f'mount -t tmpfs -o size=1m tmpfs "{tmp_path}/disk" && "$@" && cp "{tmp_path}/disk/run.mcap" "{tmp_path}"'
    unshare = ["unshare", "--mount"] if os.geteuid() == 0 else ["unshare", "--user", "--map-root-user", "--mount"]
    config = {"log_path": f"{tmp_path}/disk/run.mcap", "duration_s": 2.0, "period_ns": 100_000, "sleep_s": 0.01}
    (tmp_path / "config.json").write_text(json.dumps({**config, "shape": {"tick_capacity": 16384}}))
    done = subprocess.run(
        [*unshare, "sh", "-c", mount, "sh", sys.executable, str(PRODUCER), str(tmp_path / "config.json")],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert_loss_told(tmp_path / "run.mcap", None, summary, summary["published_ticks"])


def test_a_killed_recorder_leaves_whole_chunks_and_the_run_is_told(tmp_path):
    block, producer, handle = start(tmp_path / "a.mcap")
    handle.wait_ready()
    begin_s = time.monotonic()
    while time.monotonic() - begin_s < 1.6:  # a flush happens once a second
        producer.publish(5)
        time.sleep(0.01)
    handle.process.kill()
    handle.process.wait()
    assert handle.poll() is not None
    error = handle.finish()["error"]
    assert "ended with code -9" in error[1]
    sys.path.insert(0, str(ROOT))
    from mcap.stream_reader import StreamReader

    data = (tmp_path / "a.mcap").read_bytes()
    chunks = 0
    with open(tmp_path / "a.mcap", "rb") as file, contextlib.suppress(Exception):
        for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
            chunks += type(record).__name__ == "Chunk"
    assert chunks >= 1 and len(data) > 1000


def test_an_unwritable_folder_refuses_the_run(tmp_path):
    block, producer, handle = start(tmp_path / "missing" / "a.mcap")
    with pytest.raises(LogError) as caught:
        handle.wait_ready()
    assert str(tmp_path / "missing") in str(caught.value) and "No such file or directory" in str(caught.value)
    assert caught.value.remedy
    assert producer.word(ring.WORD_RECORDER_READY) == launch.READY_REFUSED
    assert handle.process.poll() == 2


def test_a_missing_attachment_refuses_the_run(tmp_path):
    one = recorder_config.Attachment("model.onnx", "application/octet-stream", path=str(tmp_path / "model.onnx"))
    block, producer, handle = start(tmp_path / "a.mcap", attachments=[one])
    with pytest.raises(LogError, match=r"model\.onnx"):
        handle.wait_ready()


def test_without_a_log_the_ring_is_drained_all_the_same(tmp_path):
    block, producer, handle = start(None, ring_shape(tick_capacity=256))
    handle.wait_ready()
    producer.publish_all(1000, batch=100)
    producer.end()
    summary = handle.finish()
    assert (summary["tick_count"], summary["dropped_ticks"], summary["log_path"]) == (1000, 0, None)


def test_a_runner_that_dies_before_it_says_anything(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "hilrunner.record"], stdin=subprocess.DEVNULL, cwd=ROOT, capture_output=True, timeout=30
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


def test_a_runner_that_died_before_the_recorder_looked(tmp_path):
    """The recorder's parent is not the process it was told to watch: the runner is gone already."""
    shape = ring_shape()
    block, block_ring = launch.create_ring(shape)
    gone = subprocess.Popen(["true"])
    gone.wait()
    settings = recorder_config.RecorderConfig(
        block.fd, list(shape), ["a"], 1_000_000, gone.pid, str(tmp_path / "a.mcap")
    )
    handle = launch.start_recorder(settings, block_ring)
    assert handle.finish()["exit_reason"] == "runner killed"
    assert mcap_doctor.examine(tmp_path / "a.mcap").faults == []


def test_the_recorder_leaves_real_time_scheduling_behind(tmp_path):
    cpu = min(os.sched_getaffinity(0))
    block, producer, handle = start(tmp_path / "a.mcap", cpus=[cpu])
    handle.wait_ready()
    assert os.sched_getscheduler(handle.process.pid) == os.SCHED_OTHER
    assert os.sched_getaffinity(handle.process.pid) == {cpu}
    producer.end()
    handle.finish()


def test_a_foreign_block_is_refused():
    shape = ring_shape()
    fd = os.memfd_create("foreign")
    os.ftruncate(fd, 100)
    with pytest.raises(LogError, match="100 bytes"):
        launch.attach_ring(fd, shape)
    os.ftruncate(fd, ring.size_bytes(shape))
    with pytest.raises(LogError, match="no ring"):
        launch.attach_ring(fd, shape)
