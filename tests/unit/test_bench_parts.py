"""The arithmetic of the bench: turns, ratios, cyclictest's output, bisection, tables."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from hilrunner.base import histogram_scale
from hilrunner.bench import capacity, compare, cyclictest, disturb, results, tick, turns
from hilrunner.bench.peer import socket_pair
from hilrunner.bench.tick import Slice
from hilrunner.realtime.histogram import record_corrected

VERBOSE = """Using 1 cpus.
# /dev/cpu_dma_latency set to 0us
       0:       0:   42749
       0:       1:    9007
       0:       2: 2500100
"""


def test_cyclictest_lines():
    assert cyclictest.parse(VERBOSE).tolist() == [42749, 9007, 2_500_100]
    assert cyclictest.parse("unable to set scheduler: Operation not permitted").size == 0


def test_cyclictest_command_keeps_its_printer_off_the_core():
    words = cyclictest.command(cpu=3, other_cpu=0, priority=80, period_ns=250_000, count=4000)
    assert {"-a3", "--mainaffinity=0", "-p80", "-i250", "-l4000", "-N", "-v", "-m", "-t1"} <= set(words)


@pytest.mark.parametrize("lateness_ns", [0, 999_999, 1_000_000, 5_400_000, 33_000_017])
def test_a_stall_counts_alike_in_cyclictest_and_in_our_loop(lateness_ns):
    rows, extremes = histogram_scale.empty()
    record_corrected(rows, extremes, 0, lateness_ns, lateness_ns // 1_000_000, 1_000_000)
    rival = cyclictest.corrected(np.array([lateness_ns]), 1_000_000)
    expected, expected_extreme = histogram_scale.from_values(rival)
    assert np.array_equal(rows[0], expected) and extremes[0].tolist() == expected_extreme.tolist()


def test_everyone_goes_first_once():
    order = []
    slices = {name: (lambda name=name: order.append(name) or len(order)) for name in "abc"}
    taken = turns.take_turns(slices, 3)
    assert "".join(order) == "abcbcacab"
    assert taken == {"a": [1, 6, 8], "b": [2, 4, 9], "c": [3, 5, 7]}


def test_ratios_are_taken_within_a_round():
    assert turns.median_ratio([1.0, 20.0, 300.0], [1.0, 10.0, 100.0]) == 2.0
    assert np.isnan(turns.median_ratio([1.0], [0.0]))


def test_repetitions_fill_the_slice_and_times_are_per_repetition(monkeypatch):
    now_s = [0.0]
    monkeypatch.setattr(turns.time, "perf_counter", lambda: now_s[0])
    monkeypatch.setattr(turns.time, "perf_counter_ns", lambda: round(now_s[0] * 1e9))
    counts = []

    def run(count: int) -> None:  # 2 us a repetition on a clock of our own
        counts.append(count)
        now_s[0] += 2e-6 * count

    times = turns.time_turns({"a": run}, rounds=2, slice_s=0.1)
    assert counts[-2] == counts[-1] == pytest.approx(50_000, abs=1)
    assert times["a"] == pytest.approx([2000.0, 2000.0])


@pytest.mark.parametrize("most", [0, 1, 2, 3, 7, 8, 21, 62])
def test_bisection_finds_the_most(most):
    tried = []

    def fits(count):
        tried.append(count)
        return count <= most

    assert capacity.bisect_most(fits, 62) == most
    assert len(tried) == len(set(tried)) and max(tried) <= 62


def _slice_with(wake_ns: list[int]) -> Slice:
    rows, extremes = histogram_scale.empty(10)
    rows[0], extremes[0] = histogram_scale.from_values(np.array(wake_ns))
    return Slice(rows, extremes, len(wake_ns), 0, 0, 0, 0, 0, 0, 0, np.zeros((1, 10)))


@pytest.mark.parametrize(
    "wake_ns, spin_ns", [([1_000] * 100, 20_000), ([55_001] * 100, 60_000), ([9_000_000] * 9, 300_000)]
)
def test_spin_tail_covers_the_usual_wake_up(wake_ns, spin_ns):
    assert compare.choose_spin_ns(_slice_with(wake_ns)) == spin_ns


CELLS = [
    (None, "-"),
    (0.0123456, "0.0123"),
    (0.5, "0.50"),
    (12.345, "12.3"),
    (1234.5, "1234"),
    (7, "7"),
    (True, "True"),
]


@pytest.mark.parametrize("value, shown", [*CELLS, (float("nan"), "-"), (0.0, "0.00"), ("x", "x"), (2e-7, "2e-07")])
def test_cells(value, shown):
    assert results.cell(value) == shown


def test_a_table_for_people_and_for_machines():
    table = results.Table("k", "Title", ("", "us"), [("long name", 1.5), ("b", None)], ["a note"], {"x_ns": 3})
    lines = results.text(table).splitlines()
    assert lines[0] == "Title"
    assert lines[3:5] == ["long name  1.50", "b             -"]
    assert lines[5] == "  a note"
    parsed = json.loads(json.dumps(table.as_dict()))
    assert parsed == {
        "title": "Title",
        "rows": [{"": "long name", "us": 1.5}, {"": "b", "us": None}],
        "notes": ["a note"],
        "x_ns": 3,
    }


def test_a_result_has_a_fingerprint_that_sees_one_bit():
    values = np.linspace(0.0, 1.0, 9)
    other = values.copy()
    other[4] = np.nextafter(other[4], 2.0)
    assert turns.fingerprint(values) != turns.fingerprint(other)
    assert turns.fingerprint(values) == turns.fingerprint(values.copy())


def test_socketpair_holds_a_burst_of_a_thousand_frames():
    ours, theirs = socket_pair()
    with ours, theirs:
        for _ in range(1000):
            theirs.send(bytes(16))
        taken = 0
        while taken < 1000 and ours.recv(128):
            taken += 1
    assert taken == 1000


class QuietBench:
    """A bench whose every slice is the same ten ticks."""

    place, period_ns = tick.Place(cpu=1, other_cpu=0, priority=80), 1_000_000

    def __init__(self, *_, **__) -> None:
        row, extreme = histogram_scale.from_values(np.full(10, 5_000))
        count = len(tick.HISTOGRAM_NAMES)
        facts = dict.fromkeys(("misses", "skipped", "dropped", "frames_received", "frames_sent", "peer_sent"), 0)
        rows = {"histogram": np.tile(row, (count, 1)), "extreme": np.tile(extreme, (count, 1))}
        self.slice = Slice(**rows, ticks=10, **facts, processor_ns=10_000, state=np.zeros((1, 10)))

        self.armed = SimpleNamespace(bench=SimpleNamespace(state=self.slice.state))

    def run(self, *_, **__):
        return self.slice

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None


@pytest.fixture
def refused(monkeypatch, tmp_path):
    """A cyclictest that is there and gets no real time, as in a container without CAP_SYS_NICE."""
    program = tmp_path / "cyclictest"
    program.write_text("#!/bin/sh\necho 'Unable to change scheduling policy!' >&2\nexit 1\n")
    program.chmod(0o700)
    monkeypatch.setattr(cyclictest, "program", lambda: str(program))
    monkeypatch.setattr(capacity, "TickBench", QuietBench)
    monkeypatch.setattr(capacity, "PERIODS_US", (1000,))
    monkeypatch.setattr(disturb, "DISTURBANCES", {})
    cyclictest.left_out.cache_clear()
    yield
    cyclictest.left_out.cache_clear()


@pytest.mark.parametrize(
    "table",
    [
        lambda: compare.compare(QuietBench(), 1, 0.01)[0],
        lambda: capacity.shortest_period(QuietBench.place, "amc-lift", 0, 0.01),
        lambda: disturb.disturb_table(QuietBench(), 1, 0.01),
    ],
)
def test_a_rival_that_is_refused_real_time_is_left_out_and_told(refused, table):
    made = table()
    assert any("Unable to change scheduling policy!" in note for note in made.notes)
    assert not any("cyclictest" in str(row[0]) for row in made.rows) and made.rows


def test_a_rival_that_is_not_there_is_told(monkeypatch):
    cyclictest.left_out.cache_clear()
    monkeypatch.setattr(cyclictest, "program", lambda: None)
    assert "apt install rt-tests" in cyclictest.left_out(1, 0, 80)
    cyclictest.left_out.cache_clear()
