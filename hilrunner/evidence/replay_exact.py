"""Bit-exact replay: the logged frames through the same compiled cycle, every state compared bit for bit.

What decides a state is in the log: the frames in their ticks, the ticks that ran, the periods skipped, the misses that made
a deadline limit act. Nothing else is taken from the run.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilrunner.base import records
from hilrunner.base.records import TICK_FLAG_FORCED_FAIL_SAFE
from hilrunner.evidence.facts import RunFacts
from hilrunner.evidence.reader import Run
from hilrunner.evidence.rebuild import socket_frames, spend_valve_faults, stimulus_of, version_notes
from hilrunner.realtime.cycle import run_offline
from hilrunner.record.schemas import FORCED_FAIL_SAFE
from hilrunner.setup.arm import arm_offline
from hilrunner.setup.blocks import blocks
from hilrunner.setup.profile import LoadedProfile, Profile

BLOCK_TICKS = 20_000
Progress = Callable[[float], None]  # share done, 0..1


@dataclass(frozen=True)
class Difference:
    """The first place where the replay is not the run."""

    tick: int
    topic: str
    field: str
    logged: float
    replayed: float

    def sentence(self) -> str:
        """In words, with every digit."""
        return f"tick {self.tick}, {self.topic} {self.field}: logged {self.logged!r}, replayed {self.replayed!r}"


@dataclass(frozen=True)
class ExactReplay:
    """What came of it."""

    compared_ticks: int
    total_ticks: int
    first: Difference | None
    differing: dict[str, int]  # "topic field" -> ticks that differ
    wall_s: float
    processor_s: float  # what the replay's own thread took of it; less where other programs share the core
    simulated_s: float
    notes: tuple[str, ...]

    @property
    def identical(self) -> bool:
        """Every tick of the log was compared and agrees in every bit."""
        return self.first is None and self.compared_ticks == self.total_ticks > 0

    @property
    def speed_factor(self) -> float:
        """Times faster than real time."""
        return self.simulated_s / self.wall_s if self.wall_s > 0 else 0.0

    @property
    def processor_factor(self) -> float:
        """Simulated seconds a second of processor time."""
        return self.simulated_s / self.processor_s if self.processor_s > 0 else 0.0


def exact_sentence(exact: ExactReplay) -> str:
    """The result of the bit-exact replay in one line."""
    if exact.identical:
        return f"bit-exact replay: all {exact.total_ticks} ticks identical in every bit"
    if exact.first is None:
        return f"bit-exact replay: the first {exact.compared_ticks} of {exact.total_ticks} ticks identical, the rest not compared"
    return f"bit-exact replay: DIFFERS first at {exact.first.sentence()}"


def replay_exact(
    log: Run, facts: RunFacts, loaded: LoadedProfile, engine: int, progress: Progress = lambda share: None
) -> ExactReplay:
    """Replay a run and compare.

    Args:
        log: read with all columns. loaded: its profile (evidence.rebuild). engine: status.ENGINE_*.

    Raises LogError, ProfileError, ModelError, DbcError when the bench cannot be built again.
    """
    notes = version_notes(log)
    count = _usable_ticks(log, notes)
    ticks = log.tick[:count]
    stimulus = stimulus_of(log, notes)
    armed = arm_offline(loaded, engine, stimulus)
    if stimulus is not None:
        spend_valve_faults(log, armed.bench.faults, notes)
    first_frame, frames, sizes = _frames(log, ticks, notes)
    number = ticks["tick"].astype(np.int64)
    periods = 1 + ticks["skipped_count"].astype(np.int64)
    misses, forced = known_misses(log, facts, number)
    axes = len(log.axis_names)
    command = records.allocate(records.COMMAND, count * axes).reshape(count, axes)
    state = records.allocate(records.STATE, count * axes).reshape(count, axes)
    inputs = (number, periods, misses, forced)

    def run(start: int, stop: int) -> int:
        part = [one[start:stop] for one in inputs]
        return run_offline(
            armed.bench, *part, frames, sizes, first_frame[start : stop + 1], command[start:stop], state[start:stop]
        )

    run(0, 0)  # compile, or load what is compiled, before the clock starts
    begin, begin_processor = time.perf_counter(), time.thread_time()
    done = 0
    for start, stop in blocks(count, BLOCK_TICKS):
        done += run(start, stop)
        if done < stop:
            notes.append(f"the state left the finite numbers at tick {int(number[done - 1])}")
            break
        progress(stop / count)
    wall_s, processor_s = time.perf_counter() - begin, time.thread_time() - begin_processor
    first, differing = _compare(log, command[:done], state[:done], done)
    span = int(number[-1]) + 1 if count else 0
    simulated_s = span * facts.period_ns * 1e-9
    return ExactReplay(done, len(log.tick), first, differing, wall_s, processor_s, simulated_s, tuple(notes))


def _usable_ticks(run: Run, notes: list[str]) -> int:
    """Ticks from the start up to the first gap; what comes after a gap started from a state the log does not tell."""
    ticks = run.tick
    counts = [len(ticks), *(len(rows) for rows in (*run.command.values(), *run.state.values()))]
    count = min(counts)
    number = ticks["tick"][:count].astype(np.int64)
    expected = np.diff(number, prepend=-1) - 1
    wrong = np.flatnonzero(expected != ticks["skipped_count"][:count])
    for rows in (*run.command.values(), *run.state.values()):
        other = np.flatnonzero(rows["tick"][:count].astype(np.int64) != number)
        wrong = np.concatenate((wrong, other[:1]))
    if len(wrong):
        stop = int(wrong.min())
        at = int(number[stop - 1]) if stop else -1
        notes.append(
            f"the log has a gap after tick {at}: the replay ends there, {len(ticks) - stop} ticks are not compared"
        )
        return stop
    if count < len(ticks):
        notes.append(f"{len(ticks) - count} ticks at the end lack their states: the log was cut off")
    return count


def _frames(run: Run, ticks: np.ndarray, notes: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    frames, sizes, of_tick = socket_frames(run)
    number = ticks["tick"].astype(np.int64)
    first_frame = np.append(
        np.searchsorted(of_tick, number, side="left"), np.searchsorted(of_tick, number[-1:], "right")
    )
    logged = np.diff(first_frame)
    lacking = np.flatnonzero(logged != ticks["frames_received"])
    if len(lacking):
        notes.append(f"from tick {int(number[lacking[0]])} on, {len(lacking)} ticks lack frames they received")
    return first_frame.astype(np.int64), frames, sizes


def known_misses(run: Run, facts: RunFacts, number: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(misses known to the bench when each tick ran, 1 where a deadline limit forced the fail-safe before it), int64."""
    late = run.miss[run.miss["lateness_ns"] > 0]
    ticks = late["tick"].astype(np.int64)
    known = np.searchsorted(np.sort(ticks), number, side="left").astype(np.int64)
    return known, _forced(run, facts, number, late)


def _forced(run: Run, facts: RunFacts, number: np.ndarray, late: np.ndarray) -> np.ndarray:
    """1 where a deadline limit forced the fail-safe just before a tick, int64: as the loop flagged it.

    A log from before that flag is judged anew from its misses.
    """
    flagged = (run.tick["flags"][: len(number)] & TICK_FLAG_FORCED_FAIL_SAFE) != 0
    if flagged.any() or FORCED_FAIL_SAFE in run.schemas.get("/rt/tick", ""):
        return flagged.astype(np.int64)
    forced = np.zeros(len(number), np.int64)
    profile = facts.profile
    if profile is None or not len(late):
        return forced
    ticks = late["tick"].astype(np.int64)
    row = np.searchsorted(number, ticks)
    row = row[row < len(number)]
    next_row = row[_limit_acted(profile, late[: len(row)], row)] + 1
    forced[next_row[next_row < len(number)]] = 1
    return forced


def _limit_acted(profile: Profile, late: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Which misses made a deadline limit act with `fail-safe`, as the loop judges them (realtime.loop)."""
    new_stretch = np.diff(row, prepend=-2) != 1
    stretch = np.cumsum(new_stretch) - 1
    order = np.arange(len(row))
    consecutive = order - order[new_stretch][stretch] + 1
    acted = np.zeros(len(row), bool)
    for limit, value in (
        (profile.deadline.consecutive_misses, consecutive),
        (profile.deadline.total_misses, order + 1),
        (profile.deadline.lateness_us, late["lateness_ns"] / 1000),
    ):
        if limit is not None and limit.action == "fail-safe":
            acted |= value > limit.max
    return acted


def _compare(run: Run, command: np.ndarray, state: np.ndarray, count: int) -> tuple[Difference | None, dict[str, int]]:
    """The first difference in order of tick, topic, field, and how many ticks differ in each field."""
    first: Difference | None = None
    differing: dict[str, int] = {}
    for axis, name in enumerate(run.axis_names):
        for topic, logged, replayed in (
            (f"/{name}/command", run.command[name][:count], command[:, axis]),
            (f"/{name}/state", run.state[name][:count], state[:, axis]),
        ):
            for field in logged.dtype.names[2:]:
                # as bits: equal NaN are equal, and 0.0 is not -0.0
                size = f"u{logged.dtype[field].itemsize}"
                a, b = np.ascontiguousarray(logged[field]), np.ascontiguousarray(replayed[field])
                places = np.flatnonzero(a.view(size) != b.view(size))
                if not len(places):
                    continue
                differing[f"{topic} {field}"] = len(places)
                at = int(places[0])
                tick = int(logged["tick"][at])
                if first is None or tick < first.tick:
                    first = Difference(tick, topic, field, logged[field][at].item(), replayed[field][at].item())
    return first, differing
