"""Disturbances in our own process and beside it: does the tick notice more than a bare `cyclictest` thread does?

A busy Python thread and a `gc.collect()` loop take the interpreter, a writer takes the disk at full speed. The loop needs none of
them; what it shares with them is the kernel and the memory bus, and that cyclictest shares as well.
"""

import contextlib
import gc
import os
import tempfile
import threading
from collections.abc import Callable, Iterator

from hilrunner.base.histogram_scale import percentiles
from hilrunner.bench import cyclictest
from hilrunner.bench.results import HEADINGS, SHOWN, Table, pooled_us
from hilrunner.bench.tick import TickBench, say
from hilrunner.bench.turns import median_ratio, take_turns

_BLOCK_BYTES = 1 << 20
_FILE_BYTES = 256 << 20


def _busy(stop: threading.Event) -> None:
    while not stop.is_set():
        sum(range(10_000))


def _collect(stop: threading.Event) -> None:
    kept = [[k] for k in range(100_000)]  # something to look through
    while not stop.is_set():
        gc.collect()
    del kept


def _write(stop: threading.Event) -> None:
    block = os.urandom(_BLOCK_BYTES)
    with tempfile.TemporaryFile() as file:
        while not stop.is_set():
            if file.tell() >= _FILE_BYTES:
                os.fdatasync(file.fileno())
                file.seek(0)
            file.write(block)


DISTURBANCES: dict[str, Callable[[threading.Event], None]] = {
    "busy Python thread": _busy,
    "gc.collect() loop": _collect,
    "writer at full speed": _write,
}


@contextlib.contextmanager
def disturbing(names: tuple[str, ...]) -> Iterator[None]:
    """Run the named disturbances on threads of this process while the block lasts."""
    stop = threading.Event()
    threads = [threading.Thread(target=DISTURBANCES[name], args=(stop,), daemon=True) for name in names]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def disturb_table(bench: TickBench, rounds: int, slice_s: float) -> Table:
    """Tick and cyclictest in turns, quiet, under each disturbance, and under all."""
    place, period_ns = bench.place, bench.period_ns
    loads = {"quiet": (), **{name: (name,) for name in DISTURBANCES}, "all three": tuple(DISTURBANCES)}
    reason = cyclictest.left_out(place.cpu, place.other_cpu, place.priority)
    rows, values = [], {}
    for name, load in loads.items():
        say(f"disturbance: {name}")
        slices = {"tick": lambda: bench.run(slice_s).of("wake_lateness")}
        if not reason:
            slices["cyclictest"] = lambda: cyclictest.run_slice(
                place.cpu, place.other_cpu, place.priority, period_ns, slice_s
            )
        with disturbing(load):
            taken = take_turns(slices, rounds)
        quantiles = {who: [percentiles(*one) for one in rounds_of] for who, rounds_of in taken.items()}
        values[name] = quantiles
        rows.append((f"{name}: tick", *pooled_us(taken["tick"])))
        if not reason:
            rows.append((f"{name}: cyclictest", *pooled_us(taken["cyclictest"])))
            rows.append((f"{name}: ratio, median of rounds", *(_ratio(quantiles, one) for one in SHOWN)))
    title = f"Wake-up lateness beside disturbances in this process, {rounds} rounds of {slice_s:g} s in turns"
    notes = [reason] if reason else []
    return Table("disturb", title, ("", *HEADINGS), rows, notes, {"rounds": values})


def _ratio(quantiles: dict[str, list[dict[str, int]]], name: str) -> float:
    ours, theirs = ([one[name] for one in quantiles[who]] for who in ("tick", "cyclictest"))
    return median_ratio(ours, theirs)
