"""Is this host fit for real time, what did it grant, and what may a run call itself?

`inspect_host` reads and tries, `enter_realtime` asks, `mode_label` says it in three words that never flatter:

- `simulated clock`: no wall clock was involved;
- `real-time verified`: every right that was asked for was granted, no finding fails, the kernel is fully preemptible and
  no hypervisor can take the core, the worst tried wake-up stayed within a tenth of the period, and no tick was late;
- `best effort`: everything else, with the reasons.
"""

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from hilrunner.base.errors import RealtimeRefusedError
from hilrunner.base.units import NS_PER_MS
from hilrunner.setup import host_can, host_cpu, host_kernel, host_probe
from hilrunner.setup.host_can import FrameTraffic, bus_load_ratio
from hilrunner.setup.host_rights import RealtimeOptions, enter_realtime, leave_realtime, rights_findings
from hilrunner.setup.host_words import FAIL, OK, Finding, Grant, HostFiles

__all__ = [
    "Finding",
    "FrameTraffic",
    "Grant",
    "HostReport",
    "RealtimeOptions",
    "bus_load_ratio",
    "enter_realtime",
    "inspect_host",
    "leave_realtime",
    "mode_label",
    "mode_reasons",
    "require_realtime",
]

LABEL_VERIFIED = "real-time verified"
LABEL_BEST_EFFORT = "best effort"
LABEL_SIMULATED = "simulated clock"

WAKE_UP, WAKE_UP_DISTURBED = "wake-up (tried)", "wake-up, disturbed (tried)"
# A warning of these alone already forbids the word "verified".
_DECISIVE = ("kernel preemption", "virtual machine", WAKE_UP, WAKE_UP_DISTURBED)


@dataclass(frozen=True)
class HostReport:
    """What was found: findings in order of inspection, facts (kernel, processor, versions) as text."""

    findings: tuple[Finding, ...]
    facts: dict[str, str]

    def as_dict(self) -> dict:
        """For JSON and the log's metadata."""
        return {"facts": self.facts, "findings": [finding.as_dict() for finding in self.findings]}


def host_facts(files: HostFiles) -> dict[str, str]:
    """Kernel, processor, memory and the versions that decide how fast compiled code is."""
    model = ""
    for line in (files.text("proc/cpuinfo") or "").splitlines():
        if line.split(":")[0].strip() in ("model name", "Processor", "cpu model", "host"):
            model = line.split(":", 1)[1].strip()
            break
    memory_kib = next(
        (
            int(line.split()[1])
            for line in (files.text("proc/meminfo") or "").splitlines()
            if line.startswith("MemTotal:")
        ),
        0,
    )
    return {
        "kernel": f"{platform.release()} {platform.version()}",
        "machine": platform.machine(),
        "processor": model or "not told",
        "cores": str(len(host_cpu.online(files))),
        "memory": f"{memory_kib / 2**20:.1f} GiB",
        "mitigations": "off" if "mitigations=off" in (files.text("proc/cmdline") or "") else "as built",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
    }


def inspect_host(
    interface: str | None = None,
    *,
    cpu: int | None = None,
    period_ns: int = NS_PER_MS,
    traffic: Sequence[FrameTraffic] = (),
    bitrate: int = 0,
    probe_s: float = 0.2,
    disturb: bool = False,
    files: HostFiles | None = None,
) -> HostReport:
    """Look at everything that decides the loop's timing.

    Args:
        interface: CAN interface to look at; None: none.
        cpu: the loop's core; None: the one this thread is bound to, else the best there is.
        period_ns: period the tried wake-ups are judged by.
        traffic, bitrate: frames of the profile and the bit rate in bit/s, for the bus load; empty or 0: none.
        probe_s: duration of the tried wake-ups on the calling thread, s; 0: not tried. Call after `enter_realtime`,
            otherwise it shows what a thread without rights gets.
        disturb: try once more beside a task that keeps the kernel busy on the same core.
        files: the kernel's files; tests bring their own.
    """
    files = files or HostFiles()
    allowed = os.sched_getaffinity(0)
    cpu = cpu if cpu is not None and cpu >= 0 else host_cpu.suggest_cpu(files, allowed)
    findings = [
        host_kernel.preemption(files),
        host_kernel.throttling(files),
        host_kernel.clocksource(files),
        host_kernel.virtual_machine(files),
        host_cpu.core_count(files),
        host_cpu.governor(files, cpu),
        host_cpu.idle_states(files, cpu),
        host_cpu.siblings(files, cpu),
        host_cpu.isolation(files, cpu),
        host_cpu.interrupts(files, cpu),
        *host_kernel.memory(files),
        *rights_findings(files),
    ]
    if interface is not None:
        findings += host_can.interface_findings(files, interface)
    if traffic and bitrate > 0:
        findings.append(host_can.load_finding(traffic, bitrate))
    if probe_s > 0:
        findings += _tried(period_ns, probe_s, disturb, cpu)
    return HostReport(tuple(findings), host_facts(files))


def _tried(period_ns: int, probe_s: float, disturb: bool, cpu: int) -> list[Finding]:
    probe = host_probe.probe_wake_up(period_ns, probe_s)
    found = [host_probe.clock_finding(probe), host_probe.wake_finding(WAKE_UP, probe, period_ns)]
    if disturb:
        with host_probe.disturbed(cpu):
            probe = host_probe.probe_wake_up(period_ns, probe_s)
        found.append(host_probe.wake_finding(WAKE_UP_DISTURBED, probe, period_ns))
    return found


def mode_reasons(grants: Sequence[Grant], findings: Sequence[Finding], late_ticks: int = 0) -> list[str]:
    """Everything that keeps a run from being called real-time verified; empty if nothing does."""
    reasons = [
        f"{grant.name}: {grant.reason or 'not granted'}" for grant in grants if grant.required and not grant.granted
    ]
    asked = {grant.name for grant in grants}
    reasons += [f"{name}: not asked for" for name in ("scheduling", "memory lock") if name not in asked]
    reasons += [
        f"{finding.name}: {finding.value}"
        for finding in findings
        if finding.verdict == FAIL or (finding.name in _DECISIVE and finding.verdict != OK)
    ]
    if not any(finding.name == WAKE_UP for finding in findings):
        reasons.append("wake-up: not tried")
    idle = [grant for grant in grants if grant.name == "idle states" and grant.granted]
    deep = [finding for finding in findings if finding.name == "idle states" and finding.verdict != OK]
    if deep and not idle:
        reasons.append(f"idle states: {deep[0].value}, and no limit held")
    if late_ticks:
        reasons.append(f"{late_ticks} ticks were late")
    return reasons


def mode_label(
    grants: Sequence[Grant], findings: Sequence[Finding], simulated_clock: bool = False, late_ticks: int = 0
) -> str:
    """`real-time verified`, `best effort` or `simulated clock`; in doubt the lesser one (see `mode_reasons`)."""
    if simulated_clock:
        return LABEL_SIMULATED
    return LABEL_BEST_EFFORT if mode_reasons(grants, findings, late_ticks) else LABEL_VERIFIED


def require_realtime(grants: Sequence[Grant], findings: Sequence[Finding]) -> None:
    """Refuse to run when the host is not what --require-realtime asks for.

    Raises:
        RealtimeRefusedError: names every reason (exit code 6).
    """
    reasons = mode_reasons(grants, findings)
    if reasons:
        raise RealtimeRefusedError(
            "--require-realtime",
            "; ".join(reasons),
            remedy="`hilrunner doctor` names the remedy of each; without --require-realtime the run is best effort",
        )
