"""The cores: frequency, idle states, shared cores, isolation, interrupts. Every function looks at one core, the loop's."""

from hilrunner.setup.host_words import FAIL, OK, WARN, Finding, HostFiles, parse_cpu_list

_CPU = "sys/devices/system/cpu"
IDLE_EXIT_US_MAX = 20  # an idle state that wakes within this is harmless at 1 kHz (LinuxCNC: below 20 us is excellent)


def online(files: HostFiles) -> set[int]:
    """Cores the kernel runs on."""
    return parse_cpu_list(files.text(f"{_CPU}/online")) or {0}


def isolated(files: HostFiles) -> set[int]:
    """Cores the kernel's scheduler leaves alone (isolcpus=, or an isolated cpuset partition)."""
    return parse_cpu_list(files.text(f"{_CPU}/isolated"))


def suggest_cpu(files: HostFiles, allowed: set[int]) -> int:
    """The core a loop is best put on: an isolated one, else the highest allowed one (interrupts mostly start at 0)."""
    candidates = (isolated(files) & allowed) or allowed
    return max(candidates)


def core_count(files: HostFiles) -> Finding:
    """One core for the loop and one for everything else is the least."""
    count = len(online(files))
    if count >= 2:
        return Finding("cores", str(count), OK)
    return Finding("cores", "only 1, so the recorder competes with the loop", FAIL, "give the machine a second core")


def governor(files: HostFiles, cpu: int) -> Finding:
    """Whether the core's frequency may change under the loop."""
    name = files.text(f"{_CPU}/cpu{cpu}/cpufreq/scaling_governor")
    if name is None:
        return Finding("frequency governor", "none (fixed, or the hypervisor's business)", OK)
    if name == "performance":
        return Finding("frequency governor", name, OK)
    remedy = f"cpupower -c {cpu} frequency-set -g performance"
    return Finding("frequency governor", f"{name} on core {cpu}", WARN, remedy)


def idle_states(files: HostFiles, cpu: int) -> Finding:
    """The slowest idle state the core may enter; its exit latency is added to a wake-up."""
    slowest_us, name = 0, ""
    for state in files.names(f"{_CPU}/cpu{cpu}/cpuidle/state*"):
        latency_us = files.number(f"{state}/latency") or 0
        if files.number(f"{state}/disable") != 1 and latency_us >= slowest_us:
            slowest_us, name = latency_us, files.text(f"{state}/name") or state.rsplit("/", 1)[-1]
    if not name:
        return Finding("idle states", "none", OK)
    value = f"deepest {name}, {slowest_us} us to wake"
    if slowest_us <= IDLE_EXIT_US_MAX:
        return Finding("idle states", value, OK)
    remedy = "let the run hold /dev/cpu_dma_latency at 0 (it asks), or boot with processor.max_cstate=1 intel_idle.max_cstate=0"
    return Finding("idle states", value, WARN, remedy)


def siblings(files: HostFiles, cpu: int) -> Finding:
    """Whether another logical core shares the loop's execution units (SMT, Hyper-Threading)."""
    shared = parse_cpu_list(files.text(f"{_CPU}/cpu{cpu}/topology/thread_siblings_list")) - {cpu}
    shared &= online(files)
    if not shared:
        return Finding("shared core (SMT)", f"core {cpu} is alone", OK)
    others = ", ".join(map(str, sorted(shared)))
    remedy = "echo off > /sys/devices/system/cpu/smt/control, or keep the sibling idle (isolcpus)"
    return Finding("shared core (SMT)", f"core {cpu} shares with {others}", WARN, remedy)


def isolation(files: HostFiles, cpu: int) -> Finding:
    """Whether ordinary tasks are kept off the loop's core."""
    alone = isolated(files)
    if cpu in alone:
        tickless = parse_cpu_list(files.text(f"{_CPU}/nohz_full"))
        return Finding("isolated core", f"core {cpu}, {'tickless' if cpu in tickless else 'with timer tick'}", OK)
    listed = ", ".join(map(str, sorted(alone))) or "none"
    remedy = f"boot with isolcpus=managed_irq,domain,{cpu} nohz_full={cpu} rcu_nocbs={cpu}, and run with --cpu {cpu}"
    return Finding("isolated core", f"core {cpu} is not isolated (isolated: {listed})", WARN, remedy)


def _interrupt_counts(files: HostFiles, cpu: int) -> dict[str, int]:
    """Device interrupts the core has served since boot, by interrupt number."""
    lines = (files.text("proc/interrupts") or "").splitlines()
    header = [word for word in (lines[0].split() if lines else []) if word.startswith("CPU")]
    if f"CPU{cpu}" not in header:
        return {}
    column = header.index(f"CPU{cpu}") + 1
    rows = (line.split() for line in lines[1:])
    return {
        words[0].rstrip(":"): int(words[column])
        for words in rows
        if len(words) > column and words[0].rstrip(":").isdigit() and words[column].isdigit()
    }


def interrupts(files: HostFiles, cpu: int) -> Finding:
    """Device interrupts that may be served on the loop's core, and how many were."""
    numbers = [name for name in files.names("proc/irq/*") if name.rsplit("/", 1)[-1].isdigit()]
    may = [
        name
        for name in numbers
        if cpu
        in parse_cpu_list(files.text(f"{name}/effective_affinity_list") or files.text(f"{name}/smp_affinity_list"))
    ]
    served = sum(_interrupt_counts(files, cpu).values())
    value = f"{len(may)} of {len(numbers)} lines go to core {cpu}, {served} served since boot"
    if not may:
        return Finding("interrupt affinity", value, OK)
    others = sorted(online(files) - {cpu})
    remedy = (
        f"boot with irqaffinity={','.join(map(str, others))} and stop irqbalance"
        if others
        else "give the machine a second core for its interrupts"
    )
    return Finding("interrupt affinity", value, WARN, remedy)
