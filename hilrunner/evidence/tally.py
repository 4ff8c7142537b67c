"""The judgement of a run that keeps no log: the recorder's records are summed as they come, and judged at the end.

`Tally` stands in the place of a log (record.mcap_log.LogWriter) and takes the same records; the sums and the judgement are those of a
log that is read (evidence.plant_use, bus, check_use, verdict), so that a limit means the same with a log and without one.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hilrunner.base import records
from hilrunner.base.records import TICK_FLAG_MISS, TICK_FLAG_SKIPPED
from hilrunner.evidence.bus import BusTally
from hilrunner.evidence.check_use import CheckTally
from hilrunner.evidence.coverage import Count, coverage_of
from hilrunner.evidence.facts import RunFacts, read_facts
from hilrunner.evidence.judging import silent_axes, stall_limit
from hilrunner.evidence.latency import Latency, Samples, Timeline, distribution, loop_distributions, with_skipped
from hilrunner.evidence.limit_measures import Measured
from hilrunner.evidence.plant_use import AxisTally, reference_m
from hilrunner.evidence.reader import Attachment, Run
from hilrunner.evidence.requirement_use import judged_requirements
from hilrunner.evidence.stalls import logged_stall_problem
from hilrunner.evidence.verdict import MEMORY, NOT_JUDGED, Judgement, Subject, judge
from hilrunner.setup.limits import SETTLING_SPEED_MMPS

_PLACE = Path("(no log)")


class Tally:
    """Takes the records of one run in place of a log.

    Args:
        axis_names: one name an axis, in the order of the COMMAND and STATE records.
        metadata, attachments: what the log would carry (record.config.RecorderConfig).
    """

    path = None
    size_bytes = lost_bytes = lost_messages = write_stall_ns_max = 0

    def __init__(
        self,
        axis_names: Sequence[str],
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Sequence[tuple[str, str, bytes]],
    ) -> None:
        self.verdict: dict | None = None
        self._names = tuple(axis_names)
        self._metadata = {name: dict(table) for name, table in metadata.items()}
        self._attachments = {name: Attachment(media_type, data) for name, media_type, data in attachments}
        self._frames, self._checks = BusTally(), CheckTally(keep_traces=False)
        self._counts = dict.fromkeys(("ticks", "ran", "warm_up", "frames", "miss_rows", "skipped"), 0)
        self._late_ticks: set[int] = set()
        self._samples = {"wake_lateness": Samples(), "execution": Samples()}
        self._facts = read_facts(self._run())
        speed = self._facts.limits.get("settling_speed_mmps", SETTLING_SPEED_MMPS)
        self._axes = {name: AxisTally(name, self._facts.period_ns, speed) for name in self._names}
        profile = self._facts.profile
        self._profiles = {axis.name: axis for axis in profile.axis} if profile else {}

    def write_ticks(self, tick, command, state, start_mono_ns: int, start_real_ns: int) -> None:
        """Periods, as LogWriter takes them."""
        if not len(tick):
            return
        counted = tick["tick"] >= self._facts.warm_up_ticks
        skipped = (tick["flags"] & TICK_FLAG_SKIPPED) != 0
        self._counts["ticks"] += len(tick)
        self._counts["ran"] += int((~skipped).sum())
        self._counts["warm_up"] += int((~counted & ~skipped).sum())
        self._counts["skipped"] += int(tick["skipped_count"][counted].sum()) + int((counted & skipped).sum())
        self._late_ticks |= set(tick["tick"][counted & ((tick["flags"] & TICK_FLAG_MISS) != 0)].tolist())
        self._take_times(tick[counted])
        for index, name in enumerate(self._names):
            of_axis = slice(index, None, len(self._names))
            target = reference_m(tick["tick"], self._facts.period_ns, self._profiles.get(name), None)
            self._axes[name].take(state[of_axis], command[of_axis], target)

    def _take_times(self, tick: np.ndarray) -> None:
        lateness = tick["wake_mono_ns"] - tick["deadline_mono_ns"]
        self._samples["wake_lateness"].take(with_skipped(lateness, tick["skipped_count"], self._facts.period_ns))
        ran = tick[(tick["flags"] & TICK_FLAG_SKIPPED) == 0]  # a skipped period has no duration
        self._samples["execution"].take(ran["end_mono_ns"] - ran["wake_mono_ns"])

    def write_check(self, axis_name: str, check: np.ndarray, log_real_ns, publish_real_ns) -> None:
        """Cross-check records of one axis."""
        self._checks(f"/{axis_name}/check", check)

    def write_miss(self, miss: np.ndarray, start_real_ns: int, period_ns: int) -> None:
        """Misses."""
        self._counts["miss_rows"] += len(miss)
        self._late_ticks |= set(miss["tick"][miss["lateness_ns"] > 0].tolist())

    def write_can(self, can: np.ndarray, start_mono_ns: int, start_real_ns: int) -> None:
        """Frames, received and sent."""
        sent = (can["flags"] & records.CAN_FRAME_SENT) != 0
        self._counts["frames"] += len(can)
        self._frames("/can/rx", can[~sent])
        self._frames("/can/tx", can[sent])

    def take_frames(self, topic: str, rows: np.ndarray) -> None:
        """Frames of one topic of a log."""
        self._counts["frames"] += len(rows)
        self._frames(topic, rows)

    def write_statistics(self, statistics: np.ndarray, log_real_ns: int, publish_real_ns: int) -> None:
        """Nothing: the histograms come whole at the end."""

    def write_log(self, level: int, name: str, text: str, real_ns: int) -> None:
        """Nothing: there is nobody to read it."""

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """The loop's histograms, at the end."""
        self._attachments[name] = Attachment(media_type, data)

    def message_counts(self) -> dict[str, int]:
        """None: nothing is kept."""
        return {}

    def is_in_place(self) -> bool:
        """Always: there is no file."""
        return True

    def flush(self) -> None:
        """Nothing is pending."""

    def close(self, metadata: Mapping[str, Mapping[str, str]] | None = None) -> None:
        """Judge the run; the verdict stands in `verdict` as plain values."""
        for name, table in (metadata or {}).items():
            self._metadata[name] = self._metadata.get(name, {}) | {key: str(value) for key, value in table.items()}
        run = self._run()
        facts = read_facts(run)
        verdict = judge(self._subject(run, facts, None, MEMORY))
        self.verdict = verdict.joined(_without_a_log(facts)).as_dict()

    def subject_of_log(self, run: Run, ran_ticks: int, exit_reason: str, source: str) -> Subject:
        """What is judged of a log whose records were taken here: `run` holds the rest of it.

        Args:
            ran_ticks, exit_reason: as the runner knows them.
        """
        facts = replace(read_facts(run), exit_reason=exit_reason)
        return replace(self._subject(run, facts, ran_ticks, source), requirements=judged_requirements(run, facts))

    def _subject(self, run: Run, facts: RunFacts, ran_ticks: int | None, source: str) -> Subject:
        counts = self._counts
        bus, checks = self._frames.result(facts.bitrate), self._checks.results(facts.period_ns)
        axes = [tally.result() for tally in self._axes.values() if counts["ticks"]]
        told = coverage_of(run, bus, checks, ran_ticks)
        coverage = replace(
            told,
            ticks=Count(counts["ticks"], told.ticks.had),
            frames=Count(counts["frames"], told.frames.had),
            misses=Count(counts["miss_rows"], told.misses.had),
        )
        return Subject(
            exit_reason=facts.exit_reason,
            limits=facts.limits,
            measured=Measured(self._latency(run, facts), bus, axes, checks, coverage, self._names),
            profile_problem=facts.profile_problem,
            silent_axes=silent_axes(run, facts, axes, self._names),
            stall_problem=logged_stall_problem(run.metadata.get("run", {}), stall_limit(facts)),
            mismatches=run.mismatches,
            missing_fields=run.missing_fields,
            source=source,
        )

    def _latency(self, run: Run, facts: RunFacts) -> Latency:
        """By counts, the samples of a run that is not too long, and the loop's own histograms."""
        nothing = np.zeros(0)
        distributions = {name: one.distribution(name) for name, one in self._samples.items() if one.is_whole}
        responses_ns = self._frames.responses_ns(facts.warm_up_ticks)
        if len(responses_ns):
            distributions["response"] = distribution("response", responses_ns, "frames")
        return Latency(
            period_ns=facts.period_ns,
            tick_count=self._counts["ran"],
            warm_up_ticks=self._counts["warm_up"],
            duration_s=0.0,
            skipped_count=self._counts["skipped"],
            lost_count=0,
            miss_count=len(self._late_ticks),
            misses=[],
            causes={},
            distributions=distributions,
            loop=loop_distributions(run),
            worst_wake=[],
            timeline=Timeline(nothing, nothing, nothing),
        )

    def _run(self) -> Run:
        """What a log would hold beside its records."""
        return Run(
            path=_PLACE,
            size_bytes=0,
            topics={},
            metadata=self._metadata,
            attachments=self._attachments,
            damage=(),
            mismatches=(),
            finished=True,
            library="",
            start_publish_ns=0,
            first_log_ns=0,
            schemas={},
            missing_fields={},
        )


def _without_a_log(facts: RunFacts) -> list[Judgement]:
    """The requirements of the profile: their formulas look back and forth in time, and nothing is kept to look at."""
    asked = facts.profile.requirement if facts.profile else ()
    detail = "a run with --no-log keeps no signals that its formula could be judged by"
    return [
        Judgement(f"requirement {one.id}", one.text or one.formula, 0.0, math.nan, NOT_JUDGED, detail) for one in asked
    ]
