"""The loop's histograms as /rt/statistics (since tick 0, cumulative) and, at the end, whole as an attachment."""

import json

import numpy as np

from hilrunner.base import histogram_scale, records, status
from hilrunner.base import ring as ring_layout

HISTOGRAM_ATTACHMENT = "rt_histograms.json"


def statistics_record(ring: ring_layout.Ring, tick: int, tick_count: int) -> np.ndarray:
    """One STATISTICS record: counts, and percentiles of every histogram over the run so far.

    `tick` is the newest tick recorded, `tick_count` the ticks recorded. Read while the loop writes: at most one sample old.
    """
    record = records.allocate(records.STATISTICS, 1)
    record["tick"] = max(tick, 0)
    record["tick_count"] = tick_count
    record["miss_count"] = ring_layout.word(ring, ring_layout.WORD_MISS_TOTAL)
    record["skipped_count"] = ring_layout.word(ring, ring_layout.WORD_SKIPPED_TOTAL)
    record["record_drop_count"] = ring_layout.word(ring, ring_layout.WORD_TICK_DROPPED)
    for index, name in enumerate(records.HISTOGRAM_NAMES):
        for statistic, value_ns in histogram_scale.percentiles(ring.histogram[index], ring.extreme[index]).items():
            record[f"{name}_ns_{statistic}"] = value_ns
    return record


def histogram_text(ring: ring_layout.Ring) -> str:
    """Every histogram in full as JSON: name -> {"extreme": [min, max, sum, count] in ns, "buckets": [[index, count], …]}.

    Bucket bounds are those of base.histogram_scale, whose parameters stand under "scale".
    """
    table: dict[str, object] = {
        "scale": {
            "sub_bucket_bits": histogram_scale.SUB_BUCKET_BITS,
            "value_bits": histogram_scale.VALUE_BITS,
            "unit": "ns",
        }
    }
    for index, name in enumerate(records.HISTOGRAM_NAMES):
        used = np.flatnonzero(ring.histogram[index])
        table[name] = {
            "extreme": ring.extreme[index].tolist(),
            "buckets": np.column_stack((used, ring.histogram[index][used])).tolist(),
        }
    return json.dumps(table)


def clamped_counts(ring: ring_layout.Ring, sent_signals: list[str]) -> dict[str, int]:
    """Sent signals that carried an end of their range because the value lay outside: `MESSAGE.signal` -> times."""
    counts: dict[str, int] = {}
    for name, count in zip(sent_signals, ring.clamped_count.tolist(), strict=False):
        if count:  # a plain signal of a multiplexed message has an entry for each page
            counts[name] = counts.get(name, 0) + count
    return counts


def frame_counts(ring: ring_layout.Ring, axis_names: list[str]) -> dict[str, str]:
    """Received frames by axis (last: no axis) and outcome, only those that occurred: `lift.bad crc` -> count."""
    rows = [*axis_names, "none"]
    return {
        f"{rows[axis]}.{status.FRAME_STATUS_NAMES[outcome]}": str(int(ring.frame_count[axis, outcome]))
        for axis, outcome in zip(*np.nonzero(ring.frame_count), strict=True)
    }
