"""Histograms: where a value is counted, what percentiles say, what skipped periods add, and the `.hgrm` text."""

import numpy as np
import pytest

from hilrunner.base import histogram_scale as scale
from hilrunner.base.records import STATISTIC_NAMES
from hilrunner.realtime.histogram import bucket_index, record_corrected, record_value

# bucket by hand: below 128 the value itself; [128, 256) in steps of 2 from bucket 128; [1024, 2048) in steps of 16 from 320
BY_HAND = [
    (0, 0),
    (1, 1),
    (127, 127),
    (128, 128),
    (129, 128),
    (130, 129),
    (255, 191),
    (256, 192),
    (1024, 320),
    (1039, 320),
]


@pytest.mark.parametrize("value_ns, bucket", BY_HAND)
def test_bucket_by_hand(value_ns, bucket):
    assert bucket_index(value_ns) == bucket
    assert scale.bucket_indices(np.array([value_ns]))[0] == bucket


def test_every_bucket_bound_is_its_own():
    lower, upper = scale.bucket_lower_ns(), scale.bucket_upper_ns()
    assert lower.size == scale.BUCKET_COUNT == 2240
    for index in range(0, scale.BUCKET_COUNT, 7):
        assert bucket_index(lower[index]) == index
        assert bucket_index(upper[index]) == index


def test_buckets_are_narrow_and_cover_the_range():
    lower, upper = scale.bucket_lower_ns().astype(float), scale.bucket_upper_ns().astype(float)
    wide = lower >= 64
    assert np.max((upper - lower)[wide] / lower[wide]) < 1 / 64
    assert np.all(lower[1:] == upper[:-1] + 1)
    assert upper[-1] > 1000e9


@pytest.mark.parametrize(
    "value_ns, bucket", [(-5, 0), (1 << 62, scale.BUCKET_COUNT - 1), (1 << 40, scale.BUCKET_COUNT - 1)]
)
def test_values_beyond_the_range_are_counted_at_its_ends(value_ns, bucket):
    assert bucket_index(value_ns) == bucket


def test_extremes_are_exact_and_negative_minimum_is_kept():
    rows, extremes = scale.empty(2)
    for value in (1000, -7, 123_456_789):
        record_value(rows, extremes, 1, value)
    assert extremes[1].tolist() == [-7, 123_456_789, 123_457_782, 3]
    assert rows[0].sum() == 0 and rows[1].sum() == 3


def test_percentiles_of_known_samples():
    rows, extremes = scale.empty()
    for value in range(1, 101):  # 1 … 100 ns: every value has a bucket of its own
        record_value(rows, extremes, 0, value)
    assert scale.percentiles(rows[0], extremes[0]) == {
        "min": 1, "p50": 50, "p90": 90, "p99": 99, "p999": 100, "p9999": 100, "p99999": 100, "max": 100,
    }  # fmt: skip


def test_percentile_is_never_below_the_sample_nor_above_the_maximum():
    rows, extremes = scale.empty()
    for value in (1_000_003, 1_000_005):
        record_value(rows, extremes, 0, value)
    statistics = scale.percentiles(rows[0], extremes[0])
    assert statistics["p50"] == 1_000_005  # the bucket's upper edge is higher: capped by the true maximum
    assert tuple(statistics) == STATISTIC_NAMES


def test_a_value_beyond_the_range_shows_in_its_percentile():
    rows, extremes = scale.empty()
    record_value(rows, extremes, 0, 5 << 40)
    assert scale.percentiles(rows[0], extremes[0])["p50"] == 5 << 40


def test_no_samples_no_percentiles():
    rows, extremes = scale.empty()
    assert set(scale.percentiles(rows[0], extremes[0]).values()) == {0}
    assert scale.mean_ns(extremes[0]) == 0.0 and scale.deviation_ns(rows[0], extremes[0]) == 0.0


def test_a_stall_of_five_periods_counts_as_five_late_samples_more():
    rows, extremes = scale.empty()
    record_corrected(rows, extremes, 0, 5_400_000, 5, 1_000_000)
    expected, expected_extreme = scale.from_values(np.arange(6) * 1_000_000 + 400_000)
    assert np.array_equal(rows[0], expected)
    assert extremes[0].tolist() == expected_extreme.tolist()


def test_correction_never_adds_more_samples_than_periods_fit():
    rows, extremes = scale.empty()
    record_corrected(rows, extremes, 0, 1_500_000, 5, 1_000_000)  # only one skipped period was already due
    assert extremes[0].tolist() == [500_000, 1_500_000, 2_000_000, 2]


def test_an_hour_of_stall_is_corrected_exactly():
    rows, extremes = scale.empty()
    period_ns, skipped = 1_000_000, 3_600_000
    record_corrected(rows, extremes, 0, skipped * period_ns + 17, skipped, period_ns)
    values = np.arange(skipped + 1, dtype=np.int64) * period_ns + 17
    expected, expected_extreme = scale.from_values(values)
    assert np.array_equal(rows[0], expected)
    assert extremes[0].tolist() == expected_extreme.tolist()


def test_merge_ignores_empty_rows():
    row, extreme = scale.from_values(np.array([5, 9]))
    rows, extremes = scale.merge(np.stack([row, 0 * row]), np.stack([extreme, 0 * extreme]))
    assert extremes.tolist() == [5, 9, 14, 2] and rows.sum() == 2


def test_count_above_a_bucket_bound():
    row, _ = scale.from_values(np.array([100, 127, 128, 5000]))
    assert scale.count_above(row, 127) == 2


def test_hgrm_lines_by_hand():
    row, extreme = scale.from_values(np.array([1000, 1000, 1000, 4000]))
    lines = scale.hgrm(row, extreme, ns_per_unit=1000.0).splitlines()
    assert lines[0].split() == ["Value", "Percentile", "TotalCount", "1/(1-Percentile)"]
    assert lines[2].split() == ["1.007", "0.750000000000", "3", "4.00"]  # bucket 1000 … 1007 ns
    assert lines[3].split() == ["4.000", "1.000000000000", "4", "inf"]
    assert lines[4] == "#[Mean    =        1.750, StdDeviation   =        1.304]"
    assert lines[5] == "#[Max     =        4.000, Total count    =            4]"
