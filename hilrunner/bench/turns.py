"""Taking turns: on a shared machine only a ratio within one round means something, so rivals run slice by slice."""

import gc
import hashlib
import statistics
import time
from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np

T = TypeVar("T")


def rotated(names: list[str], round_index: int) -> list[str]:
    """The order of one round: everyone goes first once, so nobody always follows the same neighbour."""
    start = round_index % len(names)
    return names[start:] + names[:start]


def take_turns(slices: Mapping[str, Callable[[], T]], rounds: int) -> dict[str, list[T]]:
    """Run every slice once a round; results by name, one a round.

    Args:
        slices: name -> a call that takes one slice's time. rounds: how many.
    """
    results: dict[str, list[T]] = {name: [] for name in slices}
    for index in range(rounds):
        for name in rotated(list(slices), index):
            results[name].append(slices[name]())
    return results


def calibrate(run: Callable[[int], object], slice_s: float) -> int:
    """How many repetitions fill about `slice_s`; `run(n)` repeats n times (and is warm afterwards)."""
    run(1)
    count = 1
    while True:
        start_s = time.perf_counter()
        run(count)
        took_s = time.perf_counter() - start_s
        if took_s >= min(0.02, slice_s):
            return max(1, int(count * slice_s / took_s))
        count *= 4


def time_turns(runs: Mapping[str, Callable[[int], object]], rounds: int, slice_s: float) -> dict[str, list[float]]:
    """Nanoseconds a repetition of each run, one value a round, the collector off meanwhile."""
    counts = {name: calibrate(run, slice_s) for name, run in runs.items()}

    def timed(name: str) -> Callable[[], float]:
        def one_slice() -> float:
            start_ns = time.perf_counter_ns()
            runs[name](counts[name])
            return (time.perf_counter_ns() - start_ns) / counts[name]

        return one_slice

    enabled = gc.isenabled()
    gc.disable()
    try:
        return take_turns({name: timed(name) for name in runs}, rounds)
    finally:
        if enabled:
            gc.enable()


def median_ratio(values: list[float], to: list[float]) -> float:
    """Median over the rounds of value / rival of the same round; NaN where the rival gave nothing."""
    ratios = [a / b for a, b in zip(values, to, strict=True) if b > 0]
    return statistics.median(ratios) if ratios else float("nan")


def fingerprint(values: np.ndarray) -> str:
    """Eight hex digits over the bytes of a result: a faster wrong answer is seen."""
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()[:8]
