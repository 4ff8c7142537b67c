"""The judgement of the run that has just ended: the one that `report` gives of its log, or the same without a log."""

from hilrunner.base import exit_codes, status
from hilrunner.base import ring as ring_layout
from hilrunner.base.errors import HilrunnerError
from hilrunner.commands.interrupt import INTERRUPTED
from hilrunner.setup.session import RunResult


def verdict_of_run(result: RunResult) -> dict:
    """The verdict as evidence.verdict.Verdict.as_dict gives it.

    With a log it is the one of the log, which is read anew from the disk: only what stands there can be shown to others. The
    runner adds what it alone knows: how many ticks ran, and how the run ended.
    """
    if result.log_path is not None:
        return _of_log(result)
    told = result.recorder.get("verdict")
    if told is not None:
        return told
    problem = ""
    if result.armed.loaded.profile.limits or result.armed.loaded.profile.requirement:
        problem = (
            "; ".join(part for part in result.recorder.get("error") or () if part) or "the recorder gave no verdict"
        )
    return _of_counters(result, problem)


def exit_code_of(result: RunResult, verdict: dict) -> int:
    """The exit code of the process: the verdict's, or 130 where no tick ran before the interrupt."""
    ran = int(result.armed.bench.progress[0]["tick_count"])
    if not ran and result.exit_reason == status.EXIT_SIGNAL:
        return INTERRUPTED
    return verdict["exit_code"]


def _of_log(result: RunResult) -> dict:
    from hilrunner.evidence.judge_log import judge_log
    from hilrunner.evidence.report import RunnerKnows

    ran = _rows(result)
    if ring_layout.word(result.ring, ring_layout.WORD_LOG_LACKS) & ring_layout.LOG_LACKS_NAME:
        return _of_counters(result, ring_layout.LOG_LACKS_TEXTS[0])  # what lies there now is not the log of this run
    knows = RunnerKnows(ran, status.EXIT_NAMES[result.exit_reason])
    try:
        return judge_log(result.log_path, knows).as_dict()
    except HilrunnerError as error:
        code = exit_codes.DAMAGED if error.exit_code == exit_codes.DAMAGED else exit_codes.VERDICT_FAILED
        return _of_counters(result, f"the log cannot be judged: {error}", code)


def _of_counters(result: RunResult, problem: str, code: int = exit_codes.VERDICT_FAILED) -> dict:
    """By the loop's own counters; `problem`: why there is nothing more to judge by, where there should be."""
    from hilrunner.evidence.coverage import coverage_of_run
    from hilrunner.evidence.limit_measures import Measured
    from hilrunner.evidence.verdict import COUNTERS, Subject, judge, said

    profile = result.armed.loaded.profile
    ran = _rows(result)
    failed_tick = ring_layout.word(result.ring, ring_layout.WORD_CHECK_FAILED_TICK)
    coverage = coverage_of_run(ran, result.recorder, profile.crosscheck.enabled, failed_tick - 1)
    verdict = judge(
        Subject(
            exit_reason=status.EXIT_NAMES[result.exit_reason],
            limits={},
            measured=Measured(None, None, [], [], coverage),
            silent_axes=_silent_axes(result),
            stall_problem=_stall_problem(result),
            source=COUNTERS,
        )
    )
    if problem:
        doc = "the limits can be judged by what was recorded"
        verdict = verdict.joined([said("limits_judged", doc, None, problem, code)])
    return verdict.as_dict()


def _rows(result: RunResult) -> int:
    """Ticks that are to be found in the log, those of skipped periods among them; without a recorder, ticks that ran."""
    written = ring_layout.word(result.ring, ring_layout.WORD_TICK_WRITTEN)
    dropped = ring_layout.word(result.ring, ring_layout.WORD_TICK_DROPPED)
    return written + dropped or int(result.armed.bench.progress[0]["tick_count"])


def _stall_problem(result: RunResult) -> str:
    from hilrunner.evidence.stalls import stall_problem

    words = (ring_layout.WORD_STALL_COUNT, ring_layout.WORD_STALL_NS_MAX, ring_layout.WORD_STALL_TICK_FIRST)
    count, longest_ns, first = (ring_layout.word(result.ring, word) for word in words)
    return stall_problem(result.armed.loaded.profile.deadline.stall_ms, count, longest_ns, first - 1)


def _silent_axes(result: RunResult) -> tuple[str, ...] | None:
    profile = result.armed.loaded.profile
    if result.has_stimulus or not profile.bench.require_firmware:
        return None
    counts = zip(profile.axis, result.ring.frame_count, strict=False)  # one row more: frames of no axis
    return tuple(axis.name for axis, row in counts if not row[status.FRAME_VALID])
