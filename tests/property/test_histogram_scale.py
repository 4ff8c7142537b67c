"""For any samples: compiled and vectorised counting agree, and a percentile is never better than the truth nor 1.6 % worse."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hilrunner.base import histogram_scale as scale
from hilrunner.realtime.histogram import bucket_index, record_corrected, record_value

VALUES = st.lists(st.one_of(st.integers(0, 300), st.integers(0, scale.VALUE_NS_MAX)), min_size=1, max_size=200)


@given(VALUES)
@settings(deadline=None, derandomize=True)
def test_counting_agrees(values):
    rows, extremes = scale.empty()
    for value in values:
        record_value(rows, extremes, 0, value)
    row, extreme = scale.from_values(np.array(values))
    assert np.array_equal(rows[0], row) and np.array_equal(extremes[0], extreme)


@given(VALUES, st.floats(0.001, 1.0))
@settings(deadline=None, derandomize=True)
def test_a_percentile_never_flatters(values, ratio):
    row, extreme = scale.from_values(np.array(values))
    ordered = np.sort(values)
    truth = int(ordered[min(len(values), max(1, int(np.ceil(ratio * len(values) - 1e-9 * len(values))))) - 1])
    told = scale.quantile_ns(row, extreme, ratio)
    assert truth <= told <= truth + truth / 64


@given(st.integers(0, 1 << 45), st.integers(1, 1 << 34), st.integers(0, 2000))
@settings(deadline=None, derandomize=True)
def test_correction_is_the_sum_of_its_samples(value, period, skipped):
    rows, extremes = scale.empty()
    record_corrected(rows, extremes, 0, value, skipped, period)
    count = min(skipped, value // period)
    expected, expected_extreme = scale.from_values(value - period * np.arange(count + 1))
    assert np.array_equal(rows[0], expected) and extremes[0].tolist() == expected_extreme.tolist()


@given(st.integers(0, scale.VALUE_NS_MAX))
@settings(deadline=None, derandomize=True)
def test_a_value_lies_in_its_bucket(value):
    index = bucket_index(value)
    assert scale.bucket_lower_ns()[index] <= value <= scale.bucket_upper_ns()[index]
