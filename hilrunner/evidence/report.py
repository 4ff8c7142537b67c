"""Everything a report says about one run, gathered once; text, JSON, `.hgrm` and HTML are views of it."""

import hashlib
import math
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from hilrunner.base import histogram_scale
from hilrunner.base.errors import LogError
from hilrunner.base.plain_text import plain_keys, plain_line
from hilrunner.base.units import M_PER_MM
from hilrunner.evidence.bus import BusTally, BusUse
from hilrunner.evidence.check_use import CheckTally, CheckUse
from hilrunner.evidence.coverage import Coverage, coverage_dict
from hilrunner.evidence.facts import RunFacts, read_facts
from hilrunner.evidence.judging import subject_of
from hilrunner.evidence.latency import Latency, measure_latency
from hilrunner.evidence.plant_use import AxisUse, measure_plant
from hilrunner.evidence.reader import Columns, Event, Run, read_run
from hilrunner.evidence.signature import signature_judgements
from hilrunner.evidence.verdict import Verdict, judge
from hilrunner.record.memory import memory_bytes_max
from hilrunner.setup.csv_text import number, read_table, shown
from hilrunner.setup.limits import SETTLING_SPEED_MMPS
from hilrunner.setup.text import read_text

COLUMNS: Columns = {
    "/rt/tick": (
        "tick",
        "deadline_mono_ns",
        "wake_mono_ns",
        "end_mono_ns",
        "receive_ns",
        "decode_ns",
        "step_ns",
        "encode_ns",
        "record_ns",
        "skipped_count",
        "flags",
    ),
    "/rt/miss": None,
    "/rt/statistics": None,
    "/can/*": BusTally.COLUMNS,
    "/*/command": ("tick", "valve_command", "age_ns", "mode"),
    "/*/state": (
        "tick",
        "rod_position_m",
        "rod_velocity_mps",
        "chamber_1_pressure_pa",
        "chamber_2_pressure_pa",
        "flags",
    ),
    "/*/check": CheckTally.COLUMNS,
}  # what a report needs; the rest of an hour's log is never in memory
_FOREIGN_SHOWN = 20


@dataclass(frozen=True)
class Report:
    """One run, measured and judged."""

    path: Path
    size_bytes: int
    facts: RunFacts
    latency: Latency
    bus: BusUse
    axes: list[AxisUse]
    checks: list[CheckUse]
    coverage: Coverage
    verdict: Verdict
    attachments: dict[str, tuple[int, str]]  # name -> bytes, sha256
    events: tuple[Event, ...]
    damage: tuple[str, ...]
    foreign_topics: tuple[str, ...]
    library: str

    def __post_init__(self) -> None:
        """Names in the log are shown to people, and a log comes from anywhere."""
        topics = tuple(map(plain_line, self.foreign_topics[:_FOREIGN_SHOWN]))
        if len(self.foreign_topics) > _FOREIGN_SHOWN:
            topics += (f"and {len(self.foreign_topics) - _FOREIGN_SHOWN} more",)
        object.__setattr__(self, "foreign_topics", topics)
        object.__setattr__(self, "library", plain_line(self.library))
        object.__setattr__(self, "attachments", plain_keys(self.attachments))


@dataclass(frozen=True)
class RunnerKnows:
    """What is known of a run beside its log: it matters where the recorder died before it could write it down."""

    ran_ticks: int
    exit_reason: str  # of status.EXIT_NAMES


@np.errstate(all="ignore")  # a damaged log holds numbers of any size: what comes of them is shown, not warned of
def build_report(
    path: str | Path,
    reference_path: str | Path | None = None,
    knows: RunnerKnows | None = None,
    signed_by: Path | None = None,
) -> Report:
    """Read, measure and judge a run.

    Args:
        path: the log, in any state.
        reference_path: CSV of the motion the rod was to follow (see `read_reference`), in place of the profile's wave.
        knows: what the runner adds to the log of the run that it has just ended; it has no signature yet.
        signed_by: file of the public key that must have signed the log; None: a signature beside it is verified, if there is one.

    Raises LogError when the log or the reference cannot be read at all.
    """
    frames, checked = BusTally(), CheckTally()
    run = read_run(path, COLUMNS, {"/can/*": frames, "/*/check": checked})
    facts = read_facts(run)
    latency = measure_latency(run, facts, frames.responses_ns(facts.warm_up_ticks))
    if latency.miss_count:
        facts = read_facts(run, latency.miss_count)
    if knows is not None:
        facts = replace(facts, exit_reason=knows.exit_reason)
    bus = frames.result(facts.bitrate)
    reference = read_reference(reference_path, run) if reference_path else None
    speed = facts.limits.get("settling_speed_mmps", SETTLING_SPEED_MMPS)
    axes = measure_plant(run, facts, speed, reference)
    checks = checked.results(facts.period_ns)
    subject = subject_of(run, facts, latency, bus, axes, checks, None if knows is None else knows.ran_ticks)
    return Report(
        path=Path(path),
        size_bytes=run.size_bytes,
        facts=facts,
        latency=latency,
        bus=bus,
        axes=axes,
        checks=checks,
        coverage=subject.measured.coverage,
        verdict=judge(subject).joined(signature_judgements(Path(path), signed_by) if knows is None else []),
        attachments={
            name: (len(one.data), hashlib.sha256(one.data).hexdigest()) for name, one in run.attachments.items()
        },
        events=run.events,
        damage=run.damage,
        foreign_topics=run.foreign_topics,
        library=run.library,
    )


def read_reference(path: str | Path, run: Run) -> dict[str, np.ndarray]:
    """A reference motion from CSV: a header `time_s,<axis>_mm[,…]` or `time_s,rod_position_mm` for every axis, then numbers.

    Time counts from tick 0. Returns axis -> float64[n, 2], s and m. Raises LogError.
    """
    place = str(path)
    head, rows = _reference_rows(place, read_text(Path(path), LogError, "name a CSV file with the motion"))
    if len(head) < 2 or head[0] != "time_s" or not np.isfinite(rows).all():
        raise LogError(place, f"columns {', '.join(head)}", "time_s, then <axis>_mm or rod_position_mm, finite numbers")
    if np.any(np.diff(rows[:, 0]) <= 0):
        raise LogError(place, "times do not increase", "time_s in increasing order")
    reference = {}
    for axis in run.axis_names:
        name = next((one for one in (f"{axis}_mm", "rod_position_mm") if one in head), None)
        if name is not None:
            reference[axis] = np.column_stack((rows[:, 0], rows[:, head.index(name)] * M_PER_MM))
    if not reference:
        wanted = ", ".join(f"{axis}_mm" for axis in run.axis_names)
        raise LogError(place, f"no column for an axis of the run: {', '.join(head)}", f"{wanted} or rod_position_mm")
    return reference


def _reference_rows(place: str, text: str) -> tuple[list[str], np.ndarray]:
    """Names of the columns and their numbers, float64[row, column]."""
    try:
        table = read_table(text)
    except ValueError as error:
        raise LogError(place, f"not a table: {error}", "CSV with a header line", "mend the quotes") from None
    rows = np.empty((len(table.rows), len(table.header)))
    for index, (line, cells) in enumerate(table.rows):
        try:
            rows[index] = [number(cell) for cell, _ in zip(cells, table.header, strict=True)]
        except ValueError:
            raise LogError(
                f"{place}: row {line}", f"{shown(cells)} is not {len(table.header)} numbers",
                f"a number for each of {', '.join(table.header)}", "correct the row",
            ) from None  # fmt: skip
    if not len(rows):
        raise LogError(place, "cannot be read as a reference motion: it has no rows", "CSV with a header line")
    return table.header, rows


def as_dict(report: Report) -> dict:
    """The report as plain JSON values; NaN and infinity become null."""
    latency = report.latency
    table = {
        "log": str(report.path),
        "size_bytes": report.size_bytes,
        "profile": report.facts.profile_name,
        "mode": report.facts.mode_label,
        "mode_reasons": list(report.facts.mode_reasons),
        "exit_reason": report.facts.exit_reason,
        "verdict": report.verdict.as_dict(),
        "coverage": coverage_dict(report.coverage),
        "latency": {
            "period_ns": latency.period_ns,
            "tick_count": latency.tick_count,
            "warm_up_ticks": latency.warm_up_ticks,
            "duration_s": latency.duration_s,
            "miss_count": latency.miss_count,
            "skipped_count": latency.skipped_count,
            "lost_count": latency.lost_count if report.coverage.ticks.lost is None else report.coverage.ticks.lost,
            "causes": latency.causes,
            "worst_misses": [asdict(miss) for miss in latency.misses],
            "worst_wake": [{"tick": tick, "wake_lateness_ns": value} for tick, value in latency.worst_wake],
            "distributions_ns": {
                name: {**one.values_ns, "mean": one.mean_ns, "count": one.count, "source": one.source}
                for name, one in latency.distributions.items()
            },
        },
        "bus": {key: value for key, value in asdict(report.bus).items() if key != "load_per_s"}
        | {"clamped": report.facts.clamped},
        "axes": [{key: value for key, value in asdict(axis).items() if key != "traces"} for axis in report.axes],
        "cross_check": [{key: value for key, value in asdict(one).items() if key != "traces"} for one in report.checks],
        "host": {
            "facts": report.facts.host,
            "findings": [finding.as_dict() for finding in report.facts.findings],
            "grants": list(report.facts.grants),
        },
        "provenance": report.facts.provenance,
        "attachments": {
            name: {"size_bytes": size, "sha256": digest} for name, (size, digest) in report.attachments.items()
        },
        "notes": list(report.facts.notes),
        "damage": list(report.damage),
        "foreign_topics": list(report.foreign_topics),
        "written_by": report.library,
    }
    return finite(table)


def finite(value):
    """The same values with NaN and infinity as None, which JSON has."""
    if isinstance(value, dict):
        return {key: finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def hgrm_texts(report: Report) -> dict[str, str]:
    """Quantity -> percentile distribution as HdrHistogram writes it, in us; quantities without samples are left out."""
    return {
        name: histogram_scale.hgrm(one.row, one.extreme)
        for name, one in report.latency.distributions.items()
        if one.row.any()
    }


@dataclass(frozen=True)
class Cost:
    """What a command used so far."""

    wall_s: float
    memory_bytes_max: int

    def sentence(self, what: str) -> str:
        """`report of … in 3.2 s with at most 410 MB`."""
        return f"{what} in {self.wall_s:.1f} s with at most {self.memory_bytes_max / 1e6:.0f} MB of memory"


def cost_since(begin_mono_ns: int) -> Cost:
    """Wall time since `begin_mono_ns` and the largest resident memory of this process."""
    return Cost((time.monotonic_ns() - begin_mono_ns) * 1e-9, memory_bytes_max())
