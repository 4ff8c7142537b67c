"""The report as text for a terminal or a file."""

import math
from collections.abc import Sequence

from hilrunner.base.records import STATISTIC_NAMES
from hilrunner.evidence.coverage import coverage_sentences
from hilrunner.evidence.junit import number
from hilrunner.evidence.latency import TITLES
from hilrunner.evidence.report import Report
from hilrunner.evidence.verdict import DAMAGED, FAILED, NO_LIMITS, PASSED, Judgement, Verdict
from hilrunner.setup.limits import KEYS

COLUMN_TITLES = {
    "p50": "50 %",
    "p90": "90 %",
    "p99": "99 %",
    "p999": "99.9 %",
    "p9999": "99.99 %",
    "p99999": "99.999 %",
}
SHOWN_MISSES = 10


def report_text(report: Report) -> str:
    """The whole report."""
    parts = [
        _head(report),
        _verdict(report),
        _latency(report),
        _misses(report),
        _bus(report),
        _axes(report),
        _checks(report),
        _host(report),
        _provenance(report),
        _damage(report),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def align(rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Rows as columns: the first `left` flush left, the others flush right."""
    widths = [max(len(row[k]) for row in rows if k < len(row)) for k in range(max(len(row) for row in rows))]
    lines = []
    for row in rows:
        cells = [cell.ljust(widths[k]) if k < left else cell.rjust(widths[k]) for k, cell in enumerate(row)]
        lines.append("  " + "  ".join(cells).rstrip())
    return "\n".join(lines)


def us(value_ns: float) -> str:
    """Nanoseconds as microseconds with a sensible number of digits."""
    value = value_ns / 1000
    return f"{value:.2f}" if abs(value) < 100 else f"{value:.1f}" if abs(value) < 1e5 else f"{value:.0f}"


def latency_rows(report: Report) -> list[list[str]]:
    """Head and one row a quantity, all text, values in us."""
    rows = [["us", *(COLUMN_TITLES.get(name, name) for name in STATISTIC_NAMES), "mean", "samples"]]
    for name, one in report.latency.distributions.items():
        mean = us(one.mean_ns) if one.count else "-"
        rows.append(
            [
                TITLES[name],
                *(us(one.values_ns[key]) for key in STATISTIC_NAMES),
                mean,
                str(one.count) if one.count else "-",
            ]
        )
    return rows


def _head(report: Report) -> str:
    latency = report.latency
    lines = [
        f"{report.path}: profile {report.facts.profile_name}, {latency.duration_s:.3f} s in {latency.tick_count} ticks "
        f"of {latency.period_ns / 1000:g} us",
        f"mode: {report.facts.mode_label}; ended: {report.facts.exit_reason}",
    ]
    lines += [f"  because {reason}" for reason in report.facts.mode_reasons]
    return "\n".join(lines)


def _verdict(report: Report) -> str:
    verdict = report.verdict
    rows = [["limit", "outcome", "measured", "allowed", ""]]
    for one in verdict.judgements:
        rows.append([one.key, one.outcome, *judged_figures(one), judged_reason(one)])
    text = verdict_words(verdict)
    widths = [max(len(row[k]) for row in rows) for k in range(5)]
    table = [
        f"  {row[0].ljust(widths[0])}  {row[1].ljust(widths[1])}  {row[2].rjust(widths[2])}  {row[3].rjust(widths[3])}  {row[4]}".rstrip()
        for row in rows
    ]
    return f"verdict: {text}\n" + "\n".join(table)


def verdict_words(verdict: Verdict) -> str:
    """The outcome, and what it means where the word alone could be misread."""
    code = f" (exit code {verdict.exit_code})"
    return {
        PASSED: "passed",
        NO_LIMITS: "no limits set: nothing failed, and the profile names nothing that could have passed",
        DAMAGED: f"DAMAGED{code}: the log does not match its own checksums, so its figures prove nothing",
    }.get(verdict.outcome, f"FAILED{code}")


def judged_figures(one: Judgement) -> tuple[str, str]:
    """Measured value and limit with their unit; `yes` and `no` for what is no figure."""
    if one.key not in KEYS:
        return {PASSED: "yes", FAILED: "no"}.get(one.outcome, "not known"), "yes"
    unit = f" {one.unit}" if one.unit else ""
    return number(one.value) + ("" if math.isnan(one.value) else unit), number(one.limit) + unit


def judged_reason(one: Judgement) -> str:
    """Where the value stands, and over how much of the run it was judged."""
    return "; ".join(part for part in (one.detail, one.over) if part)


def _latency(report: Report) -> str:
    latency = report.latency
    notes = [f"latency (us; {latency.warm_up_ticks} warm-up ticks left out, skipped periods count as late wake-ups)"]
    notes.append(align(latency_rows(report)))
    return "\n".join(notes)


def _misses(report: Report) -> str:
    latency = report.latency
    if not latency.miss_count and not latency.skipped_count:
        return "deadlines: none missed, no period skipped"
    causes = ", ".join(f"{count} x {cause}" for cause, count in latency.causes.items())
    rows = [["tick", "at s", "late us", "wake us", "execution us", "skipped", "phase", "cause"]]
    for miss in latency.misses[:SHOWN_MISSES]:
        cause = f"{miss.cause} ({miss.detail})" if miss.detail else miss.cause
        values = [us(miss.lateness_ns), us(miss.wake_lateness_ns), us(miss.execution_ns), str(miss.skipped_count)]
        rows.append([str(miss.tick), f"{miss.time_s:.3f}", *values, miss.phase, cause])
    lines = [f"deadlines: {latency.miss_count} missed, {latency.skipped_count} periods skipped: {causes}"]
    widths = [max(len(row[k]) for row in rows) for k in range(8)]
    lines += [
        "  " + "  ".join(c.rjust(widths[k]) if k < 6 else c.ljust(widths[k]) for k, c in enumerate(row)).rstrip()
        for row in rows
    ]
    return "\n".join(lines)


def _bus(report: Report) -> str:
    bus = report.bus
    if not bus.received_count and not bus.sent_count:
        return "bus: no frames in the log"
    text = f"bus: {bus.received_count} frames received, {bus.sent_count} sent"
    if bus.bitrate:
        text += (
            f"; load at {bus.bitrate / 1000:g} kbit/s {bus.load_ratio_mean:.1%}, worst second {bus.load_ratio_max:.1%}"
            " (worst-case stuffing)"
        )
    rejected = ", ".join(f"{count} {name}" for name, count in bus.rejected.items())
    lines = [text]
    if rejected:
        lines.append(f"  not taken: {rejected}")
    if clamped := clamped_text(report):
        lines.append(f"  {clamped}")
    return "\n".join(lines)


def clamped_text(report: Report) -> str:
    """Which signals carried an end of their range because the value lay outside, and how often; empty: none."""
    told = ", ".join(f"{name} {count} times" for name, count in report.facts.clamped.items())
    return f"sent as the end of the signal's range, because the value lay outside: {told}" if told else ""


def _axes(report: Report) -> str:
    lines = []
    for axis in report.axes:
        lines.append(
            f"axis {axis.name}: rod {axis.position_mm_min:.2f} to {axis.position_mm_max:.2f} mm, up to "
            f"{axis.speed_mmps_max:.2f} mm/s; chambers {axis.pressure_mpa_min:.3f} to {axis.pressure_mpa_max:.3f} MPa"
        )
        lines += [f"  {sentence}" for sentence in axis_sentences(axis, report.latency.tick_count)]
    return "\n".join(lines)


def axis_sentences(axis, tick_count: int) -> list[str]:
    """What else there is to say of one axis."""
    told = []
    if axis.mode_ticks:
        told.append("modes: " + ", ".join(f"{name} {count} ticks" for name, count in axis.mode_ticks.items()))
    if axis.flag_ticks:
        share = ", ".join(
            f"{name} {count} ({count / max(tick_count, 1):.2%})" for name, count in axis.flag_ticks.items()
        )
        told.append(f"flagged ticks: {share}")
    if axis.fail_safe_ms:
        times = ", ".join(f"{time:.1f}" for time in axis.fail_safe_ms[:10])
        told.append(f"fail-safe entered {len(axis.fail_safe_ms)} times, ms after the last valid command: {times}")
    if axis.stop_count:
        told.append(
            f"{axis.stop_count} stops, settled within {number(axis.settling_ms_max)} ms, {axis.unsettled_count} not settled"
        )
    if axis.tracking_mm_max == axis.tracking_mm_max:  # not NaN
        told.append(
            f"distance from the reference motion: {axis.tracking_mm_rms:.3f} mm RMS, {axis.tracking_mm_max:.3f} mm at most"
        )
    return told


def check_rows(check) -> list[list[str]]:
    """Head and one row a quantity of one axis' cross-check."""
    rows = [["", "max", "RMS", "one-step max", "one-step RMS", "worst at tick", "unit"]]
    for error in check.errors:
        values = [f"{value:.3g}" for value in (error.max, error.rms, error.one_step_max, error.one_step_rms)]
        rows.append([error.quantity, *values, str(error.worst_tick), error.unit])
    return rows


def _checks(report: Report) -> str:
    if not report.checks:
        return "cross-check: none in the log"
    parts = []
    for check in report.checks:
        state = (
            f"{check.failed_count} out of tolerance, first at tick {check.first_failed_tick}"
            if check.failed_count
            else "all within tolerance"
        )
        parts.append(
            f"cross-check of {check.axis} against the first-principle model: {check.tick_count} ticks, {state}; "
            f"at most {check.lag_ms_max:.0f} ms behind the loop\n" + align(check_rows(check))
        )
    return "\n".join(parts)


def _host(report: Report) -> str:
    lines = [f"  {finding.verdict:4s}  {finding.name}: {finding.value}" for finding in report.facts.findings]
    lines += [
        f"  {'ok' if grant['granted'] else 'no':4s}  {grant['name']}: asked {grant['asked']}, got {grant['got']}"
        for grant in report.facts.grants
    ]
    head = ", ".join(report.facts.host[key] for key in ("processor", "cores", "kernel") if key in report.facts.host)
    return "\n".join([f"host: {head or 'not told'}", *lines])


def _provenance(report: Report) -> str:
    rows = [[key, value] for key, value in report.facts.provenance.items()]
    rows += [
        [f"attachment {name}", f"{size} bytes, sha256 {digest[:16]}…"]
        for name, (size, digest) in report.attachments.items()
    ]
    return "provenance:\n" + align(rows, left=2) if rows else ""


def _damage(report: Report) -> str:
    lines = [f"  {text}" for text in (*coverage_sentences(report.coverage), *report.facts.notes, *report.damage)]
    if report.foreign_topics:
        lines.append(f"  topics of others, not read: {', '.join(report.foreign_topics)}")
    return "\n".join(["what the log lacks:", *lines]) if lines else ""
