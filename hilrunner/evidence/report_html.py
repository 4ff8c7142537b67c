"""The latency report and verdict as one self-contained HTML page."""

import html

import numpy as np

from hilrunner.base import histogram_scale
from hilrunner.base.units import NS_PER_US
from hilrunner.evidence import page
from hilrunner.evidence.coverage import coverage_sentences
from hilrunner.evidence.latency import TITLES, Distribution
from hilrunner.evidence.report import Report
from hilrunner.evidence.report_text import (
    axis_sentences,
    check_rows,
    judged_figures,
    judged_reason,
    latency_rows,
    us,
    verdict_words,
)
from hilrunner.evidence.svg import Axis, Chart
from hilrunner.evidence.verdict import FAILED, NO_LIMITS, PASSED, Verdict
from hilrunner.setup import host

_OUTCOME = {PASSED: "good", FAILED: "bad"}
_FINDING = {"ok": "good", "warn": "warn", "fail": "bad"}
_PHASES = ("receive", "decode", "step", "encode", "record")
_WIDE = 1060


@np.errstate(all="ignore")
def report_html(report: Report) -> str:
    """The whole document."""
    sections = [
        page.section("Verdict", verdict_table(report.verdict)),
        page.section("Latency", _latency(report)),
        page.section("Deadlines", _deadlines(report)),
        page.section("Bus", _bus(report)),
        *[page.section(f"Axis {axis.name}", _axis(axis, report)) for axis in report.axes],
        page.section("Cross-check with the first-principle model", _checks(report)),
        page.section("Host", _host(report)),
        page.section("Provenance", _provenance(report)),
    ]
    if report.damage or report.facts.notes or report.foreign_topics or coverage_sentences(report.coverage):
        sections.insert(0, page.section("What this log lacks", _damage(report)))
    return page.page(f"Run report: {report.path.name}", _lead(report), sections)


def mode_chip(label: str) -> str:
    """The mode label, coloured by how much it claims."""
    kind = {host.LABEL_VERIFIED: "good", host.LABEL_BEST_EFFORT: "warn"}.get(label, "plain")
    return page.chip(label, kind)


def verdict_chip(verdict: Verdict) -> str:
    """The outcome, coloured; a run without limits is neither good nor bad."""
    kind = {PASSED: "good", NO_LIMITS: "plain"}.get(verdict.outcome, "bad")
    return page.chip(f"verdict: {verdict.outcome}", kind)


def _lead(report: Report) -> str:
    latency = report.latency
    outcome = verdict_chip(report.verdict)
    wake, execution = latency.distributions.get("wake_lateness"), latency.distributions.get("execution")
    lead = (
        f"<p>{outcome} {mode_chip(report.facts.mode_label)} "
        f'<span class="quiet">profile {html.escape(report.facts.profile_name)}, ended: {html.escape(report.facts.exit_reason)}</span></p>'
    )
    return lead + page.tiles(
        [
            ("duration", f"{latency.duration_s:.1f} s", f"{latency.tick_count} ticks of {latency.period_ns / 1000:g} us"),
            ("deadlines missed", str(latency.miss_count), f"{latency.skipped_count} periods skipped"),
            ("worst wake-up", f"{us(wake.values_ns['max'])} us" if wake else "-", f"99.9 %: {us(wake.values_ns['p999'])} us" if wake else ""),
            ("worst execution", f"{us(execution.values_ns['max'])} us" if execution else "-", f"half of ticks: {us(execution.values_ns['p50'])} us" if execution else ""),
            ("frames", f"{report.bus.received_count + report.bus.sent_count}", f"{sum(report.bus.rejected.values())} not taken"),
            ("ticks out of cross-check", _failed_checks(report), f"{sum(c.tick_count for c in report.checks)} checked"),
        ]
    )  # fmt: skip


def _failed_checks(report: Report) -> str:
    return str(sum(check.failed_count for check in report.checks)) if report.checks else "-"


def verdict_table(verdict: Verdict) -> str:
    """Every judgement with its figures."""
    rows = [
        (one.key, page.chip(one.outcome, _OUTCOME.get(one.outcome, "warn")), *judged_figures(one), one.doc, judged_reason(one))
        for one in verdict.judgements
    ]  # fmt: skip
    head = ("limit", "outcome", "measured", "allowed", "meaning", "")
    text = page.table(head, rows, numbers_from=9, raw=frozenset({1}))
    return page.paragraph(f"{verdict_words(verdict)}.") + text


def _latency(report: Report) -> str:
    rows = latency_rows(report)
    distributions = report.latency.distributions
    charts = [
        histogram_chart(distributions[name])
        for name in ("wake_lateness", "execution", "period", "response", "command_age")
        if name in distributions and np.count_nonzero(distributions[name].row) > 1
    ]
    lead = (
        f"From {report.latency.tick_count} logged ticks, of which {report.latency.warm_up_ticks} are warm-up and left out. "
        "A skipped period counts as a wake-up as late as the next tick that ran."
    )
    return (
        page.paragraph(lead, "quiet")
        + page.table(rows[0], rows[1:])
        + page.figures(_percentile_chart(distributions), _phase_chart(distributions), *charts)
    )


def histogram_chart(one: Distribution) -> str:
    """Samples over time in us, both axes logarithmic, on the scale of base.histogram_scale."""
    used = np.flatnonzero(one.row)
    bounds = np.append(histogram_scale.bucket_lower_ns(), histogram_scale.VALUE_NS_MAX + 1)
    # neighbouring buckets are joined to at most eighty columns, so that each is wide enough to see
    first, last = int(used[0]), int(used[-1])
    stride = -(-(last + 1 - first) // 80)
    edges = bounds[np.minimum(np.arange(first, last + stride + 1, stride), len(bounds) - 1)].astype(np.float64)
    edges[0] = max(edges[0], 0.5)
    column = (used - first) // stride
    counts = np.bincount(column, weights=one.row[used], minlength=len(edges) - 1)
    x = Axis("us", edges[0] / NS_PER_US, edges[-1] / NS_PER_US, log=True)
    y = Axis("samples", 0.5, max(float(counts.max()) * 1.6, 10.0), log=True)
    heights = np.where(counts > 0, counts, 0.5)
    return Chart(f"{TITLES[one.name]}: {one.count} samples", x, y).steps(edges / NS_PER_US, heights).svg()


def _percentile_chart(distributions: dict[str, Distribution]) -> str:
    """Value over percentile, as HdrHistogram plots it."""
    chosen = [name for name in ("wake_lateness", "execution", "response") if name in distributions]
    chosen = [name for name in chosen if distributions[name].row.any()]
    if not chosen:
        return ""
    top = max(distributions[name].values_ns["max"] for name in chosen) / NS_PER_US
    bottom = min(max(distributions[name].values_ns["min"], 1000) for name in chosen) / NS_PER_US
    longest = max(distributions[name].count for name in chosen)
    chart = Chart(
        "How late, how seldom", Axis("one in … samples is worse", 1.0, float(max(longest, 10)), log=True), Axis("us", bottom, top * 1.2, log=True)
    )  # fmt: skip
    for colour, name in enumerate(chosen, start=1):
        one = distributions[name]
        used = np.flatnonzero(one.row)
        reached = np.cumsum(one.row[used])
        value = np.minimum(histogram_scale.bucket_upper_ns()[used], one.values_ns["max"]) / NS_PER_US
        rarity = one.count / np.maximum(one.count - reached, 1)
        chart.line(rarity, value, colour, TITLES[name].split(" (")[0])
    return chart.svg()


def _phase_chart(distributions: dict[str, Distribution]) -> str:
    """Each phase of a tick from its median to its worst."""
    present = [name for name in _PHASES if name in distributions]
    if not present:
        return ""
    top = max(distributions[name].values_ns["max"] for name in present) / NS_PER_US
    low = min(max(distributions[name].values_ns["p50"], 100) for name in present) / NS_PER_US / 3
    chart = Chart(
        "Phases of a tick", Axis("one in … samples is worse", 1.0, 1e6, log=True), Axis("us", low, top * 1.3, log=True)
    )
    rarity = [2.0, 10.0, 100.0, 1e3, 1e4, 1e5]
    for colour, name in enumerate(present, start=1):
        one = distributions[name]
        values = [one.values_ns[key] / NS_PER_US for key in ("p50", "p90", "p99", "p999", "p9999", "p99999")]
        kept = [(r, v) for r, v in zip(rarity, values, strict=True) if r <= one.count] + [
            (float(one.count), one.values_ns["max"] / NS_PER_US)
        ]
        chart.line([r for r, _ in kept], [v for _, v in kept], colour, TITLES[name])
    return chart.svg()


def _deadlines(report: Report) -> str:
    latency = report.latency
    line = latency.timeline
    parts = []
    if len(line.times_s):
        late = [miss.lateness_ns + latency.period_ns for miss in latency.misses]
        top = max([float(line.wake_lateness_ns.max()), float(line.execution_ns.max()), *late, 1000.0]) / NS_PER_US
        low = max(min(float(line.wake_lateness_ns.min()), float(line.execution_ns.min())), 100.0) / NS_PER_US
        x = Axis("time, s", 0.0, float(line.times_s[-1]) or 1.0)
        chart = Chart(
            "Largest in each stretch of the run; misses marked",
            x,
            Axis("us", low * 0.8, top * 1.5, log=True),
            _WIDE,
            300,
        )
        chart.line(line.times_s, line.wake_lateness_ns / NS_PER_US, 1, "wake-up lateness")
        chart.line(line.times_s, line.execution_ns / NS_PER_US, 3, "execution")
        chart.level(latency.period_ns / NS_PER_US, "period")
        if latency.misses:
            hints = [f"tick {m.tick}: {us(m.lateness_ns)} us late, {m.cause}" for m in latency.misses]
            ends = [value / NS_PER_US for value in late]
            chart.points(
                [m.time_s for m in latency.misses], ends, 4, "worst misses, end after their tick's begin", hints
            )
        parts.append(chart.svg())
    if not latency.miss_count and not latency.skipped_count:
        return "".join(parts) + page.paragraph("No deadline was missed, no period skipped.")
    causes = ", ".join(f"{count} × {cause}" for cause, count in latency.causes.items())
    parts.append(page.paragraph(f"{latency.miss_count} missed, {latency.skipped_count} periods skipped: {causes}."))
    rows = [
        (str(m.tick), f"{m.time_s:.3f}", us(m.lateness_ns), us(m.wake_lateness_ns), us(m.execution_ns), m.phase, m.cause, m.detail)
        for m in latency.misses
    ]  # fmt: skip
    head = ("tick", "at, s", "late, us", "wake-up, us", "execution, us", "phase", "suspected cause", "seen")
    return "".join(parts) + page.table(head, rows, numbers_from=9)


def _bus(report: Report) -> str:
    bus = report.bus
    if not bus.received_count and not bus.sent_count:
        return page.paragraph("No frames in the log.")
    rows = [(name, str(count["received"]), str(count["sent"])) for name, count in bus.by_id.items()]
    text = ""
    if bus.bitrate:
        text = (
            f"Load at {bus.bitrate / 1000:g} kbit/s: {bus.load_ratio_mean:.1%} on average, {bus.load_ratio_max:.1%} in the worst second "
            "(worst-case bit stuffing; a virtual bus has no bit rate of its own)."
        )
    told = page.paragraph(text) + page.table(("id", "received", "sent"), rows)
    if bus.rejected:
        told += page.paragraph(
            "Received but not taken: " + ", ".join(f"{n} {name}" for name, n in bus.rejected.items()) + "."
        )
    if len(bus.load_per_s) < 2:
        return told
    x = Axis("time, s", 0.0, float(len(bus.load_per_s)))
    y = Axis("% of the bus", 0.0, max(100.0 * float(bus.load_per_s.max()) * 1.2, 1.0))
    pick = np.unique(np.linspace(0, len(bus.load_per_s) - 1, 600).astype(np.int64))
    return told + Chart("Bus load by second", x, y, _WIDE, 200).line(pick + 0.5, 100 * bus.load_per_s[pick], 6).svg()


def _axis(axis, report: Report) -> str:
    limits = report.facts.limits
    trace = axis.traces
    x = lambda: Axis("time, s", float(trace["time_s"][0]), float(trace["time_s"][-1]))  # noqa: E731
    targets = [trace["target_mm"]] if "target_mm" in trace else []
    position = Chart("Rod position", x(), span("mm", [trace["position_mm"], *targets])).line(
        trace["time_s"], trace["position_mm"], 1, "rod"
    )
    if targets:
        position.line(trace["time_s"], trace["target_mm"], 2, "reference motion", dashed=True)
    pressures = [trace["chamber_1_mpa"], trace["chamber_2_mpa"]]
    pressure = Chart("Chamber pressures", x(), span("MPa", pressures))
    pressure.line(trace["time_s"], pressures[0], 1, "chamber 1 (bore)").line(
        trace["time_s"], pressures[1], 2, "chamber 2 (rod)"
    )
    if "pressure_mpa_max" in limits:
        pressure.level(limits["pressure_mpa_max"], "limit")
    charts = [position.svg(), pressure.svg()]
    if "valve" in trace:
        charts.append(
            Chart("Valve command", x(), Axis("-1 … 1", -1.05, 1.05)).line(trace["time_s"], trace["valve"], 3).svg()
        )
    rows = [
        ("rod position, mm", f"{axis.position_mm_min:.3f}", f"{axis.position_mm_max:.3f}"),
        ("rod speed, mm/s", "", f"{axis.speed_mmps_max:.3f}"),
        ("chamber pressure, MPa", f"{axis.pressure_mpa_min:.4f}", f"{axis.pressure_mpa_max:.4f}"),
        ("valve command", f"{axis.command_min:.4f}", f"{axis.command_max:.4f}"),
        ("command age while active, ms", "", f"{axis.command_age_ms_max_active:.3f}"),
    ]
    sentences = page.bullets(axis_sentences(axis, report.latency.tick_count))
    return page.table(("", "smallest", "largest"), rows) + sentences + page.figures(*charts)


def span(title: str, series: list[np.ndarray], margin: float = 0.08) -> Axis:
    """A linear axis that holds all finite values with a margin."""
    values = np.concatenate([one[np.isfinite(one)] for one in series])
    if not len(values):
        return Axis(title, 0.0, 1.0)
    low, high = float(values.min()), float(values.max())
    extra = (high - low) * margin
    return Axis(title, low - extra, high + extra)


def _checks(report: Report) -> str:
    if not report.checks:
        return page.paragraph("The log holds no cross-check.", "quiet")
    parts = []
    for check in report.checks:
        rows = check_rows(check)
        state = (
            "all within tolerance"
            if not check.failed_count
            else f"{check.failed_count} out of tolerance, first at tick {check.first_failed_tick}"
        )
        parts.append(
            page.paragraph(
                f"Axis {check.axis}: {check.tick_count} ticks checked during the run, {state}; at most {check.lag_ms_max:.0f} ms behind the loop."
            )
        )
        parts.append(page.table(rows[0], rows[1:]))
        charts = []
        for names, unit in ((("chamber 1 pressure", "chamber 2 pressure"), "MPa"), (("rod position",), "mm")):
            series = [check.traces[name] for name in names]
            top = max(float(one[np.isfinite(one)].max(initial=0.0)) for one in series)
            if top <= 0:
                continue
            x = Axis("time, s", float(check.traces["time_s"][0]), float(check.traces["time_s"][-1]))
            chart = Chart(f"Distance from the reference, {unit}", x, Axis(unit, top * 1e-4, top * 1.5, log=True))
            for colour, (name, values) in enumerate(zip(names, series, strict=True), start=1):
                chart.line(check.traces["time_s"], values, colour, name)
            charts.append(chart.svg())
        parts.append(page.figures(*charts))
    return "".join(parts)


def _host(report: Report) -> str:
    facts = report.facts
    parts = [f"<p>{mode_chip(facts.mode_label)}</p>"]
    if facts.mode_reasons:
        parts.append(page.bullets(facts.mode_reasons))
    if facts.findings:
        rows = [
            (page.chip(f.verdict, _FINDING.get(f.verdict, "plain")), f.name, f.value, f.remedy) for f in facts.findings
        ]
        parts.append(page.table(("", "finding", "value", "remedy"), rows, numbers_from=9, raw=frozenset({0})))
    if facts.grants:
        rows = [
            (page.chip("granted" if g["granted"] else "refused", "good" if g["granted"] else "warn"), g["name"], g["asked"], g["got"], g["reason"])
            for g in facts.grants
        ]  # fmt: skip
        parts.append(page.table(("", "right", "asked", "got", "reason"), rows, numbers_from=9, raw=frozenset({0})))
    return "".join(parts) + page.facts(facts.host.items())


def _provenance(report: Report) -> str:
    rows = [(name, str(size), digest) for name, (size, digest) in report.attachments.items()]
    told = page.facts([("log", str(report.path)), ("written by", report.library), *report.facts.provenance.items()])
    return told + (page.table(("attachment", "bytes", "sha256"), rows, numbers_from=9) if rows else "")


def _damage(report: Report) -> str:
    texts = [*coverage_sentences(report.coverage), *report.facts.notes, *report.damage]
    if report.foreign_topics:
        texts.append(f"topics of others, not read: {', '.join(report.foreign_topics)}")
    return page.bullets(texts, "warn")
