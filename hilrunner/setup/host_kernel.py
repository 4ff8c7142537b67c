"""What the kernel is: preemption, throttling of real-time tasks, clock, hypervisor, memory management."""

import gzip
import platform
import re

from hilrunner.setup.host_words import FAIL, OK, WARN, Finding, HostFiles

_RT_REMEDY = "boot a PREEMPT_RT kernel (Debian: apt install linux-image-rt-amd64)"


def _config(files: HostFiles) -> str:
    """The kernel's build configuration, from wherever it is told; empty if nowhere."""
    boot = files.text(f"boot/config-{platform.release()}")
    if boot:
        return boot
    try:
        return gzip.decompress((files.root / "proc/config.gz").read_bytes()).decode()
    except (OSError, EOFError, UnicodeDecodeError):
        return ""


def _dynamic_mode(files: HostFiles) -> str | None:
    """Preemption chosen at boot or later on a PREEMPT_DYNAMIC kernel: none, voluntary, lazy or full."""
    text = files.text("sys/kernel/debug/sched/preempt")
    if text and (chosen := re.search(r"\((\w+)\)", text)):
        return chosen[1]
    if boot := re.search(r"\bpreempt=(\w+)", files.text("proc/cmdline") or ""):
        return boot[1]
    config = _config(files)
    for name, mode in (("PREEMPT_LAZY", "lazy"), ("PREEMPT", "full"), ("PREEMPT_VOLUNTARY", "voluntary")):
        if f"\nCONFIG_{name}=y" in config:
            return mode
    return "none" if "\nCONFIG_PREEMPT_NONE=y" in config else None


def preemption(files: HostFiles) -> Finding:
    """Which preemption model the kernel says it has; `host_probe` tries it."""
    version = files.text("proc/version") or ""
    if files.text("sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return Finding("kernel preemption", "PREEMPT_RT", OK)
    if "PREEMPT_DYNAMIC" in version:
        mode = _dynamic_mode(files)
        if mode == "full":
            return Finding("kernel preemption", "PREEMPT_DYNAMIC, full", WARN, _RT_REMEDY)
        if mode is None:
            return Finding(
                "kernel preemption",
                "PREEMPT_DYNAMIC, mode not readable",
                WARN,
                f"boot with preempt=full, or {_RT_REMEDY}",
            )
        return Finding(
            "kernel preemption", f"PREEMPT_DYNAMIC, {mode}", FAIL, f"boot with preempt=full, or {_RT_REMEDY}"
        )
    if re.search(r"\bPREEMPT\b", version):
        return Finding("kernel preemption", "PREEMPT", WARN, _RT_REMEDY)
    mode = _dynamic_mode(files) or "none that it tells of"
    return Finding("kernel preemption", mode, FAIL, _RT_REMEDY)


def throttling(files: HostFiles) -> Finding:
    """How much of each second real-time tasks may use."""
    runtime_us = files.number("proc/sys/kernel/sched_rt_runtime_us")
    period_us = files.number("proc/sys/kernel/sched_rt_period_us") or 1_000_000
    if runtime_us is None:
        return Finding("real-time throttling", "not readable", OK)
    if runtime_us < 0 or runtime_us >= period_us:
        return Finding("real-time throttling", "off", OK)
    value = f"real-time tasks get {runtime_us / period_us:.0%} of each {period_us / 1e6:g} s"
    remedy = "keep load plus spin tail below that share, or sysctl kernel.sched_rt_runtime_us=-1"
    return Finding("real-time throttling", value, WARN if runtime_us > 0 else FAIL, remedy)


def clocksource(files: HostFiles) -> Finding:
    """Which hardware clock CLOCK_MONOTONIC is read from; a slow one costs every time stamp of every tick."""
    name = files.text("sys/devices/system/clocksource/clocksource0/current_clocksource")
    if name is None:
        return Finding("clocksource", "not readable", WARN, "mount /sys")
    if name in ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page", "riscv_clocksource", "timebase"):
        return Finding("clocksource", name, OK)
    slow = name in ("hpet", "acpi_pm", "jiffies", "pit")
    return Finding(
        "clocksource",
        name,
        FAIL if slow else WARN,
        "boot with tsc=reliable clocksource=tsc if the processor's counter is sound",
    )


def _hypervisor(files: HostFiles) -> str | None:
    cpuinfo = files.text("proc/cpuinfo") or ""
    if "User Mode Linux" in cpuinfo:
        return "User-Mode Linux"
    kind = files.text("sys/hypervisor/type")
    vendor = " ".join(filter(None, (files.text(f"sys/class/dmi/id/{name}") for name in ("sys_vendor", "product_name"))))
    known = (
        "QEMU",
        "KVM",
        "VMware",
        "VirtualBox",
        "innotek",
        "Xen",
        "Microsoft Corporation Virtual",
        "Google",
        "Amazon EC2",
    )
    if re.search(r"^flags\s*:.*\bhypervisor\b", cpuinfo, re.MULTILINE):
        return kind or next((name for name in known if name in vendor), "hypervisor flag of the processor")
    return kind or next((name for name in known if name in vendor), None)


def steal_ratio(files: HostFiles) -> float | None:
    """Share of processor time since boot that the hypervisor gave to others while this machine wanted it (0..1)."""
    first = (files.text("proc/stat") or "").splitlines()[:1]
    numbers = [int(word) for word in first[0].split()[1:]] if first and first[0].startswith("cpu ") else []
    if len(numbers) < 8 or not sum(numbers[:8]):
        return None
    busy = sum(numbers[:8]) - numbers[3] - numbers[4]  # without idle and iowait
    return numbers[7] / busy if busy else 0.0


def virtual_machine(files: HostFiles) -> Finding:
    """Whether a hypervisor can take the core away, and how much it has taken."""
    name = _hypervisor(files)
    if name is None:
        return Finding("virtual machine", "no", OK)
    steal = steal_ratio(files)
    taken = "" if steal is None else f", {steal:.1%} of busy time taken by the host since boot"
    return Finding(
        "virtual machine",
        f"yes ({name}){taken}",
        WARN,
        "run on bare metal, or pin the virtual cores and read the host's own latency",
    )


def memory(files: HostFiles) -> list[Finding]:
    """Swap and transparent huge pages: what can stall a thread whose memory is not locked."""
    swaps = [line.split()[0] for line in (files.text("proc/swaps") or "").splitlines()[1:]]
    found = [
        Finding("swap", ", ".join(swaps), WARN, "swapoff -a, or rely on the memory lock being granted")
        if swaps
        else Finding("swap", "none", OK)
    ]
    huge = re.search(r"\[(\w+)\]", files.text("sys/kernel/mm/transparent_hugepage/enabled") or "")
    mode = huge[1] if huge else "none"
    if mode == "always":
        found.append(
            Finding("transparent huge pages", mode, WARN, "echo madvise > /sys/kernel/mm/transparent_hugepage/enabled")
        )
    else:
        found.append(Finding("transparent huge pages", mode, OK))
    return found
