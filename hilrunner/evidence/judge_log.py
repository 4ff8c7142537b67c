"""The verdict of a log without holding its records: what a run that went on for days is judged by at its end.

A report keeps every tick for its figures and plots; here the records are summed batch by batch by the same tallies (evidence.tally), and the
judgement is the same.
"""

from pathlib import Path

import numpy as np

from hilrunner.evidence.bus import BusTally
from hilrunner.evidence.check_use import CheckTally
from hilrunner.evidence.reader import Columns, read_run
from hilrunner.evidence.report import COLUMNS, RunnerKnows, build_report
from hilrunner.evidence.tally import Tally
from hilrunner.evidence.verdict import LOG, Verdict, judge

_WIDTHS = {"/rt/tick": COLUMNS["/rt/tick"], "/*/command": COLUMNS["/*/command"], "/*/state": COLUMNS["/*/state"]}
_STREAMED: Columns = {
    **_WIDTHS,
    "/rt/miss": ("tick", "lateness_ns"),
    "/can/*": BusTally.COLUMNS,
    "/*/check": CheckTally.COLUMNS,
}


def judge_log(path: Path, knows: RunnerKnows) -> Verdict:
    """The verdict `report` gives of the log of the run that has just ended.

    Raises LogError as evidence.reader.read_run does.
    """
    stream = _Stream()
    consumers = {pattern: stream.take for pattern in _STREAMED}
    run = read_run(path, _STREAMED, consumers, stream.begin)
    if not stream.is_even:  # records of some ticks are missing: only a look at all of them pairs the others
        return build_report(path, knows=knows).verdict
    return judge(stream.tally.subject_of_log(run, knows.ran_ticks, knows.exit_reason, LOG))


class _Stream:
    """Puts the topics of a log, which come one by one, side by side again as the loop filled them."""

    def __init__(self) -> None:
        self.tally: Tally | None = None
        self._waiting: dict[str, list[np.ndarray]] = {}
        self._axes: tuple[str, ...] = ()
        self._matched = True

    def begin(self, metadata, attachments) -> None:
        """The head of the log: profile and names are known before the first tick."""
        names = metadata.get("run", {}).get("axis_names", "")
        self._axes = tuple(name.strip() for name in names.split(",") if name.strip())
        self.tally = Tally(self._axes, metadata, [(name, *pair) for name, pair in attachments.items()])
        topics = ["/rt/tick", *(f"/{axis}/{kind}" for axis in self._axes for kind in ("command", "state"))]
        self._waiting = {topic: [] for topic in topics}

    @property
    def is_even(self) -> bool:
        """Every tick had its command and state on every axis."""
        return self._matched and self.tally is not None and not any(map(len, self._waiting.values()))

    def take(self, topic: str, rows: np.ndarray) -> None:
        """One batch of one topic; the rows are the reader's and change after the call."""
        if not len(rows):
            return
        if topic == "/rt/miss":
            self.tally.write_miss(rows, 0, 0)
        elif topic.startswith("/can/"):
            self.tally.take_frames(topic, rows)
        elif topic.endswith("/check"):
            self.tally.write_check(topic.split("/")[1], rows, None, None)
        elif topic in self._waiting:
            self._waiting[topic].append(rows.copy())
            if all(self._waiting.values()):
                self._pair()
        else:
            self._matched = False  # an axis that the log's own metadata does not name

    def _pair(self) -> None:
        parts = {topic: np.concatenate(waiting) for topic, waiting in self._waiting.items()}
        count = min(map(len, parts.values()))
        tick = parts["/rt/tick"][:count]
        same = all(np.array_equal(rows["tick"][:count], tick["tick"]) for rows in parts.values())
        self._matched &= same and bool(np.all(np.diff(tick["tick"].astype(np.int64)) > 0))
        kinds = [
            np.stack([parts[f"/{axis}/{kind}"][:count] for axis in self._axes], axis=1).reshape(-1)
            for kind in ("command", "state")
        ]
        self.tally.write_ticks(tick, *kinds, 0, 0)
        self._waiting = {topic: [rows[count:]] if len(rows) > count else [] for topic, rows in parts.items()}
