"""The disk under the log fails: at the n-th write, for every n; half a write; for good or for a while."""

import errno
import os

import mcap_doctor
import pytest
from recorder_producer import START_MONO_NS, START_REAL_NS, periods

from hilrunner.base.errors import LogError
from hilrunner.record import mcap_file
from hilrunner.record.mcap_log import LogWriter

CHUNKS = 6
TICKS_A_CHUNK = 20
HEAD_WRITES = 1 + 8 + 9 + 1 + 1  # header, schemas, channels, metadata, seal


class Disk:
    """os.write that refuses some calls, after taking the first bytes of one."""

    def __init__(self, monkeypatch, refuses, code=errno.ENOSPC, partial_bytes=0):
        self.calls = 0
        self.refuses = refuses
        self.code = code
        self.partial_bytes = partial_bytes
        self._write = os.write
        monkeypatch.setattr(mcap_file.os, "write", self.write)

    def write(self, fd, data):
        self.calls += 1
        if not self.refuses(self.calls, len(data)):
            return self._write(fd, data)
        if self.partial_bytes:
            self._write(fd, data[: self.partial_bytes])
        raise OSError(self.code, os.strerror(self.code))


def write_run(path) -> LogWriter:
    log = LogWriter(path, ["boom"], metadata={"run": {"profile": "x"}})
    for first in range(0, CHUNKS * TICKS_A_CHUNK, TICKS_A_CHUNK):
        tick, command, state, _ = periods(first, TICKS_A_CHUNK, 1, 1_000_000)
        log.write_ticks(tick, command, state, START_MONO_NS, START_REAL_NS)
        log.flush()
    log.close({"run": {"profile": "x", "exit_reason": "duration reached"}})
    return log


def ticks_in(found) -> list[int]:
    return [int.from_bytes(data[4:12], "little") for *_, data in found.messages["/rt/tick"]]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EIO])
@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_one_refused_chunk_costs_that_chunk_only(tmp_path, monkeypatch, chunk, code):
    Disk(monkeypatch, lambda call, _: call == HEAD_WRITES + 1 + chunk, code, partial_bytes=57)
    log = write_run(tmp_path / "a.mcap")
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert [fault for fault in found.faults if "sequence gap" not in fault] == []
    missing = set(range(chunk * TICKS_A_CHUNK, (chunk + 1) * TICKS_A_CHUNK))
    assert ticks_in(found) == [tick for tick in range(CHUNKS * TICKS_A_CHUNK) if tick not in missing]
    assert log.lost_messages == 3 * TICKS_A_CHUNK
    assert log.lost_bytes > 0
    assert log.message_counts()["/rt/tick"] == (CHUNKS - 1) * TICKS_A_CHUNK


@pytest.mark.parametrize("chunk", range(1, CHUNKS))
def test_a_disk_full_from_some_chunk_on_leaves_a_finished_log(tmp_path, monkeypatch, chunk):
    """Nothing more fits, not even the ending: the ending takes the place of the newest chunks."""
    full_from = HEAD_WRITES + 1 + chunk
    disk = {}

    def refuses(call, size_bytes):
        there = os.path.getsize(tmp_path / "a.mcap")
        if call == full_from:
            disk["limit"] = there + 31
        return call >= full_from and there + size_bytes > disk["limit"]

    Disk(monkeypatch, refuses, partial_bytes=31)
    log = write_run(tmp_path / "a.mcap")
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == []
    kept = ticks_in(found)
    assert kept == list(range(len(kept)))
    assert len(kept) >= (chunk - 3) * TICKS_A_CHUNK
    assert log.lost_messages == 3 * (CHUNKS * TICKS_A_CHUNK - len(kept))
    assert os.path.getsize(tmp_path / "a.mcap") <= disk["limit"]


def test_room_for_the_ending_is_kept_while_the_disk_fills(tmp_path, monkeypatch):
    """The file system has 160 kB for us: chunks stop early enough that nothing has to be taken back."""
    room_bytes = 160_000

    class Libc:
        @staticmethod
        def fallocate(fd, mode, offset, length):
            assert mode == mcap_file.FALLOC_FL_KEEP_SIZE
            if offset + length <= room_bytes:
                return 0
            mcap_file.ctypes.set_errno(errno.ENOSPC)
            return -1

    monkeypatch.setattr(mcap_file, "_libc", Libc)
    log = LogWriter(tmp_path / "a.mcap", ["boom"])
    for first in range(0, 4000, 50):
        tick, command, state, _ = periods(first, 50, 1, 1_000_000)
        log.write_ticks(tick, command, state, START_MONO_NS, START_REAL_NS)
        log.flush()
    kept_before_close = log.message_counts()["/rt/tick"]
    log.close()
    found = mcap_doctor.examine(tmp_path / "a.mcap")
    assert found.faults == [] and found.has_summary
    assert len(ticks_in(found)) == kept_before_close
    assert 500 < kept_before_close < 4000
    assert os.path.getsize(tmp_path / "a.mcap") <= room_bytes


def test_a_file_system_that_cannot_allocate_ahead_still_records(tmp_path, monkeypatch):
    class Libc:
        @staticmethod
        def fallocate(*_):
            mcap_file.ctypes.set_errno(errno.EOPNOTSUPP)
            return -1

    monkeypatch.setattr(mcap_file, "_libc", Libc)
    log = write_run(tmp_path / "a.mcap")
    assert log.lost_bytes == 0
    assert ticks_in(mcap_doctor.examine(tmp_path / "a.mcap")) == list(range(CHUNKS * TICKS_A_CHUNK))


@pytest.mark.parametrize("call", range(1, HEAD_WRITES + 1))
def test_a_disk_that_refuses_the_head_of_the_log(tmp_path, monkeypatch, call):
    """Before tick 0 a refusal is an error; the loop has not started yet."""
    Disk(monkeypatch, lambda number, _: number == call)
    with pytest.raises(LogError, match="no space left"):
        write_run(tmp_path / "a.mcap")


def test_nothing_is_left_allocated_behind_the_end(tmp_path):
    log = write_run(tmp_path / "a.mcap")
    status = os.stat(log.path)
    assert status.st_blocks * 512 < status.st_size + 64 * 1024
