"""The one judgement of a run: how it ended, what of it is in the log, the cross-check, each limit of its profile.

Run, report, replay, JUnit, the pages and the exit codes are views of what `judge` says (docs/verdict.md). What cannot be judged
fails: a pass must be shown, never assumed.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from hilrunner.base import exit_codes, status
from hilrunner.evidence.coverage import Coverage
from hilrunner.evidence.limit_measures import EXPLAINING, Measured, measure
from hilrunner.requirements.verdict import Judged
from hilrunner.setup.limits import DEFAULTS, KEYS, unit_of

# of one judgement, and of the whole: a run without limits has nothing that it could pass
PASSED, FAILED, NOT_JUDGED = "passed", "failed", "not judged"
NO_LIMITS, DAMAGED = "no limits set", "damaged"
# what a run is judged by: its log, all its records while they passed by (evidence.tally), or the loop's counters alone
LOG, MEMORY, COUNTERS = "log", "memory", "counters"
_PLANNED = tuple(
    status.EXIT_NAMES[code] for code in (status.EXIT_DURATION, status.EXIT_SIGNAL, status.EXIT_STIMULUS_END)
)
_END_CODES = {
    status.EXIT_NAMES[status.EXIT_CAN_LOST]: exit_codes.CAN_LOST,
    status.EXIT_NAMES[status.EXIT_DEADLINE]: exit_codes.DEADLINE_BUDGET_EXCEEDED,
    status.EXIT_NAMES[status.EXIT_STALLED]: exit_codes.BENCH_FAILED,
    status.EXIT_NAMES[status.EXIT_SYSTEM_CALL]: exit_codes.BENCH_FAILED,
}
_MODEL_KEYS = ("check_failures_max", "check_pressure_mpa_max", "check_position_mm_max")
_CHECK_DEFAULTS = ("check_failures_max", "unchecked_ticks_max")


@dataclass(frozen=True)
class Judgement:
    """One thing that was judged.

    `value` is NaN where it cannot be told; `detail` says where the value stands or why it cannot be told; `over` says over how much of
    the run; `code` is the exit code it asks for when it does not pass; `by_default`: judged though the profile does not name it.
    """

    key: str
    doc: str
    limit: float
    value: float
    outcome: str
    detail: str
    unit: str = ""
    over: str = ""
    code: int = exit_codes.VERDICT_FAILED
    by_default: bool = False

    def sentence(self) -> str:
        """What is wrong, in words: value, limit, unit, reason."""
        unit = f" {self.unit}" if self.unit else ""
        reason = "; ".join(part for part in (self.detail, self.over) if part)
        if self.key not in KEYS and self.by_default:  # a yes or a no
            return f"{self.key}: {self.outcome}: {reason or self.doc}"
        if self.outcome == NOT_JUDGED:
            return f"{self.key}: {self.outcome}: {reason or self.doc} (limit {self.limit:g}{unit})"
        return f"{self.key}: {self.outcome}: {self.value:g} against {self.limit:g}{unit}" + (
            f" ({reason})" if reason else ""
        )


@dataclass(frozen=True)
class Subject:
    """All that is judged of one run; who makes it (log, replay, a run without a log) does not matter to the judgement."""

    exit_reason: str  # of status.EXIT_NAMES; any other text: not known
    limits: dict[str, float]
    measured: Measured
    profile_problem: str = ""  # why the limits of the profile cannot be read
    mismatches: tuple[str, ...] = ()  # parts of the log that do not match their checksums
    missing_fields: dict[str, tuple[str, ...]] | None = None
    silent_axes: tuple[str, ...] | None = None  # never got a valid command; None: no firmware was meant to send one
    stall_problem: str | None = None  # why the bench itself failed; empty: it did its part; None: not told
    source: str = LOG
    requirements: tuple[Judged, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """All judgements of a run, and what follows from them."""

    judgements: list[Judgement]

    @property
    def failed(self) -> list[Judgement]:
        """What did not pass: broken, or not to be judged."""
        return [one for one in self.judgements if one.outcome != PASSED]

    @property
    def outcome(self) -> str:
        """PASSED, FAILED, DAMAGED, or NO_LIMITS where nothing failed but the profile names nothing to pass."""
        if any(one.code == exit_codes.DAMAGED for one in self.failed):
            return DAMAGED
        if self.failed:
            return FAILED
        return PASSED if any(not one.by_default for one in self.judgements) else NO_LIMITS

    @property
    def passed(self) -> bool:
        """Every limit of the profile was kept, and there is at least one."""
        return self.outcome == PASSED

    @property
    def exit_code(self) -> int:
        """The gravest of all that failed (base.exit_codes.PRECEDENCE)."""
        return exit_codes.gravest(one.code for one in self.failed)

    @property
    def causes(self) -> list[str]:
        """Everything that failed, in words, the cause of the exit code first."""
        order = {code: place for place, code in enumerate(exit_codes.PRECEDENCE)}
        return [one.sentence() for one in sorted(self.failed, key=lambda one: order.get(one.code, len(order)))]

    def as_dict(self) -> dict:
        """As plain JSON values, but for NaN."""
        return {
            "outcome": self.outcome,
            "passed": self.passed,
            "exit_code": self.exit_code,
            "causes": self.causes,
            "limits": [asdict(one) for one in self.judgements],
        }

    def joined(self, more: Sequence[Judgement]) -> "Verdict":
        """With further judgements; a damaged log stays without any other."""
        return self if self.outcome == DAMAGED else Verdict([*self.judgements, *more])


def judge(subject: Subject) -> Verdict:
    """Judge a run. A log that does not match its own checksums has no verdict but that it is damaged."""
    damage = damage_judgement(subject.mismatches)
    if damage.outcome != PASSED:
        return Verdict([damage])
    judged = [damage] if subject.source == LOG else []
    judged += [
        _judge_end(subject.exit_reason),
        *_judge_log(subject),
        _judge_profile(subject),
        *_judge_bench(subject.stall_problem),
        *_judge_firmware(subject),
    ]
    limits = DEFAULTS | subject.limits
    for key, limit in limits.items():
        if key in EXPLAINING or _does_not_concern(key, subject):
            continue
        judged.append(_judge_limit(key, limit, subject))
    judged += [_of_requirement(one) for one in subject.requirements]
    return Verdict(judged)


def _of_requirement(one: Judged) -> Judgement:
    """A requirement beside the limits: its value is its margin, which must not be negative."""
    if one.outcome == NOT_JUDGED:
        value, detail = math.nan, one.detail
    else:
        value, detail = one.margin, f"decided at {one.time_s:g} s by: {one.decided_by or one.formula}"
    doc = one.text or one.formula
    return Judgement(f"requirement {one.id}", doc, 0.0, value, one.outcome, detail, one.unit)


def said(key: str, doc: str, holds: bool | None, detail: str, code: int = exit_codes.VERDICT_FAILED) -> Judgement:
    """A judgement that is a yes or a no; None: cannot be told."""
    outcome = NOT_JUDGED if holds is None else PASSED if holds else FAILED
    value = math.nan if holds is None else float(holds)
    return Judgement(key, doc, 1.0, value, outcome, detail, code=code, by_default=True)


def damage_judgement(mismatches: tuple[str, ...]) -> Judgement:
    more = f" and {len(mismatches) - 1} more" if len(mismatches) > 1 else ""
    detail = f"{mismatches[0]}{more}" if mismatches else ""
    return said(
        "log_undamaged", "the log matches its own checksums and hashes", not mismatches, detail, exit_codes.DAMAGED
    )


def _judge_end(exit_reason: str) -> Judgement:
    known = exit_reason in status.EXIT_NAMES
    code = _END_CODES.get(exit_reason, exit_codes.VERDICT_FAILED)
    holds = exit_reason in _PLANNED if known else None
    return said("ended_as_planned", "the run ended as planned", holds, exit_reason, code)


def _judge_log(subject: Subject) -> list[Judgement]:
    if subject.source != LOG:
        return []
    coverage = subject.measured.coverage
    detail = coverage.recorder_error
    if not coverage.finished:
        detail = detail or f"its end is missing: {_known_so_far(coverage)}"
    return [said("log_finished", "the log has its end", coverage.finished and not coverage.recorder_error, detail)]


def _known_so_far(coverage: Coverage) -> str:
    found = coverage.ticks.found
    return (
        f"it holds {found} ticks, and how many more ran is not known"
        if coverage.ticks.had is None
        else coverage.ticks.over("ticks")
    )


def _judge_profile(subject: Subject) -> Judgement:
    problem = subject.profile_problem
    return said("profile_readable", "the limits can be read", None if problem else True, problem)


def _judge_bench(problem: str | None) -> list[Judgement]:
    if problem is None:
        return []
    doc = "the host let the bench serve its periods (deadline.stall_ms)"
    return [said("bench_served", doc, not problem, problem, exit_codes.BENCH_FAILED)]


def _judge_firmware(subject: Subject) -> list[Judgement]:
    silent = subject.silent_axes
    if silent is None:
        return []
    detail = f"axis {', axis '.join(silent)} never got a valid command" if silent else ""
    return [said("firmware_heard", "a firmware sent valid commands (bench.require_firmware)", not silent, detail)]


def _does_not_concern(key: str, subject: Subject) -> bool:
    """What is judged by default only where the run had it."""
    if key in subject.limits:
        return False
    if key in _CHECK_DEFAULTS:
        return subject.measured.coverage.checked is None
    return subject.source == COUNTERS


def _judge_limit(key: str, limit: float, subject: Subject) -> Judgement:
    by_default = key not in subject.limits
    code = exit_codes.CROSS_CHECK_FAILED if key in _MODEL_KEYS else exit_codes.VERDICT_FAILED
    unit = unit_of(key)
    if key not in KEYS:
        detail = "written by another version"
        return Judgement(key, "not a limit of this version", limit, math.nan, NOT_JUDGED, detail, unit, "", code)
    found = measure(key, subject.measured, subject.missing_fields or {})
    if math.isnan(found.value):
        outcome, code = NOT_JUDGED, exit_codes.VERDICT_FAILED
    else:
        kept = found.value >= limit if key.endswith("_min") else found.value <= limit
        outcome = PASSED if kept else FAILED
    return Judgement(key, KEYS[key].doc, limit, found.value, outcome, found.detail, unit, found.over, code, by_default)
