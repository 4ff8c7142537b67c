"""From a log that was read to what is judged of it: report, replay and the run itself all come this way."""

from hilrunner.evidence.bus import BusTally, BusUse
from hilrunner.evidence.check_use import CheckTally, CheckUse
from hilrunner.evidence.coverage import Coverage, coverage_of
from hilrunner.evidence.facts import RunFacts
from hilrunner.evidence.latency import Latency, measure_latency
from hilrunner.evidence.limit_measures import Measured
from hilrunner.evidence.plant_use import AxisUse, measure_plant
from hilrunner.evidence.reader import Run
from hilrunner.evidence.requirement_use import judged_requirements
from hilrunner.evidence.stalls import logged_stall_problem
from hilrunner.evidence.verdict import Subject, Verdict, judge
from hilrunner.setup.limits import SETTLING_SPEED_MMPS
from hilrunner.setup.profile import StallLimit
from hilrunner.setup.run_manifest import STIMULUS_ATTACHMENT


def subject_of(
    run: Run,
    facts: RunFacts,
    latency: Latency,
    bus: BusUse,
    axes: list[AxisUse],
    checks: list[CheckUse],
    ran_ticks: int | None = None,
) -> Subject:
    """What `verdict.judge` needs of a log.

    Args:
        ran_ticks: ticks that ran, where somebody knows better than the log (the runner, of a recorder that died).
    """
    coverage = coverage_of(run, bus, checks, ran_ticks)
    names = tuple(axis.name for axis in facts.profile.axis) if facts.profile else run.axis_names
    return Subject(
        exit_reason=facts.exit_reason,
        limits=facts.limits,
        measured=Measured(latency, bus, axes, checks, coverage, names),
        profile_problem=facts.profile_problem,
        mismatches=run.mismatches,
        missing_fields=run.missing_fields,
        silent_axes=silent_axes(run, facts, axes, names),
        requirements=judged_requirements(run, facts),
        stall_problem=logged_stall_problem(run.metadata.get("run", {}), stall_limit(facts)),
    )


def stall_limit(facts: RunFacts) -> StallLimit:
    """The profile's limit on stalls, or the usual one."""
    return facts.profile.deadline.stall_ms if facts.profile else StallLimit()


def verdict_of(run: Run, facts: RunFacts) -> tuple[Verdict, Coverage]:
    """The judgement of a log that was read with all columns."""
    frames, checked = BusTally(), CheckTally()
    for topic, rows in run.topics.items():
        if topic in ("/can/rx", "/can/tx"):
            frames(topic, rows)
        elif topic.endswith("/check"):
            checked(topic, rows)
    latency = measure_latency(run, facts, frames.responses_ns(facts.warm_up_ticks))
    speed = facts.limits.get("settling_speed_mmps", SETTLING_SPEED_MMPS)
    axes = measure_plant(run, facts, speed)
    subject = subject_of(run, facts, latency, frames.result(facts.bitrate), axes, checked.results(facts.period_ns))
    return judge(subject), subject.measured.coverage


def silent_axes(run: Run, facts: RunFacts, axes: list[AxisUse], names: tuple[str, ...]) -> tuple[str, ...] | None:
    """Axes that no firmware has commanded, in a run that waits for one; None for any other run."""
    if facts.profile is not None and not facts.profile.bench.require_firmware:
        return None
    if STIMULUS_ATTACHMENT in run.attachments or "stimulus" in run.metadata.get("run", {}):
        return None
    heard = {axis.name for axis in axes if axis.heard_ticks}
    heard |= {key.rpartition(".")[0] for key in run.metadata.get("frames", {}) if key.endswith(".valid")}
    return tuple(name for name in names if name not in heard)
