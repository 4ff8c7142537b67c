"""Wake-up lateness of the full tick against `cyclictest`, slice by slice on the same core; and what a tick costs."""

import statistics
import subprocess

import numpy as np

from hilrunner.base.histogram_scale import percentiles
from hilrunner.base.records import HISTOGRAM_NAMES
from hilrunner.base.units import NS_PER_US
from hilrunner.bench import cyclictest
from hilrunner.bench.results import HEADINGS, SHOWN, Table, pooled_us
from hilrunner.bench.tick import Slice, TickBench
from hilrunner.bench.turns import median_ratio, take_turns

SPIN_NS_MIN, SPIN_NS_MAX = 20_000, 300_000
TICK, PLAIN, SPIN = "tick", "tick, no rehearsal", "tick, spin tail"
PHASES = ("receive", "decode", "step", "encode", "record", "execution")


def choose_spin_ns(first: Slice) -> int:
    """A spin tail that covers 99 % of the wake-ups of a slice without one and a rehearsal, to the next 10 us, within bounds."""
    needed_ns = percentiles(*first.of("wake_lateness"))["p99"] + 2 * percentiles(*first.of("execution"))["p50"]
    return int(np.clip(-(-needed_ns // 10_000) * 10_000, SPIN_NS_MIN, SPIN_NS_MAX))


def compare(bench: TickBench, rounds: int, slice_s: float, spin_ns: int = 0) -> tuple[Table, Table]:
    """Tick as it is, without rehearsal and with spin tail, and cyclictest, in turns; tables of lateness and execution.

    Args:
        bench: armed, with period and core. spin_ns: the spin tail; 0 chooses it from the first slice.
    """
    place, period_ns = bench.place, bench.period_ns
    first = bench.run(slice_s)  # warm, and thrown away
    spin_ns = spin_ns or choose_spin_ns(first)
    slices = {
        TICK: lambda: bench.run(slice_s),
        PLAIN: lambda: bench.run(slice_s, rehearse=False),
        SPIN: lambda: bench.run(slice_s, spin_ns=spin_ns),
    }
    notes = []
    if reason := cyclictest.left_out(place.cpu, place.other_cpu, place.priority):
        notes.append(reason)
    else:
        slices["cyclictest"] = lambda: cyclictest.run_slice(
            place.cpu, place.other_cpu, place.priority, period_ns, slice_s
        )
    try:
        results = take_turns(slices, rounds)
    except (OSError, subprocess.SubprocessError) as error:
        notes.append(f"cyclictest failed: {error}")
        del slices["cyclictest"]
        results = take_turns(slices, rounds)
    rows = {
        name: [one.of("wake_lateness") if isinstance(one, Slice) else one for one in taken]
        for name, taken in results.items()
    }
    title = (
        f"Wake-up lateness at {period_ns / NS_PER_US:g} us on core {place.cpu}, SCHED_FIFO {place.priority}, "
        f"{rounds} rounds of {slice_s:g} s in turns; spin tail {spin_ns / NS_PER_US:g} us"
    )
    return _lateness_table(title, rows, notes, spin_ns), _execution_table(results, bench)


def _lateness_table(title: str, rows: dict[str, list], notes: list[str], spin_ns: int) -> Table:
    shown = [(name, *pooled_us(taken)) for name, taken in rows.items()]
    values: dict = {"spin_ns": spin_ns}
    for name, taken in rows.items():
        key = name.replace(", ", "_").replace(" ", "_")
        values[f"{key}_ns"] = [percentiles(*one) for one in taken]
    if "cyclictest" in rows:
        for name in (TICK, PLAIN, SPIN):
            ratios = [_ratio(rows[name], rows["cyclictest"], quantile) for quantile in SHOWN]
            shown.append((f"{name} / cyclictest, median of rounds", *ratios))
            key = name.replace(", ", "_").replace(" ", "_")
            values |= {f"{key}_ratio_{quantile}": ratio for quantile, ratio in zip(SHOWN, ratios, strict=True)}
    skipped = "a stall counts its skipped periods as late samples, in both"
    return Table("lateness", title, ("", *HEADINGS), shown, [skipped, *notes], values)


def _ratio(ours: list, rival: list, quantile: str) -> float:
    return median_ratio([percentiles(*one)[quantile] for one in ours], [percentiles(*one)[quantile] for one in rival])


def _execution_table(results: dict[str, list], bench: TickBench) -> Table:
    """Phases of the tick as it is, and the whole of its variants."""
    taken = results[TICK]
    rows, values = [], {}
    for name in PHASES:
        rows.append((name, *pooled_us([one.of(name) for one in taken])))
        values[f"{name}_ns_p50"] = _median_p50_ns(taken, name)
    for variant, key in ((PLAIN, "no_rehearsal"), (SPIN, "spin_tail")):
        rows.append(
            (variant.replace("tick", "execution"), *pooled_us([one.of("execution") for one in results[variant]]))
        )
        values[f"execution_{key}_ns_p50"] = _median_p50_ns(results[variant], "execution")
    ticks = sum(one.ticks for one in taken)
    received = sum(one.frames_received for one in taken)
    sent = sum(one.frames_sent for one in taken)
    notes = [
        f"{ticks} ticks, {received / ticks:.2f} frames in and {sent / ticks:.2f} out a tick, "
        f"{sum(one.misses for one in taken)} late, {sum(one.dropped for one in taken)} lost to the log"
    ]
    shares = {name: _processor_us(results[name]) for name in (TICK, PLAIN, SPIN)}
    notes.append(
        "processor time a tick, waiting included: " + ", ".join(f"{name} {us:.0f} us" for name, us in shares.items())
    )
    title = f"Execution of a tick, {len(bench.armed.bench.state)} axis, socketpair, recorded (phases and whole)"
    values |= {f"processor_{name.replace(', ', '_').replace(' ', '_')}_us": us for name, us in shares.items()}
    values |= {"ticks": ticks, "misses": sum(one.misses for one in taken)}
    return Table("execution", title, ("phase", *HEADINGS), rows, notes, values)


def _processor_us(taken: list[Slice]) -> float:
    return sum(one.processor_ns for one in taken) / max(sum(one.ticks for one in taken), 1) / NS_PER_US


def _median_p50_ns(taken: list[Slice], name: str) -> float:
    return statistics.median(percentiles(*one.of(name))["p50"] for one in taken)


assert set(PHASES) <= set(HISTOGRAM_NAMES)
