"""Host findings from invented /proc and /sys trees: what is read, how it is judged, and that a remedy goes with each."""

import gzip
import platform
from pathlib import Path

import pytest

from hilrunner.setup import host_cpu, host_kernel
from hilrunner.setup.host_words import FAIL, OK, WARN, HostFiles, parse_cpu_list

CPU = "sys/devices/system/cpu"
DEBUG_PREEMPT = "sys/kernel/debug/sched/preempt"
CLOCK = "sys/devices/system/clocksource/clocksource0/current_clocksource"
THP = "sys/kernel/mm/transparent_hugepage/enabled"
DYNAMIC = "Linux version 6.12 #1 SMP PREEMPT_DYNAMIC"


def tree(root: Path, files: dict[str, str]) -> HostFiles:
    """An invented file tree."""
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return HostFiles(root)


@pytest.mark.parametrize(
    "text, cores",
    [("0-2,5", {0, 1, 2, 5}), ("", set()), ("3", {3}), (None, set()), ("0,2-3\n", {0, 2, 3}), ("x", set())],
)
def test_cpu_list(text, cores):
    assert parse_cpu_list(text) == cores


PREEMPTION = [
    ({"sys/kernel/realtime": "1"}, OK, "PREEMPT_RT"),
    ({"proc/version": "Linux version 6.1 #1 SMP PREEMPT_RT Debian"}, OK, "PREEMPT_RT"),
    ({"proc/version": DYNAMIC, DEBUG_PREEMPT: "none voluntary (full)"}, WARN, "full"),
    ({"proc/version": DYNAMIC, DEBUG_PREEMPT: "none (voluntary) full"}, FAIL, "voluntary"),
    ({"proc/version": DYNAMIC, "proc/cmdline": "quiet preempt=full"}, WARN, "full"),
    ({"proc/version": DYNAMIC, f"boot/config-{platform.release()}": "x\nCONFIG_PREEMPT_NONE=y"}, FAIL, "none"),
    ({"proc/version": DYNAMIC, f"boot/config-{platform.release()}": "x\nCONFIG_PREEMPT=y"}, WARN, "full"),
    ({"proc/version": DYNAMIC}, WARN, "not readable"),
    ({"proc/version": "Linux version 5.4 #1 SMP PREEMPT"}, WARN, "PREEMPT"),
    ({"proc/version": "Linux version 5.4 #1 SMP"}, FAIL, "none that"),
]


@pytest.mark.parametrize("files, verdict, text", PREEMPTION)
def test_preemption(tmp_path, files, verdict, text):
    found = host_kernel.preemption(tree(tmp_path, files))
    assert found.verdict == verdict and text in found.value
    assert bool(found.remedy) == (verdict != OK)


def test_preemption_from_the_packed_configuration(tmp_path):
    files = tree(tmp_path, {"proc/version": DYNAMIC})
    (tmp_path / "proc/config.gz").write_bytes(gzip.compress(b"#\nCONFIG_PREEMPT_VOLUNTARY=y\n"))
    assert host_kernel.preemption(files).value == "PREEMPT_DYNAMIC, voluntary"


KERNEL = [
    (host_kernel.throttling, {"proc/sys/kernel/sched_rt_runtime_us": "950000"}, WARN, "95%"),
    (host_kernel.throttling, {"proc/sys/kernel/sched_rt_runtime_us": "-1"}, OK, "off"),
    (host_kernel.throttling, {"proc/sys/kernel/sched_rt_runtime_us": "0"}, FAIL, "0%"),
    (host_kernel.throttling, {}, OK, "not readable"),
    (host_kernel.clocksource, {CLOCK: "tsc"}, OK, "tsc"),
    (host_kernel.clocksource, {CLOCK: "hpet"}, FAIL, "hpet"),
    (host_kernel.clocksource, {CLOCK: "unheard-of"}, WARN, "unheard-of"),
    (host_kernel.clocksource, {}, WARN, "not readable"),
    (host_kernel.virtual_machine, {"proc/cpuinfo": "flags\t\t: fpu vme"}, OK, "no"),
    (host_kernel.virtual_machine, {"proc/cpuinfo": "flags\t\t: fpu hypervisor vme"}, WARN, "hypervisor flag"),
    (host_kernel.virtual_machine, {"proc/cpuinfo": "host : User Mode Linux"}, WARN, "User-Mode Linux"),
    (host_kernel.virtual_machine, {"sys/class/dmi/id/sys_vendor": "QEMU"}, WARN, "QEMU"),
    (host_kernel.virtual_machine, {"sys/hypervisor/type": "xen"}, WARN, "xen"),
]


@pytest.mark.parametrize("inspect, files, verdict, text", KERNEL)
def test_kernel(tmp_path, inspect, files, verdict, text):
    found = inspect(tree(tmp_path, files))
    assert found.verdict == verdict and text in found.value
    assert not (verdict == FAIL and not found.remedy)


def test_steal_is_a_share_of_busy_time(tmp_path):
    # user 30, nice 0, system 10, idle 900, iowait 50, irq 0, softirq 0, steal 10: 10 of 50
    files = tree(tmp_path, {"proc/stat": "cpu  30 0 10 900 50 0 0 10 0 0\ncpu0 1 2", "sys/hypervisor/type": "xen"})
    assert host_kernel.steal_ratio(files) == pytest.approx(0.2)
    assert "20.0%" in host_kernel.virtual_machine(files).value
    assert host_kernel.steal_ratio(HostFiles(tmp_path / "empty")) is None


def test_memory(tmp_path):
    swap = "Filename Type Size Used Priority\n/dev/sda2 partition 1 0 -2"
    bad = host_kernel.memory(tree(tmp_path, {"proc/swaps": swap, THP: "[always] madvise never"}))
    assert [finding.verdict for finding in bad] == [WARN, WARN] and "/dev/sda2" in bad[0].value
    good = host_kernel.memory(tree(tmp_path / "other", {"proc/swaps": "Filename", THP: "always [madvise] never"}))
    assert [finding.verdict for finding in good] == [OK, OK]


CORES = [
    (host_cpu.governor, {f"{CPU}/cpu1/cpufreq/scaling_governor": "powersave"}, WARN, "powersave"),
    (host_cpu.governor, {f"{CPU}/cpu1/cpufreq/scaling_governor": "performance"}, OK, "performance"),
    (host_cpu.governor, {}, OK, "none"),
    (host_cpu.idle_states, {}, OK, "none"),
    (host_cpu.siblings, {f"{CPU}/online": "0-3", f"{CPU}/cpu1/topology/thread_siblings_list": "1,3"}, WARN, "with 3"),
    (host_cpu.siblings, {f"{CPU}/online": "0-1", f"{CPU}/cpu1/topology/thread_siblings_list": "1,3"}, OK, "alone"),
    (host_cpu.isolation, {f"{CPU}/isolated": "1", f"{CPU}/nohz_full": "1"}, OK, "tickless"),
    (host_cpu.isolation, {f"{CPU}/isolated": "1", f"{CPU}/nohz_full": ""}, OK, "timer tick"),
    (host_cpu.isolation, {f"{CPU}/isolated": "2-3"}, WARN, "2, 3"),
]


@pytest.mark.parametrize("inspect, files, verdict, text", CORES)
def test_core_one(tmp_path, inspect, files, verdict, text):
    found = inspect(tree(tmp_path, files), 1)
    assert found.verdict == verdict and text in found.value


def test_deepest_enabled_idle_state_counts(tmp_path):
    states = {0: ("POLL", 0, 0), 1: ("C1", 2, 0), 2: ("C6", 133, 0), 3: ("C10", 890, 1)}
    listing = {}
    for number, (name, latency_us, disabled) in states.items():
        folder = f"{CPU}/cpu1/cpuidle/state{number}"
        listing |= {f"{folder}/name": name, f"{folder}/latency": str(latency_us), f"{folder}/disable": str(disabled)}
    found = host_cpu.idle_states(tree(tmp_path, listing), 1)
    assert found.verdict == WARN and "C6, 133 us" in found.value
    (tmp_path / f"{CPU}/cpu1/cpuidle/state2/disable").write_text("1")
    assert host_cpu.idle_states(HostFiles(tmp_path), 1).verdict == OK


def test_one_core_is_not_enough(tmp_path):
    assert host_cpu.core_count(tree(tmp_path, {f"{CPU}/online": "0"})).verdict == FAIL
    assert host_cpu.core_count(tree(tmp_path / "two", {f"{CPU}/online": "0-1"})).verdict == OK


INTERRUPTS = """            CPU0       CPU1
 24:          5          7  IO-APIC   5-edge      eth0
 25:          1          9  IO-APIC   6-edge      disk
LOC:      90326      92714   Local timer interrupts"""


def test_interrupt_lines_and_counts_of_the_core(tmp_path):
    files = tree(
        tmp_path,
        {
            "proc/interrupts": INTERRUPTS,
            "proc/irq/24/smp_affinity_list": "0-1",
            "proc/irq/24/effective_affinity_list": "0",
            "proc/irq/25/smp_affinity_list": "1",
            "proc/irq/default_smp_affinity": "3",
            f"{CPU}/online": "0-1",
        },
    )
    found = host_cpu.interrupts(files, 1)
    assert found.verdict == WARN and found.value == "1 of 2 lines go to core 1, 16 served since boot"
    assert "irqaffinity=0" in found.remedy
    (tmp_path / "proc/irq/25/smp_affinity_list").write_text("0")
    assert host_cpu.interrupts(files, 1).verdict == OK


def test_suggested_core_is_an_isolated_one_that_is_allowed(tmp_path):
    files = tree(tmp_path, {f"{CPU}/isolated": "2-3"})
    assert host_cpu.suggest_cpu(files, {0, 1, 2}) == 2
    assert host_cpu.suggest_cpu(files, {0, 1}) == 1
