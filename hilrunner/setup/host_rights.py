"""Asking the kernel for real time, one right at a time: asked, tried, read back, reported. Nothing is assumed granted.

Order (models: cactus-rt `App::Start`, man pages named below): memory first, so that nothing later faults; then core, timer
slack and idle states; priority last, so that a mistake before it cannot hang the machine. Rights belong to the *calling
thread* (memory, idle states and collector: to the process): call on the thread that runs the loop, after everything is
allocated and compiled.
"""

import contextlib
import ctypes
import errno
import gc
import os
import resource
import struct
from dataclasses import dataclass

from hilrunner.setup.host_words import OK, WARN, Finding, Grant, HostFiles
from hilrunner.setup.resources import host_files_folder

CAP_IPC_LOCK = 14  # capabilities(7)
CAP_SYS_NICE = 23
MCL_CURRENT, MCL_FUTURE = 1, 2  # mlockall(2)
PR_SET_TIMERSLACK, PR_GET_TIMERSLACK = 29, 30  # prctl(2)
DMA_LATENCY_FILE = "/dev/cpu_dma_latency"  # Documentation/power/pm_qos_interface.rst: held as long as the file is open

_libc = ctypes.CDLL(None, use_errno=True)
_RIGHTS_REMEDY = (
    f"install {host_files_folder()}/hilrunner-limits.conf in /etc/security/limits.d, join group realtime, log in again; "
    "or use the systemd unit there"
)


@dataclass(frozen=True)
class RealtimeOptions:
    """What a run asks for. priority 0 and cpu -1 ask for nothing; dma latency -1 leaves idle states alone."""

    priority: int = 80
    cpu: int = -1
    lock_memory: bool = True
    cpu_dma_latency_us: int = 0
    disable_gc: bool = True


def has_capability(files: HostFiles, number: int) -> bool:
    """Whether this process holds a capability effectively."""
    for line in (files.text("proc/self/status") or "").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> number & 1)
    return False


def _limit_text(value: int, unit: str = "") -> str:
    return "unlimited" if value == resource.RLIM_INFINITY else f"{value}{unit}"


def rights_findings(files: HostFiles) -> list[Finding]:
    """RLIMIT_RTPRIO, RLIMIT_MEMLOCK and the capabilities that stand above them."""
    found = []
    soft = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    able = has_capability(files, CAP_SYS_NICE)
    value = f"RLIMIT_RTPRIO {_limit_text(soft)}, CAP_SYS_NICE {'yes' if able else 'no'}"
    enough = able or soft == resource.RLIM_INFINITY or soft > 0
    found.append(Finding("real-time priority right", value, OK if enough else WARN, "" if enough else _RIGHTS_REMEDY))
    soft = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    able = has_capability(files, CAP_IPC_LOCK)
    kib = soft if soft == resource.RLIM_INFINITY else soft // 1024
    value = f"RLIMIT_MEMLOCK {_limit_text(kib, ' KiB')}, CAP_IPC_LOCK {'yes' if able else 'no'}"
    enough = able or soft == resource.RLIM_INFINITY
    found.append(Finding("memory lock right", value, OK if enough else WARN, "" if enough else _RIGHTS_REMEDY))
    return found


def locked_kib(files: HostFiles) -> int:
    """Memory of this process that is locked, KiB."""
    for line in (files.text("proc/self/status") or "").splitlines():
        if line.startswith("VmLck:"):
            return int(line.split()[1])
    return 0


def _ask_memory_lock(files: HostFiles) -> Grant:
    name, asked = "memory lock", "all present and future memory"
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit != resource.RLIM_INFINITY and not has_capability(files, CAP_IPC_LOCK):
        # MCL_FUTURE under a limit makes later allocations fail: worse than not locked
        reason = f"RLIMIT_MEMLOCK is {limit // 1024} KiB and CAP_IPC_LOCK is missing"
        return Grant(name, asked, "nothing locked", False, reason=reason, remedy=_RIGHTS_REMEDY)
    if _libc.mlockall(MCL_CURRENT | MCL_FUTURE) != 0:
        reason = os.strerror(ctypes.get_errno())
        return Grant(name, asked, "nothing locked", False, reason=f"mlockall: {reason}", remedy=_RIGHTS_REMEDY)
    got = f"{locked_kib(files) // 1024} MiB locked"
    return Grant(name, asked, got, True, undo=lambda: _libc.munlockall() and None)


def _ask_affinity(cpu: int) -> Grant:
    name, asked = "core", f"core {cpu} only"
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {cpu})
    except (OSError, ValueError, OverflowError) as error:
        reason = f"sched_setaffinity: {getattr(error, 'strerror', None) or error}"
        remedy = f"choose one of {','.join(map(str, sorted(before)))} (taskset, cpuset or container limit the others)"
        return Grant(name, asked, f"any of {sorted(before)}", False, reason=reason, remedy=remedy)
    now = os.sched_getaffinity(0)
    return Grant(name, asked, f"{sorted(now)}", now == {cpu}, undo=lambda: os.sched_setaffinity(0, before))


def _ask_timer_slack() -> Grant:
    """Ordinary threads wake up to 50 us late on purpose (prctl(2)); real-time ones do not, whatever this says."""
    before = _libc.prctl(PR_GET_TIMERSLACK, 0, 0, 0, 0)
    done = _libc.prctl(PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0) == 0
    now = _libc.prctl(PR_GET_TIMERSLACK, 0, 0, 0, 0)
    reason = "" if done else f"prctl: {os.strerror(ctypes.get_errno())}"
    undo = None
    if done and before > 0:

        def undo() -> None:
            _libc.prctl(PR_SET_TIMERSLACK, ctypes.c_ulong(before), 0, 0, 0)

    # a FIFO thread reports slack 0 on recent kernels: as good as the 1 ns asked for
    return Grant("timer slack", "1 ns", f"{now} ns", 0 <= now <= 1, required=False, reason=reason, undo=undo)


def _ask_idle_latency(latency_us: int, path: str) -> Grant:
    name, asked = "idle states", f"wake within {latency_us} us ({path})"
    try:
        fd = os.open(path, os.O_WRONLY | os.O_CLOEXEC)
    except OSError as error:
        remedy = "run as root, or give the group write access to it with a udev rule (docs/realtime.md)"
        return Grant(name, asked, "no limit", False, required=False, reason=error.strerror or "", remedy=remedy)
    try:
        os.write(fd, struct.pack("i", latency_us))
    except OSError as error:
        os.close(fd)
        return Grant(name, asked, "no limit", False, required=False, reason=error.strerror or "")
    return Grant(name, asked, "held for this run", True, required=False, undo=lambda: os.close(fd))


def _ask_priority(priority: int) -> Grant:
    name, asked = "scheduling", f"SCHED_FIFO {priority}"
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        # children (the recorder) start as ordinary tasks
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as error:
        reason = f"sched_setscheduler: {error.strerror}"
        remedy = "priority 1 to 99" if error.errno == errno.EINVAL else _RIGHTS_REMEDY
        return Grant(name, asked, "SCHED_OTHER", False, reason=reason, remedy=remedy)
    got = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    level = os.sched_getparam(0).sched_priority
    text = f"SCHED_FIFO {level}" if got == os.SCHED_FIFO else f"policy {got}"
    return Grant(
        name, asked, text, got == os.SCHED_FIFO and level == priority, undo=lambda: os.sched_setscheduler(0, *before)
    )


def _stop_collector() -> Grant:
    gc.collect()
    gc.freeze()
    was_enabled = gc.isenabled()
    gc.disable()

    def undo() -> None:
        gc.unfreeze()
        if was_enabled:
            gc.enable()

    return Grant("garbage collector", "off", "on" if gc.isenabled() else "off", not gc.isenabled(), undo=undo)


def enter_realtime(
    options: RealtimeOptions, files: HostFiles | None = None, dma_latency_file: str = DMA_LATENCY_FILE
) -> list[Grant]:
    """Ask for everything `options` names, on the calling thread; never raises, every refusal is in the list."""
    files = files or HostFiles()
    grants = []
    if options.disable_gc:
        grants.append(_stop_collector())
    if options.lock_memory:
        grants.append(_ask_memory_lock(files))
    if options.cpu >= 0:
        grants.append(_ask_affinity(options.cpu))
    grants.append(_ask_timer_slack())
    if options.cpu_dma_latency_us >= 0:
        grants.append(_ask_idle_latency(options.cpu_dma_latency_us, dma_latency_file))
    if options.priority > 0:
        grants.append(_ask_priority(options.priority))
    return grants


def leave_realtime(grants: list[Grant]) -> None:
    """Give everything back, last first; on the same thread. The open /dev/cpu_dma_latency is closed here."""
    for grant in reversed(grants):
        if grant.undo is not None:
            with contextlib.suppress(OSError):
                grant.undo()
