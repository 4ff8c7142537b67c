"""How far it goes on this core: most axes within half a period, shortest period that holds."""

from collections.abc import Callable

import numpy as np

from hilrunner.base.histogram_scale import count_above, percentiles
from hilrunner.base.units import NS_PER_US
from hilrunner.bench import cyclictest
from hilrunner.bench.results import Table
from hilrunner.bench.tick import Place, Slice, TickBench, axis_count_max, build_one_axis, say

PERIODS_US = (1000, 500, 250, 200, 150, 100, 75, 50)


def bisect_most(fits: Callable[[int], bool], limit: int) -> int:
    """Largest count from 1 to `limit` that fits (0: none), doubling first, then halving the gap."""
    good, bad = 0, limit + 1
    count = 1
    while count < bad:
        if fits(count):
            good = count
            count = min(2 * count, limit) if count < limit else bad
        else:
            bad = count
    while bad - good > 1:
        middle = (good + bad) // 2
        if fits(middle):
            good = middle
        else:
            bad = middle
    return good


def most_axes(place: Place, profile: str, engine: int, slice_s: float, period_us: int = 1000) -> Table:
    """Most axes whose tick takes at most half a period in 99 of 100 ticks."""
    axes = build_one_axis(profile, period_us, engine)
    limit_ns = period_us * NS_PER_US // 2
    tried: dict[int, dict[str, int]] = {}

    def fits(count: int) -> bool:
        say(f"{count} axes")
        with TickBench(place, profile, axis_count=count, period_us=period_us, engine=engine, axes=axes) as bench:
            bench.run(min(0.2, slice_s))
            tried[count] = percentiles(*bench.run(slice_s).of("execution"))
        return tried[count]["p99"] <= limit_ns

    limit = axis_count_max()
    most = bisect_most(fits, limit)
    rows = [
        (
            count,
            *(tried[count][name] / NS_PER_US for name in ("p50", "p99", "p999", "max")),
            tried[count]["p99"] <= limit_ns,
        )
        for count in sorted(tried)
    ]
    notes = [
        f"most axes: {most}" + (f" (all the shipped contract has identifiers for: {limit})" if most == limit else "")
    ]
    if len(tried) > 1:
        counts = np.array(sorted(tried))
        per_axis_ns, _ = np.polyfit(counts, [tried[int(count)]["p50"] for count in counts], 1)
        notes.append(f"one more axis costs {per_axis_ns / NS_PER_US:.2f} us (median execution, straight line)")
    title = f"Most axes at {period_us} us: execution within {limit_ns / NS_PER_US:g} us in 99 % of ticks, {slice_s:g} s each"
    columns = ("axes", "p50 us", "p99 us", "p99.9 us", "max us", "fits")
    return Table("axes", title, columns, rows, notes, {"axis_count_max": most})


def shortest_period(place: Place, profile: str, engine: int, slice_s: float) -> Table:
    """Misses at shorter and shorter periods, beside the wake-ups of cyclictest that would have been misses too."""
    rows, held, host_held = [], None, None
    reason = cyclictest.left_out(place.cpu, place.other_cpu, place.priority)
    for period_us in PERIODS_US:
        say(f"period {period_us} us")
        with TickBench(place, profile, period_us=period_us, engine=engine) as bench:
            bench.run(min(0.2, slice_s))
            taken = bench.run(slice_s)
            host = _host_misses(place, bench.period_ns, slice_s, taken) if not reason else None
        execution = percentiles(*taken.of("execution"))
        lost = taken.misses + taken.skipped
        rows.append((period_us, execution["p50"] / NS_PER_US, execution["p999"] / NS_PER_US, taken.ticks, lost, host))
        if lost == 0 and (held is None or held == PERIODS_US[len(rows) - 2]):
            held = period_us
        if host is not None and lost <= host + _noise(host):
            host_held = period_us
    notes = [f"shortest period that held without a miss: {f'{held} us' if held else 'none, see the last column'}"]
    if reason:
        notes.append(reason)
    else:
        words = f"{host_held} us" if host_held else "none"
        notes.append(f"shortest period with no more misses than the host alone causes: {words}")
    title = f"Shortest period, one axis, {slice_s:g} s each"
    columns = ("period us", "execution p50 us", "p99.9 us", "ticks", "late or skipped", "host alone (cyclictest)")
    values = {"period_us_min": held, "period_us_min_host": host_held}
    return Table("period", title, columns, rows, notes, values)


def _host_misses(place: Place, period_ns: int, slice_s: float, taken: Slice) -> int:
    """Wake-ups of cyclictest too late for a tick of median length to end in its period."""
    row, _ = cyclictest.run_slice(place.cpu, place.other_cpu, place.priority, period_ns, slice_s)
    median_ns = percentiles(*taken.of("execution"))["p50"]
    return count_above(row, max(0, period_ns - median_ns))


def _noise(count: int) -> int:
    """Twice the standard deviation of a count of rare events."""
    return int(2 * np.sqrt(count))
