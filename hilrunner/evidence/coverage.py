"""How much of a run its log holds: what was counted while it ran, against what the log gives.

The counts stand in the closing metadata (record.recorder): what the recorder took, what the ring had no room for, what the disk
refused. A log that ends early has none; then nothing is known but that its end is missing.
"""

from dataclasses import dataclass

from hilrunner.evidence.bus import BusUse
from hilrunner.evidence.check_use import CheckUse
from hilrunner.evidence.reader import Run
from hilrunner.record.recorder import flat

_CHECKED = ".checked_ticks"


@dataclass(frozen=True)
class Count:
    """Records of one kind: how many were found, and how many there were in the run (None: not told)."""

    found: int
    had: int | None

    @property
    def lost(self) -> int | None:
        """How many are missing; None: not told."""
        return None if self.had is None else max(self.had - self.found, 0)

    def over(self, noun: str) -> str:
        """How much of the run a figure was judged over, in words."""
        if self.had is None:
            return f"over {self.found} {noun}"
        return f"over {min(self.found, self.had)} of {self.had} {noun}" if self.lost else f"over all {self.had} {noun}"


@dataclass(frozen=True)
class Coverage:
    """What of a run is there to be judged."""

    ticks: Count
    frames: Count
    misses: Count
    checked: Count | None  # ticks the online cross-check has looked at; None: the run had no cross-check
    check_error: str = ""  # why the cross-check stopped
    check_failed_ticks: tuple[tuple[str, int], ...] = ()  # (axis, first tick out of tolerance), as the recorder told
    check_errors_max: dict[str, float] | None = (
        None  # closing metadata: `<axis>.<quantity>_error_<unit>_max` -> SI value
    )
    rejected: dict[str, int] | None = None  # closing metadata: received frames by what became of them, None: not told
    lost_messages: int = 0  # the disk refused them
    finished: bool = True  # the log has its end
    recorder_error: str = ""


def coverage_sentences(coverage: Coverage) -> list[str]:
    """What the run had and the log lacks, a sentence a kind; empty: nothing is known to be missing."""
    told = []
    for count, noun in (
        (coverage.ticks, "ticks ran"),
        (coverage.frames, "frames passed"),
        (coverage.misses, "misses were explained"),
    ):
        if count.lost:
            told.append(f"{count.had} {noun}, {count.found} are in the log: {count.lost} are missing")
    if coverage.lost_messages:
        told.append(f"the disk refused {coverage.lost_messages} messages")
    if coverage.checked is not None and coverage.checked.lost:
        told.append(f"the cross-check looked at {coverage.checked.found} of {coverage.checked.had} ticks")
    if coverage.recorder_error:
        told.append(f"the recorder failed: {coverage.recorder_error}")
    return told


def coverage_dict(coverage: Coverage) -> dict:
    """As plain JSON values."""
    kinds = {
        "ticks": coverage.ticks,
        "frames": coverage.frames,
        "misses": coverage.misses,
        "checked_ticks": coverage.checked,
    }
    counts = {
        name: {"found": one.found, "had": one.had, "lost": one.lost} for name, one in kinds.items() if one is not None
    }
    return {**counts, "lost_messages": coverage.lost_messages, "finished": coverage.finished}


def coverage_of(run: Run, bus: BusUse, checks: list[CheckUse], ran_ticks: int | None = None) -> Coverage:
    """Compare a log's contents with what its closing metadata counted.

    Args:
        ran_ticks: ticks that ran, where somebody knows better than the log (the runner, of a recorder that died).
    """
    table = run.metadata.get("run", {})
    outcomes = run.metadata.get("frames")
    dropped_ticks, dropped_frames = _number(table, "dropped_ticks") or 0, _number(table, "dropped_frames") or 0
    recorded = _number(table, "tick_count") if "dropped_ticks" in table else None  # simulated logs count nothing
    ticks = None if recorded is None else recorded + dropped_ticks
    if ran_ticks is not None:
        ticks = max(ran_ticks, ticks or 0)
    misses = _number(table, "miss_records")
    check = run.metadata.get("check")
    return Coverage(
        ticks=Count(len(run.tick), ticks),
        frames=_frames(table, outcomes, bus, dropped_frames),
        misses=Count(len(run.miss), None if misses is None else misses + (_number(table, "dropped_misses") or 0)),
        checked=_checked(check, checks, ticks if ticks is not None else len(run.tick)),
        check_error=(check or {}).get("error", ""),
        check_failed_ticks=_failed_ticks(check or {}),
        check_errors_max=_errors_max(check),
        rejected=None if outcomes is None else _outcomes(outcomes),
        lost_messages=_number(table, "lost_messages") or 0,
        # a full disk may take the end of the file and refuse the counts before it: then nobody knows what is missing
        finished=run.finished and "exit_reason" in table,
        recorder_error=table.get("recorder_error", ""),
    )


def coverage_of_run(ran: int, recorder: dict, has_check: bool, failed_tick: int) -> Coverage:
    """What a run without a log was looked at by: the recorder's summary, if there was a recorder.

    Args:
        ran: ticks that ran. recorder: summary of record.recorder, empty without one. has_check: the profile asks for the
            cross-check. failed_tick: first tick out of its tolerance, negative: none.
    """
    summary = recorder.get("check")
    error = "; ".join(part for part in recorder.get("error") or () if part)
    check = {key: str(value) for key, value in flat(summary).items()} if summary else None
    checked = _checked(check, [], ran) if check else Count(0, ran) if has_check else None
    failed = _failed_ticks(check or {}) or ((("?", failed_tick),) if failed_tick >= 0 else ())
    none = Count(0, None)
    return Coverage(none, none, none, checked, (check or {}).get("error") or error, failed, _errors_max(check))


def _frames(table: dict[str, str], outcomes: dict[str, str] | None, bus: BusUse, dropped: int) -> Count:
    recorded = _number(table, "frame_records")
    found = bus.received_count + bus.sent_count
    if recorded is not None:
        return Count(found, recorded + dropped)
    if outcomes is None:
        return Count(found, None)
    # a log of an earlier version counted the received frames only, and the dropped ones of both directions
    received = sum(_outcomes(outcomes, with_valid=True).values())
    return Count(found, found + max(received - bus.received_count, dropped, 0))


def _outcomes(table: dict[str, str], with_valid: bool = False) -> dict[str, int]:
    """Received frames by outcome, over all axes."""
    counts: dict[str, int] = {}
    for key in table:
        outcome = key.rpartition(".")[2]
        if outcome != "valid" or with_valid:
            counts[outcome] = counts.get(outcome, 0) + (_number(table, key) or 0)
    return counts


def _checked(check: dict[str, str] | None, checks: list[CheckUse], ran: int) -> Count | None:
    """Of every axis the one with the fewest ticks."""
    if check is None:
        return Count(min(one.tick_count for one in checks), None) if checks else None
    # a tick behind a gap restarts the check and has no error; every other one that ran is to be looked at
    counts = [
        (_number(check, key) or 0) + (_number(check, f"{key.removesuffix(_CHECKED)}.restart_count") or 0)
        for key in check
        if key.endswith(_CHECKED)
    ]
    return Count(min(min(counts, default=0), ran), ran)


def _failed_ticks(check: dict[str, str]) -> tuple[tuple[str, int], ...]:
    ending = ".failed_tick"
    return tuple((key.removesuffix(ending), _number(check, key) or 0) for key in check if key.endswith(ending))


def _errors_max(check: dict[str, str] | None) -> dict[str, float] | None:
    if check is None:
        return None
    found = {}
    for key, text in check.items():
        if key.endswith("_max"):
            try:
                found[key] = float(text)
            except ValueError:
                continue
    return found


def _number(table: dict[str, str], key: str) -> int | None:
    try:
        return int(table[key])
    except (KeyError, ValueError):
        return None
