"""The cause of a miss: each rule by its own table row, and the kernel's counters on this thread."""

import mmap
import os

import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.base.records import PHASE_WAKE
from hilrunner.realtime import miss

US = 1_000
QUIET = dict(wake=5 * US, carried=0, phases=(1, 1, 5, 4, 2), usage={}, frames=1, late=True, dropped=False)
# name, what differs from a quiet tick, longest part, cause
TABLE = [
    ("late timer", dict(wake=900 * US), PHASE_WAKE, status.CAUSE_LATE_WAKE),
    ("waited for another task", dict(wake=900 * US, usage={"delay": 700 * US}), PHASE_WAKE, status.CAUSE_PREEMPTED),
    ("waited a little", dict(wake=900 * US, usage={"delay": 100 * US}), PHASE_WAKE, status.CAUSE_LATE_WAKE),
    ("moved while asleep", dict(wake=900 * US, usage={"cpu": 1}), PHASE_WAKE, status.CAUSE_MIGRATED),
    ("fault explains no late timer", dict(wake=900 * US, usage={"minor": 3}), PHASE_WAKE, status.CAUSE_LATE_WAKE),
    ("major fault in the step", dict(phases=(1, 1, 900, 4, 2), usage={"major": 1}), status.PHASE_STEP, status.CAUSE_PAGE_FAULT),
    ("minor faults in the step", dict(phases=(1, 1, 900, 4, 2), usage={"minor": 9}), status.PHASE_STEP, status.CAUSE_PAGE_FAULT),
    ("one minor fault is no excuse for so much", dict(phases=(1, 1, 900, 4, 2), usage={"minor": 1}), status.PHASE_STEP, status.CAUSE_STEP),
    ("a minor fault that slept", dict(phases=(1, 1, 900, 4, 2), usage={"minor": 1, "voluntary": 2}), status.PHASE_STEP, status.CAUSE_PAGE_FAULT),
    ("switched out in the step", dict(phases=(1, 1, 900, 4, 2), usage={"delay": 800 * US, "minor": 1}), status.PHASE_STEP, status.CAUSE_PREEMPTED),
    ("step alone", dict(phases=(1, 1, 900, 4, 2)), status.PHASE_STEP, status.CAUSE_STEP),
    ("burst, receive", dict(phases=(900, 400, 5, 4, 2), frames=1000), status.PHASE_RECEIVE, status.CAUSE_FRAME_BURST),
    ("burst, record", dict(phases=(300, 400, 5, 4, 900), frames=1000), status.PHASE_RECORD, status.CAUSE_FRAME_BURST),
    ("burst is no excuse for the step", dict(phases=(1, 1, 900, 4, 2), frames=1000), status.PHASE_STEP, status.CAUSE_STEP),
    ("send blocked", dict(phases=(1, 1, 5, 900, 2)), status.PHASE_ENCODE, status.CAUSE_SEND),
    ("ring full, on time", dict(late=False, dropped=True), status.PHASE_RECORD, status.CAUSE_RECORDER),
    ("ring full, late in record", dict(phases=(1, 1, 5, 4, 900), dropped=True), status.PHASE_RECORD, status.CAUSE_RECORDER),
    ("late in receive without a reason", dict(phases=(900, 1, 5, 4, 2)), status.PHASE_RECEIVE, status.CAUSE_UNKNOWN),
    ("no schedstat, switched out", dict(phases=(900, 1, 5, 4, 2), usage={"delay": None, "involuntary": 2}), status.PHASE_RECEIVE, status.CAUSE_PREEMPTED),
    ("late from the tick before", dict(wake=900 * US, carried=880 * US), PHASE_WAKE, status.CAUSE_CARRIED_OVER),
    ("late from before, but the step is worse", dict(wake=300 * US, carried=290 * US, phases=(1, 1, 900, 4, 2)), status.PHASE_STEP, status.CAUSE_STEP),
    ("no schedstat, late timer", dict(wake=900 * US, usage={"delay": None}), PHASE_WAKE, status.CAUSE_LATE_WAKE),
]  # fmt: skip


def _usage(changes: dict) -> tuple[np.ndarray, np.ndarray]:
    before = np.array([10, 2, 100, 5, 0, 1_000_000], np.int64)
    after = before.copy()
    for name, place in (("minor", 0), ("major", 1), ("voluntary", 2), ("involuntary", 3), ("cpu", 4), ("delay", 5)):
        if name in changes and changes[name] is not None:
            after[place] += changes[name]
    if "delay" in changes and changes["delay"] is None:
        before[5] = after[5] = -1
    return before, after


@pytest.mark.parametrize("name, changes, part, cause", TABLE, ids=[row[0] for row in TABLE])
def test_cause_table(name, changes, part, cause):
    tick = QUIET | changes
    before, after = _usage(tick["usage"])
    phase_ns = np.array(tick["phases"], np.int64) * US
    found = miss.suspect_cause(
        tick["wake"], tick["carried"], phase_ns, before, after, tick["frames"], 100, tick["late"], tick["dropped"]
    )
    assert (part, status.CAUSE_NAMES[cause]) == (found[0], status.CAUSE_NAMES[found[1]])


def _read(fd: int) -> np.ndarray:
    rusage, text, usage, _ = miss.make_usage_scratch()
    miss.read_usage(fd, rusage, text, usage)
    return usage


def test_touching_fresh_pages_counts_as_page_faults():
    pages = 64
    _read(miss.NO_SCHEDSTAT)  # compile
    before = _read(miss.NO_SCHEDSTAT)
    with mmap.mmap(-1, pages * mmap.PAGESIZE) as fresh:
        if hasattr(mmap, "MADV_NOHUGEPAGE"):
            fresh.madvise(mmap.MADV_NOHUGEPAGE)
        for page in range(pages):
            fresh[page * mmap.PAGESIZE] = 1
    after = _read(miss.NO_SCHEDSTAT)
    assert after[miss.USAGE_FAULTS_MINOR] - before[miss.USAGE_FAULTS_MINOR] >= pages


def test_core_is_the_one_the_thread_is_bound_to():
    allowed = os.sched_getaffinity(0)
    try:
        for cpu in allowed:
            os.sched_setaffinity(0, {cpu})
            assert _read(miss.NO_SCHEDSTAT)[miss.USAGE_CPU] == cpu
    finally:
        os.sched_setaffinity(0, allowed)


def test_run_queue_delay_is_what_the_kernel_prints():
    fd = miss.open_schedstat()
    try:
        first = _read(fd)[miss.USAGE_RUN_DELAY_NS]
        with open("/proc/thread-self/schedstat") as file:
            printed = int(file.read().split()[1])
        last = _read(fd)[miss.USAGE_RUN_DELAY_NS]
        assert first <= printed <= last
    finally:
        os.close(fd)


@pytest.mark.parametrize("text, expected", [(b"12 345 6\n", 345), (b"0 0 1\n", 0), (b"7", 0), (b"", -1)])
def test_schedstat_text(tmp_path, text, expected):
    path = tmp_path / "schedstat"
    path.write_bytes(text)
    fd = os.open(path, os.O_RDONLY)
    try:
        assert _read(fd)[miss.USAGE_RUN_DELAY_NS] == expected
    finally:
        os.close(fd)


def test_closed_descriptor_gives_no_delay():
    fd = miss.open_schedstat()
    os.close(fd)
    assert _read(fd)[miss.USAGE_RUN_DELAY_NS] == -1
