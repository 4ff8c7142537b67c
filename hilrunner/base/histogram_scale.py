"""The scale of every latency histogram: bucket bounds, percentiles, and the `.hgrm` text other tools plot.

HdrHistogram's idea with fixed numbers: every power of two is cut into 64 equal buckets, so a bucket is at most 1/64 = 1.6 %
wide, and values below 128 ns keep one bucket each. One row of a histogram is int64[BUCKET_COUNT] (index = bucket), its
extreme row is int64[4] (min, max, sum, count). Numpy only: the recorder and the reports share it with the loop.

Values are reported as the highest one of their bucket, never above the true maximum: rounding never flatters.
"""

import numpy as np

from hilrunner.base.records import STATISTIC_NAMES

SUB_BUCKET_BITS = 6
SUB_BUCKET_COUNT = 1 << SUB_BUCKET_BITS
VALUE_BITS = 40  # values up to 2**40 ns = 1100 s have a bucket of their own; longer ones share the last
BUCKET_COUNT = (VALUE_BITS - SUB_BUCKET_BITS + 1) * SUB_BUCKET_COUNT
VALUE_NS_MAX = (1 << VALUE_BITS) - 1

(EXTREME_MIN, EXTREME_MAX, EXTREME_SUM, EXTREME_COUNT) = range(4)

PERCENTILE_RATIOS = {"p50": 0.5, "p90": 0.9, "p99": 0.99, "p999": 0.999, "p9999": 0.9999, "p99999": 0.99999}
assert tuple(PERCENTILE_RATIOS) == STATISTIC_NAMES[1:-1]


def bucket_lower_ns() -> np.ndarray:
    """Smallest value of every bucket, int64[BUCKET_COUNT], ns."""
    index = np.arange(BUCKET_COUNT, dtype=np.int64)
    shift = np.maximum(index // SUB_BUCKET_COUNT - 1, 0)
    return (index - shift * SUB_BUCKET_COUNT) << shift


def bucket_upper_ns() -> np.ndarray:
    """Largest value of every bucket (inclusive), int64[BUCKET_COUNT], ns."""
    return np.append(bucket_lower_ns()[1:], VALUE_NS_MAX + 1) - 1


def bucket_indices(values_ns: np.ndarray) -> np.ndarray:
    """Bucket of every value, int64[n]; negative values go to bucket 0, values above the range to the last bucket."""
    values = np.clip(np.asarray(values_ns, np.int64), 0, VALUE_NS_MAX)
    return np.searchsorted(bucket_lower_ns(), values, side="right") - 1


def empty(histogram_count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Zeroed rows: buckets int64[histogram_count, BUCKET_COUNT] and extremes int64[histogram_count, 4]."""
    return np.zeros((histogram_count, BUCKET_COUNT), np.int64), np.zeros((histogram_count, 4), np.int64)


def from_values(values_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Histogram row and extreme row of int64 values in ns, for values that were logged rather than counted."""
    values = np.asarray(values_ns, np.int64)
    row = np.bincount(bucket_indices(values), minlength=BUCKET_COUNT).astype(np.int64)
    extreme = np.zeros(4, np.int64)
    if values.size:
        extreme[:] = values.min(), values.max(), values.sum(), values.size
    return row, extreme


def merge(rows: np.ndarray, extremes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One histogram of several: buckets int64[k, BUCKET_COUNT] and extremes int64[k, 4]; empty ones change nothing."""
    extreme = np.zeros(4, np.int64)
    used = extremes[extremes[:, EXTREME_COUNT] > 0]
    if used.size:
        extreme[:] = used[:, 0].min(), used[:, 1].max(), used[:, 2].sum(), used[:, 3].sum()
    return rows.sum(axis=0), extreme


def quantile_ns(row: np.ndarray, extreme: np.ndarray, ratio: float) -> int:
    """Smallest value that at least `ratio` (0..1) of the samples do not exceed, ns; 0 when there are no samples."""
    total = int(row.sum())
    if total == 0:
        return 0
    # a count of samples, rounded up; the subtraction keeps 0.99 * 100 = 99.00000000000001 from asking for 100
    rank = min(total, max(1, int(np.ceil(ratio * total - 1e-9 * total))))
    index = int(np.searchsorted(np.cumsum(row), rank))
    if index == BUCKET_COUNT - 1:
        return int(extreme[EXTREME_MAX])
    return int(np.clip(bucket_upper_ns()[index], extreme[EXTREME_MIN], extreme[EXTREME_MAX]))


def percentiles(row: np.ndarray, extreme: np.ndarray) -> dict[str, int]:
    """min, p50 … p99999, max (the names of `records.STATISTIC_NAMES`) in ns; all 0 when there are no samples.

    The recorder reads rows while the loop writes them; the samples counted in the buckets decide, and a value read
    between two stores is at most one sample old.
    """
    values = {"min": int(extreme[EXTREME_MIN])}
    for name, ratio in PERCENTILE_RATIOS.items():
        values[name] = quantile_ns(row, extreme, ratio)
    values["max"] = int(extreme[EXTREME_MAX])
    return values


def count_above(row: np.ndarray, limit_ns: int) -> int:
    """Samples in buckets that lie wholly above `limit_ns`: a lower bound within one bucket's width."""
    return int(row[bucket_lower_ns() > limit_ns].sum())


def mean_ns(extreme: np.ndarray) -> float:
    """Mean of all samples, ns; 0.0 without samples."""
    return float(extreme[EXTREME_SUM]) / max(int(extreme[EXTREME_COUNT]), 1)


def deviation_ns(row: np.ndarray, extreme: np.ndarray) -> float:
    """Standard deviation from bucket middles, ns; 0.0 without samples."""
    total = int(row.sum())
    if total == 0:
        return 0.0
    middle = (bucket_lower_ns() + bucket_upper_ns()) / 2.0
    return float(np.sqrt(max(0.0, float(row @ (middle - mean_ns(extreme)) ** 2) / total)))


def hgrm(row: np.ndarray, extreme: np.ndarray, ns_per_unit: float = 1000.0) -> str:
    """The percentile distribution as HdrHistogram writes it (`.hgrm`), values in `ns_per_unit` ns (default: us).

    One line for every bucket that holds samples; any HdrHistogram plotter reads it.
    """
    total = int(row.sum())
    lines = [f"{'Value':>12} {'Percentile':>14} {'TotalCount':>10} {'1/(1-Percentile)':>17}", ""]
    upper = bucket_upper_ns()
    reached = 0
    for index in np.flatnonzero(row):
        reached += int(row[index])
        value = extreme[EXTREME_MAX] if reached == total else min(upper[index], extreme[EXTREME_MAX])
        inverse = f"{total / (total - reached):17.2f}" if reached < total else f"{'inf':>17}"
        lines.append(f"{value / ns_per_unit:12.3f} {reached / total:14.12f} {reached:10d} {inverse}")
    mean, deviation = mean_ns(extreme) / ns_per_unit, deviation_ns(row, extreme) / ns_per_unit
    lines.append(f"#[Mean    = {mean:12.3f}, StdDeviation   = {deviation:12.3f}]")
    lines.append(f"#[Max     = {extreme[EXTREME_MAX] / ns_per_unit:12.3f}, Total count    = {total:12d}]")
    lines.append(f"#[Buckets = {VALUE_BITS - SUB_BUCKET_BITS:12d}, SubBuckets     = {2 * SUB_BUCKET_COUNT:12d}]")
    return "\n".join(lines) + "\n"
