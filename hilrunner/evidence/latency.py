"""Latency of a run from its raw ticks: exact percentiles, skipped periods as late samples, every miss with its cause.

The loop's own histograms round up to a bucket; here every logged tick is sorted, so the two check each other.
"""

import json
from dataclasses import dataclass

import numpy as np

from hilrunner.base import histogram_scale, records, status
from hilrunner.base.errors import LogError
from hilrunner.base.histogram_scale import PERCENTILE_RATIOS
from hilrunner.base.records import HISTOGRAM_NAMES, TICK_FLAG_MISS, TICK_FLAG_SKIPPED
from hilrunner.evidence.budget import SKIPPED_PERIODS_MAX
from hilrunner.evidence.facts import RunFacts
from hilrunner.evidence.reader import Run
from hilrunner.record.statistics import HISTOGRAM_ATTACHMENT

TITLES = {
    "wake_lateness": "wake-up lateness",
    "receive": "receive",
    "decode": "decode",
    "step": "plant step",
    "encode": "encode and send",
    "record": "record",
    "execution": "execution (wake-up to end)",
    "period": "period (wake-up to wake-up)",
    "command_age": "command age",
    "response": "response (command's stamp to answer)",
}
WORST_COUNT = 20
TIMELINE_BINS = 600
EXACT_SAMPLES_MAX = (
    4_000_000  # of more, a percentile is judged by the loop's histogram: a run of days would need gigabytes
)
_LOOP = "the loop's histogram"


@dataclass(frozen=True)
class Distribution:
    """Samples of one quantity, ns: exact statistics, and a histogram on base.histogram_scale."""

    name: str
    count: int
    values_ns: dict[str, int]  # records.STATISTIC_NAMES
    mean_ns: float
    row: np.ndarray  # int64[BUCKET_COUNT]
    extreme: np.ndarray  # int64[4]
    source: str  # where the samples come from


@dataclass(frozen=True)
class Miss:
    """One late tick."""

    tick: int
    time_s: float  # since tick 0
    lateness_ns: int
    wake_lateness_ns: int
    execution_ns: int
    skipped_count: int
    cause: str
    phase: str
    detail: str


@dataclass(frozen=True)
class Timeline:
    """Largest values in equal stretches of the run, for a plot."""

    times_s: np.ndarray
    wake_lateness_ns: np.ndarray
    execution_ns: np.ndarray


@dataclass(frozen=True)
class Latency:
    """Everything about time in one run."""

    period_ns: int
    tick_count: int  # logged, without the skipped periods
    warm_up_ticks: int  # of these, left out of the statistics
    duration_s: float
    skipped_count: int
    lost_count: int  # ran, but were dropped on the way to the log
    miss_count: int
    misses: list[Miss]  # the worst, worst first
    causes: dict[str, int]
    distributions: dict[str, Distribution]
    loop: dict[str, Distribution]  # the loop's own, of every tick that ran: where the run has left them
    worst_wake: list[tuple[int, int]]  # (tick, ns), worst first
    timeline: Timeline


def measure_latency(run: Run, facts: RunFacts, responses_ns: np.ndarray) -> Latency:
    """Statistics of all ticks after the warm-up.

    Args:
        responses_ns: int64[n], of evidence.bus; without any, the loop's own histogram of responses is told.

    A skipped period counts as a wake-up that came with the next tick that ran: the plant was served no earlier
    (coordinated omission, HdrHistogram). Where it has a row of its own, the row says so; it has no durations.
    """
    ticks = run.tick
    kept = ticks[ticks["tick"] >= facts.warm_up_ticks]
    number = kept["tick"].astype(np.int64)
    wake_lateness = kept["wake_mono_ns"] - kept["deadline_mono_ns"]
    skipped = (kept["flags"] & TICK_FLAG_SKIPPED) != 0
    ran = kept[~skipped]
    execution = ran["end_mono_ns"] - ran["wake_mono_ns"]
    gap = np.diff(number, prepend=number[:1] - 1) - 1
    if len(gap):
        gap[0] = kept["skipped_count"][0]
    lost = np.maximum(gap - kept["skipped_count"], 0)
    distributions: dict[str, Distribution] = {}

    def add(name: str, values_ns: np.ndarray) -> None:
        if len(values_ns):
            distributions[name] = distribution(name, values_ns, "ticks")

    _check_skipped(run, int(kept["skipped_count"].sum(dtype=np.int64)))
    add("wake_lateness", with_skipped(wake_lateness, kept["skipped_count"], facts.period_ns))
    for name in ("receive", "decode", "step", "encode", "record"):
        add(name, ran[f"{name}_ns"])
    add("execution", execution)
    add("period", np.diff(ran["wake_mono_ns"])[np.diff(np.cumsum(lost)[~skipped]) == 0])
    add("command_age", _command_ages(run, facts))
    if len(responses_ns):
        distributions["response"] = distribution("response", responses_ns, "frames")
    else:
        told = _from_attachment(run, "response") or _from_statistics(run, "response")
        if told is not None:
            distributions["response"] = told
    misses, causes = _misses(run, facts, kept)
    worst = np.argsort(-wake_lateness, kind="stable")[:WORST_COUNT]
    return Latency(
        period_ns=facts.period_ns,
        tick_count=int(np.count_nonzero((ticks["flags"] & TICK_FLAG_SKIPPED) == 0)),
        warm_up_ticks=int(np.count_nonzero((ticks["flags"][: len(ticks) - len(kept)] & TICK_FLAG_SKIPPED) == 0)),
        duration_s=(int(ticks["tick"][-1]) + 1) * facts.period_ns * 1e-9 if len(ticks) else 0.0,
        skipped_count=int(kept["skipped_count"].sum()) + int(skipped.sum()),
        lost_count=int(lost.sum()),
        miss_count=sum(causes.values()),
        misses=misses,
        causes=causes,
        distributions={name: distributions[name] for name in HISTOGRAM_NAMES if name in distributions},
        loop=loop_distributions(run),
        worst_wake=[(int(number[k]), int(wake_lateness[k])) for k in worst],
        timeline=_timeline(
            number * (facts.period_ns * 1e-9),
            wake_lateness,
            np.where(skipped, 0, kept["end_mono_ns"] - kept["wake_mono_ns"]),
        ),
    )


class Samples:
    """Samples of one quantity taken batch by batch, ns; a run too long for them keeps none (its loop has counted them)."""

    def __init__(self) -> None:
        self._parts: list[np.ndarray] = []
        self._count = 0

    def take(self, values_ns: np.ndarray) -> None:
        """One batch, int64."""
        self._count += len(values_ns)
        if self._count <= EXACT_SAMPLES_MAX:
            self._parts.append(values_ns)
        else:
            self._parts.clear()

    @property
    def is_whole(self) -> bool:
        """Whether there are samples, and all of them were kept."""
        return 0 < self._count <= EXACT_SAMPLES_MAX

    def distribution(self, name: str) -> Distribution:
        """Exact statistics of a whole one."""
        return distribution(name, np.concatenate(self._parts), "ticks")


def distribution(name: str, values_ns: np.ndarray, source: str) -> Distribution:
    """Exact statistics of int64 samples, at least one, in ns."""
    ordered = np.sort(np.asarray(values_ns, np.int64))
    count = len(ordered)
    values = {"min": int(ordered[0])}
    for key, ratio in PERCENTILE_RATIOS.items():
        values[key] = int(ordered[rank(ratio, count) - 1])
    values["max"] = int(ordered[-1])
    row, extreme = histogram_of_sorted(ordered)
    return Distribution(name, count, values, float(ordered.mean()), row, extreme, source)


def rank(ratio: float, count: int) -> int:
    """Place, from 1, of the smallest sample that at least `ratio` of `count` samples do not exceed."""
    return min(count, max(1, int(np.ceil(ratio * count - 1e-9 * count))))


def histogram_of_sorted(ordered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows as base.histogram_scale makes them, from samples already in order (int64, ns)."""
    edges = np.searchsorted(ordered, histogram_scale.bucket_lower_ns()[1:], side="left")
    row = np.diff(np.concatenate(([0], edges, [len(ordered)]))).astype(np.int64)
    extreme = np.array([ordered[0], ordered[-1], ordered.sum(), len(ordered)], np.int64)
    return row, extreme


def with_skipped(wake_lateness: np.ndarray, skipped: np.ndarray, period_ns: int) -> np.ndarray:
    """The lateness of every scheduled period: those that ran, and k periods more for the k-th skipped before one."""
    late = np.flatnonzero(skipped)
    if not len(late):
        return wake_lateness
    counts = skipped[late].astype(np.int64)
    # each sample is a period more than the one before it, but the first behind a tick, which starts anew
    samples = np.full(int(counts.sum()), period_ns, np.int64)
    samples[0] += wake_lateness[late[0]]
    ends = np.cumsum(counts)[:-1]
    samples[ends] += wake_lateness[late[1:]] - wake_lateness[late[:-1]] - counts[:-1] * period_ns
    return np.concatenate([wake_lateness, np.cumsum(samples, out=samples)])


def _check_skipped(run: Run, skipped_count: int) -> None:
    """A count of skipped periods that no run can have would be as many samples."""
    if skipped_count > SKIPPED_PERIODS_MAX:
        raise LogError(
            str(run.path),
            f"/rt/tick tells of {skipped_count} skipped periods",
            f"{SKIPPED_PERIODS_MAX}",
            "the field skipped_count is damaged, or the host slept for hours: run again",
        )


def _command_ages(run: Run, facts: RunFacts) -> np.ndarray:
    parts = []
    for rows in run.command.values():
        ages = rows["age_ns"][rows["tick"] >= facts.warm_up_ticks]
        parts.append(ages[ages >= 0])
    return np.concatenate(parts) if parts else np.zeros(0, np.int64)


def loop_distributions(run: Run) -> dict[str, Distribution]:
    """The loop's own distributions: they know also of ticks that are not in the log, and a run without a log has nothing else."""
    found = {name: _from_attachment(run, name) for name in HISTOGRAM_NAMES}
    return {name: one for name, one in found.items() if one is not None}


def _from_attachment(run: Run, name: str) -> Distribution | None:
    """The loop's own histogram, whole, as the recorder attaches it at the end."""
    attached = run.attachments.get(HISTOGRAM_ATTACHMENT)
    try:
        table = json.loads(attached.text)
        scale = table["scale"]
        known = (scale["sub_bucket_bits"], scale["value_bits"])
        if known != (histogram_scale.SUB_BUCKET_BITS, histogram_scale.VALUE_BITS):
            return None
        row = np.zeros(histogram_scale.BUCKET_COUNT, np.int64)
        extreme = np.array(table[name]["extreme"], np.int64).reshape(4)
        buckets = np.array(table[name]["buckets"], np.int64).reshape(-1, 2)
        row[buckets[:, 0]] = buckets[:, 1]
    except (AttributeError, ValueError, KeyError, TypeError, IndexError, OverflowError, RecursionError):
        return None
    if not row.any() or row.min() < 0 or buckets[:, 0].min() < 0 or extreme.min() < 0:
        return None
    values = histogram_scale.percentiles(row, extreme)
    return Distribution(name, int(row.sum()), values, histogram_scale.mean_ns(extreme), row, extreme, _LOOP)


def _from_statistics(run: Run, name: str) -> Distribution | None:
    """The last row of /rt/statistics: percentiles of the whole run, without the samples."""
    if not len(run.statistics) or f"{name}_ns_max" not in run.statistics.dtype.names:
        return None
    newest = run.statistics[-1]
    values = {statistic: int(newest[f"{name}_ns_{statistic}"]) for statistic in records.STATISTIC_NAMES}
    if not any(values.values()):
        return None
    row, extreme = histogram_scale.empty(1)
    return Distribution(name, 0, values, float("nan"), row[0], extreme[0], _LOOP)


def _misses(run: Run, facts: RunFacts, kept: np.ndarray) -> tuple[list[Miss], dict[str, int]]:
    """Late ticks from /rt/miss, and those the ticks show but no row explains."""
    rows = run.miss[run.miss["lateness_ns"] > 0]
    flagged = kept[(kept["flags"] & TICK_FLAG_MISS) != 0]
    unexplained = flagged[~np.isin(flagged["tick"], rows["tick"])]
    causes = np.bincount(np.minimum(rows["cause"], len(status.CAUSE_NAMES) - 1), minlength=len(status.CAUSE_NAMES))
    counted = {status.CAUSE_NAMES[k]: int(n) for k, n in enumerate(causes) if n}
    if len(unexplained):
        counted["not explained in the log"] = len(unexplained)
    misses = [_explained(row, facts.period_ns) for row in rows[np.argsort(-rows["lateness_ns"])[:WORST_COUNT]]]
    late = unexplained["end_mono_ns"] - unexplained["deadline_mono_ns"] - facts.period_ns
    for k in np.argsort(-late)[:WORST_COUNT]:
        row = unexplained[k]
        tick = int(row["tick"])
        wake = int(row["wake_mono_ns"] - row["deadline_mono_ns"])
        execution = int(row["end_mono_ns"] - row["wake_mono_ns"])
        where = tick * facts.period_ns * 1e-9
        misses.append(Miss(tick, where, int(late[k]), wake, execution, 0, "not explained in the log", "", ""))
    misses.sort(key=lambda miss: -miss.lateness_ns)
    return misses[:WORST_COUNT], dict(sorted(counted.items(), key=lambda pair: -pair[1]))


def _explained(row: np.void, period_ns: int) -> Miss:
    phase = int(row["phase"])
    parts = [
        (int(row["page_faults_major"]), "major page faults"),
        (int(row["page_faults_minor"]), "minor page faults"),
        (int(row["switches_involuntary"]), "involuntary switches"),
        (int(row["frames_queued"]), "frames queued"),
    ]
    told = [f"{count} {name}" for count, name in parts if count]
    if row["cpu"] != row["cpu_before"]:
        told.append(f"core {row['cpu_before']} to {row['cpu']}")
    tick = int(row["tick"])
    return Miss(
        tick=tick,
        time_s=tick * period_ns * 1e-9,
        lateness_ns=int(row["lateness_ns"]),
        wake_lateness_ns=int(row["wake_lateness_ns"]),
        execution_ns=int(row["execution_ns"]),
        skipped_count=int(row["skipped_count"]),
        cause=status.CAUSE_NAMES[min(int(row["cause"]), len(status.CAUSE_NAMES) - 1)],
        phase="wake-up" if phase == records.PHASE_WAKE else status.PHASE_NAMES[min(phase, status.PHASE_COUNT - 1)],
        detail=", ".join(told),
    )


def _timeline(times_s: np.ndarray, wake_lateness: np.ndarray, execution: np.ndarray) -> Timeline:
    count = len(times_s)
    starts = np.unique(np.linspace(0, count, min(TIMELINE_BINS, count), endpoint=False).astype(np.int64))
    if not count:
        return Timeline(times_s, wake_lateness, execution)
    return Timeline(times_s[starts], np.maximum.reduceat(wake_lateness, starts), np.maximum.reduceat(execution, starts))
