"""Grants: each is asked, read back and given back; each refusal carries its reason. And the label that never flatters."""

import ctypes
import gc
import os
import resource

import numpy as np
import pytest

from hilrunner.base import exit_codes
from hilrunner.base.errors import RealtimeRefusedError
from hilrunner.setup import host, host_probe, host_rights
from hilrunner.setup.host_words import FAIL, OK, WARN, Finding, Grant, HostFiles

NOTHING = host.RealtimeOptions(priority=0, cpu=-1, lock_memory=False, cpu_dma_latency_us=-1, disable_gc=False)


def _ask(tmp_path, **changes):
    from dataclasses import replace

    latency_file = tmp_path / "cpu_dma_latency"
    latency_file.touch()
    return host_rights.enter_realtime(replace(NOTHING, **changes), dma_latency_file=str(latency_file)), latency_file


def _named(grants, name):
    return next(grant for grant in grants if grant.name == name)


def test_timer_slack_is_asked_for_always_and_given_back(tmp_path):
    libc = ctypes.CDLL(None)
    before = libc.prctl(host_rights.PR_GET_TIMERSLACK, 0, 0, 0, 0)
    grants, _ = _ask(tmp_path)
    assert [grant.name for grant in grants] == ["timer slack"]
    assert grants[0].granted and libc.prctl(host_rights.PR_GET_TIMERSLACK, 0, 0, 0, 0) == 1
    host.leave_realtime(grants)
    assert libc.prctl(host_rights.PR_GET_TIMERSLACK, 0, 0, 0, 0) == before


def test_collector_off_and_on_again(tmp_path):
    grants, _ = _ask(tmp_path, disable_gc=True)
    assert not gc.isenabled() and _named(grants, "garbage collector").granted
    host.leave_realtime(grants)
    assert gc.isenabled() and gc.get_freeze_count() == 0


def test_core_is_bound_and_released(tmp_path):
    before = os.sched_getaffinity(0)
    grants, _ = _ask(tmp_path, cpu=min(before))
    assert os.sched_getaffinity(0) == {min(before)} and _named(grants, "core").granted
    host.leave_realtime(grants)
    assert os.sched_getaffinity(0) == before


def test_a_core_that_is_not_there_is_refused_with_those_that_are(tmp_path):
    grants, _ = _ask(tmp_path, cpu=1023)
    refused = _named(grants, "core")
    assert not refused.granted and "Invalid argument" in refused.reason
    assert str(min(os.sched_getaffinity(0))) in refused.remedy
    host.leave_realtime(grants)


def test_idle_limit_is_written_and_held_open(tmp_path):
    grants, latency_file = _ask(tmp_path, cpu_dma_latency_us=7)
    assert latency_file.read_bytes() == (7).to_bytes(4, "little")
    held = [os.readlink(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd") if _exists(name)]
    assert str(latency_file) in held
    host.leave_realtime(grants)
    held = [os.readlink(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd") if _exists(name)]
    assert str(latency_file) not in held


def _exists(name: str) -> bool:
    return os.path.islink(f"/proc/self/fd/{name}")


def test_idle_limit_without_the_file_is_refused(tmp_path):
    grants = host_rights.enter_realtime(NOTHING_BUT_IDLE, dma_latency_file=str(tmp_path / "none"))
    refused = _named(grants, "idle states")
    assert not refused.granted and refused.reason == "No such file or directory" and not refused.required
    host.leave_realtime(grants)


NOTHING_BUT_IDLE = host.RealtimeOptions(priority=0, cpu=-1, lock_memory=False, cpu_dma_latency_us=0, disable_gc=False)


def test_memory_is_not_locked_under_a_limit_without_the_capability(tmp_path):
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/status").write_text("CapEff:\t0000000000000000\n")
    soft, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    limited = 65536 if hard == resource.RLIM_INFINITY else min(65536, hard)
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (limited, hard))
    try:
        grant = host_rights._ask_memory_lock(HostFiles(tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (soft, hard))
    assert not grant.granted and "RLIMIT_MEMLOCK is 64 KiB" in grant.reason and "limits.d" in grant.remedy
    assert host_rights.locked_kib(HostFiles()) == 0


def test_impossible_priority_is_refused_and_nothing_changes(tmp_path):
    grants, _ = _ask(tmp_path, priority=500)
    refused = _named(grants, "scheduling")
    assert not refused.granted and "sched_setscheduler" in refused.reason
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
    host.leave_realtime(grants)


def test_priority_is_granted_exactly_when_the_kernel_allows_it(tmp_path):
    allowed = host_rights.has_capability(HostFiles(), host_rights.CAP_SYS_NICE)
    soft = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    grants, _ = _ask(tmp_path, priority=1)
    asked = _named(grants, "scheduling")
    got_fifo = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    host.leave_realtime(grants)
    assert asked.granted == got_fifo
    assert got_fifo or not (allowed and soft)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_capability_bits(tmp_path):
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/status").write_text(f"Name:\tx\nCapEff:\t{1 << 23:016x}\n")
    files = HostFiles(tmp_path)
    assert host_rights.has_capability(files, host_rights.CAP_SYS_NICE)
    assert not host_rights.has_capability(files, host_rights.CAP_IPC_LOCK)


# --- the label ----------------------------------------------------------------------------------------------------

GRANTED = [Grant("scheduling", "SCHED_FIFO 80", "SCHED_FIFO 80", True), Grant("memory lock", "all", "1 MiB", True)]
SOUND = [
    Finding("kernel preemption", "PREEMPT_RT", OK),
    Finding("virtual machine", "no", OK),
    Finding("isolated core", "no", WARN, "x"),
    Finding(host.WAKE_UP, "max 9 us", OK),
]


def _with(name, verdict):
    return [finding for finding in SOUND if finding.name != name] + [Finding(name, "y", verdict, "z")]


def test_verified_only_when_all_is_well():
    assert host.mode_label(GRANTED, SOUND) == "real-time verified"
    host.require_realtime(GRANTED, SOUND)


def test_simulated_clock_whatever_the_host():
    assert host.mode_label(GRANTED, SOUND, simulated_clock=True) == "simulated clock"


REFUSED = Grant("core", "core 3", "any", False, reason="not allowed")
OPTIONAL = Grant("idle states", "0 us", "no limit", False, required=False, reason="no such file")
DEEP = Finding("idle states", "C6, 133 us", WARN, "x")
HELD = Grant("idle states", "0 us", "held", True, required=False)
LABELS = [
    ("a right refused", [*GRANTED, REFUSED], SOUND, 0, "core: not allowed"),
    ("priority not asked for", GRANTED[1:], SOUND, 0, "scheduling: not asked for"),
    ("memory not asked for", GRANTED[:1], SOUND, 0, "memory lock: not asked for"),
    ("not tried", GRANTED, SOUND[:3], 0, "wake-up: not tried"),
    ("tried and slow", GRANTED, _with(host.WAKE_UP, WARN), 0, f"{host.WAKE_UP}: y"),
    ("hypervisor", GRANTED, _with("virtual machine", WARN), 0, "virtual machine: y"),
    ("not fully preemptible", GRANTED, _with("kernel preemption", WARN), 0, "kernel preemption: y"),
    ("anything fails", GRANTED, [*SOUND, Finding("CAN interface", "down", FAIL, "up")], 0, "CAN interface: down"),
    (
        "deep sleep without a limit",
        [*GRANTED, OPTIONAL],
        [*SOUND, DEEP],
        0,
        "idle states: C6, 133 us, and no limit held",
    ),
    ("a late tick", GRANTED, SOUND, 3, "3 ticks were late"),
]


@pytest.mark.parametrize("name, grants, findings, late, reason", LABELS, ids=[row[0] for row in LABELS])
def test_best_effort_and_why(name, grants, findings, late, reason):
    assert host.mode_label(grants, findings, late_ticks=late) == "best effort"
    assert host.mode_reasons(grants, findings, late) == [reason]


def test_deep_idle_states_are_harmless_while_held_off():
    assert host.mode_label([*GRANTED, HELD], [*SOUND, DEEP]) == "real-time verified"


def test_require_realtime_names_every_reason_and_exits_6():
    with pytest.raises(RealtimeRefusedError) as refused:
        host.require_realtime([*GRANTED, REFUSED], _with("virtual machine", WARN))
    assert "core: not allowed" in str(refused.value) and "virtual machine" in str(refused.value)
    assert refused.value.exit_code == exit_codes.REALTIME_REFUSED == 6


# --- trying -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("worst_us, verdict", [(99, OK), (101, WARN), (499, WARN), (500, FAIL)])
def test_wake_ups_are_judged_by_the_worst_against_the_period(worst_us, verdict):
    lateness_ns = np.sort(np.array([1_000] * 99 + [worst_us * 1_000]))
    probe = host_probe.WakeProbe(lateness_ns, "SCHED_FIFO 80", 1, 30.0)
    found = host_probe.wake_finding(host.WAKE_UP, probe, 1_000_000)
    assert found.verdict == verdict and f"max {worst_us}.0 us in 100" in found.value
    assert bool(found.remedy) == (verdict != OK)


def test_probe_wakes_on_the_grid_and_never_early():
    probe = host_probe.probe_wake_up(200_000, 0.02)
    assert probe.lateness_ns.size == 100
    assert probe.lateness_ns[0] >= 0 and np.all(np.diff(probe.lateness_ns) >= 0)
    assert probe.clock_read_ns > 0
    assert probe.quantile_us(1.0) == probe.lateness_ns[-1] / 1000


def test_the_whole_inspection_of_this_host():
    report = host.inspect_host("nosuchcan0", probe_s=0.02)
    words = report.as_dict()
    names = [finding["name"] for finding in words["findings"]]
    assert len(set(names)) == len(names)
    assert {"kernel preemption", "real-time throttling", "clocksource", "virtual machine", "frequency governor"} <= set(
        names
    )
    assert {"idle states", "shared core (SMT)", "isolated core", "interrupt affinity", host.WAKE_UP} <= set(names)
    assert {"real-time priority right", "memory lock right", "CAN interface"} <= set(names)
    assert all(finding["remedy"] for finding in words["findings"] if finding["verdict"] == FAIL)
    assert words["facts"]["kernel"].startswith(os.uname().release)


def test_a_disturber_ends_with_its_block():
    before = set(_children())
    with host_probe.disturbed(min(os.sched_getaffinity(0))):
        started = set(_children()) - before
        assert len(started) == 1
    assert not set(_children()) & started


def _children() -> list[int]:
    with open(f"/proc/self/task/{os.getpid()}/children") as file:
        return [int(word) for word in file.read().split()]
