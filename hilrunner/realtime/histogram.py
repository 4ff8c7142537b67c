"""Wait-free latency histograms of the loop: one store into a bucket, four into the extremes, nothing else.

The scale (64 buckets a power of two, 1 ns to 1100 s) and everything that reads a histogram live in `base.histogram_scale`.
Invariants: only the loop stores; a reader in another process may see a bucket one sample ahead of its extremes, no worse.
"""

from hilrunner.base.compiled import hot
from hilrunner.base.histogram_scale import SUB_BUCKET_BITS, SUB_BUCKET_COUNT, VALUE_NS_MAX

_OCTAVE_SHIFT_MAX = 32


@hot
def bucket_index(value_ns):
    """Bucket of a value in ns, 0 … BUCKET_COUNT - 1; negative counts as 0, beyond the range as the last. About 2 ns."""
    value = min(max(value_ns, 0), VALUE_NS_MAX)
    shift = 0  # floor(log2(value)) - SUB_BUCKET_BITS, by halving: no call, no table
    rest = value >> (SUB_BUCKET_BITS + 1)
    step = _OCTAVE_SHIFT_MAX
    while step > 0:
        if rest >> (step - 1) != 0:
            shift += step
            rest >>= step
        step >>= 1
    return shift * SUB_BUCKET_COUNT + (value >> shift)


@hot
def record_value(histogram, extreme, index, value_ns):
    """Count one sample of histogram `index`.

    Args:
        histogram: int64[H, BUCKET_COUNT], written.
        extreme: int64[H, 4] (min, max, sum, count), written.
        index: which histogram (place in `records.HISTOGRAM_NAMES`).
        value_ns: the sample; negative values keep their place in the minimum and count in bucket 0.
    """
    histogram[index, bucket_index(value_ns)] += 1
    if extreme[index, 3] == 0 or value_ns < extreme[index, 0]:
        extreme[index, 0] = value_ns
    if extreme[index, 3] == 0 or value_ns > extreme[index, 1]:
        extreme[index, 1] = value_ns
    extreme[index, 2] += value_ns
    extreme[index, 3] += 1


@hot
def record_corrected(histogram, extreme, index, value_ns, skipped_count, period_ns):
    """Count a late sample and the samples that never were: each skipped period was late by one period less.

    A stall of five periods is one bad sample on paper and five bad periods in fact ("coordinated omission",
    HdrHistogram `recordValueWithExpectedInterval`). Samples: value - k period_ns, k = 0 … skipped_count, not below 0.
    Cost: at most one step a bucket, however many periods were skipped.
    """
    record_value(histogram, extreme, index, value_ns)
    value = value_ns - period_ns
    remaining = min(skipped_count, value_ns // period_ns)
    while remaining > 0:
        bucket = bucket_index(value)
        shift = max(bucket // SUB_BUCKET_COUNT - 1, 0)
        lower = (bucket - shift * SUB_BUCKET_COUNT) << shift
        count = min(remaining, (value - lower) // period_ns + 1)
        histogram[index, bucket] += count
        lowest = value - (count - 1) * period_ns
        extreme[index, 0] = min(extreme[index, 0], lowest)
        extreme[index, 2] += count * lowest + period_ns * (count * (count - 1) // 2)
        extreme[index, 3] += count
        value = lowest - period_ns
        remaining -= count
