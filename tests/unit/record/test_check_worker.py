"""The cross-check beside the drain: results, divergence in words, bounded backlog, its own failures."""

import threading

import check_plant
import numpy as np
import pytest

from hilrunner.base import records
from hilrunner.record import check_worker
from hilrunner.record.config import CheckConfig
from hilrunner.record.launch import plants_file

COUNT = 1500
PERIOD_NS = 1_000_000


@pytest.fixture(scope="module")
def run():
    axis = check_plant.lift_axis()
    start = check_plant.start_state(axis)
    ticks = np.arange(COUNT)
    commands = 0.5 * np.sin(ticks * 0.01)
    states = check_plant.run_reference(axis, commands, np.ones(COUNT), start)
    return axis, start, ticks, commands, states


def worker(run, **settings):
    axis, start, *_ = run
    made = CheckConfig(plants_file([axis, axis], None), [start.tolist(), start.tolist()], **settings)
    return check_worker.CheckWorker(made, ["boom", "jib"], PERIOD_NS)


def feed(checker, run, offset_pa=0.0, from_tick=0) -> None:
    _, _, ticks, commands, states = run
    tick = records.allocate(records.TICK, COUNT)
    tick["tick"] = ticks
    disturbed = states.copy()
    disturbed[from_tick:, 2] += offset_pa
    boom = check_plant.as_records(ticks, commands, np.ones(COUNT), states)
    jib = check_plant.as_records(ticks, commands, np.ones(COUNT), disturbed)
    command, state = (np.stack(pair, axis=1).ravel() for pair in zip(boom, jib, strict=True))
    for first in range(0, COUNT, 300):
        part, axes = slice(first, first + 300), slice(2 * first, 2 * first + 600)
        checker.take_ticks(tick[part], command[axes], state[axes], ticks[part] + 7, ticks[part] + 3)


def test_results_of_each_axis_in_order_with_their_times(run):
    checker = worker(run, pressure_tolerance_pa=1e4)
    feed(checker, run)
    assert checker.finish(500.0)
    results = checker.results()
    for axis in (0, 1):
        ticks = np.concatenate([one.check["tick"] for one in results if one.axis == axis])
        logged = np.concatenate([one.log_real_ns for one in results if one.axis == axis])
        published = np.concatenate([one.publish_real_ns for one in results if one.axis == axis])
        assert (ticks == np.arange(COUNT)).all()
        assert (logged == ticks + 7).all() and (published == ticks + 3).all()
    assert checker.failures() == [] and checker.error == ""
    summary = checker.summary()
    assert summary["boom"]["checked_ticks"] == COUNT
    assert summary["jib"]["chamber_1_pressure_error_pa_max"] == 0.0
    assert summary["left_out_ticks"] == 0


def test_a_divergence_is_told_once_with_place_value_and_limit(run):
    checker = worker(run, pressure_tolerance_pa=1e4, record_decimation=100)
    feed(checker, run, offset_pa=25_000.0, from_tick=777)
    assert checker.finish(500.0)
    ((tick, text),) = checker.failures()
    assert tick == 777
    assert "jib" in text and "chamber 1 pressure of the free run" in text
    assert "+2.5e+04 pa" in text and "allowed: 1.00" in text and "tick 777" in text
    kept = np.concatenate([one.check["tick"] for one in checker.results() if one.axis == 1])
    assert kept.tolist() == sorted({*range(0, COUNT, 100), 777})
    assert checker.summary()["jib"]["failed_tick"] == 777
    assert checker.summary()["boom"]["failed_tick"] is None


def test_the_backlog_is_bounded_and_what_is_left_out_is_counted(run, monkeypatch):
    monkeypatch.setattr(check_worker, "BACKLOG_TICKS_MAX", 700)
    gate = threading.Event()
    arm = check_worker.CheckWorker._arm

    def late(self):
        gate.wait()
        return arm(self)

    monkeypatch.setattr(check_worker.CheckWorker, "_arm", late)
    checker = worker(run)
    feed(checker, run)
    gate.set()
    assert checker.finish(500.0)
    assert checker.left_out_ticks == COUNT - 600
    assert checker.summary()["boom"]["checked_ticks"] == 600
    assert checker.lag_ns_max > 0


def test_a_check_that_cannot_start_says_so_and_takes_nothing_more(run):
    checker = check_worker.CheckWorker(CheckConfig(-1, []), ["boom", "jib"], PERIOD_NS)
    assert checker.finish(30.0)
    assert checker.error.startswith(("OSError", "ValueError"))
    feed(checker, run)
    assert checker.left_out_ticks == COUNT
    assert checker.summary()["error"] == checker.error


def test_a_check_that_does_not_end_in_time_is_left(run, monkeypatch):
    gate = threading.Event()
    monkeypatch.setattr(check_worker.CheckWorker, "_arm", lambda self: gate.wait())
    checker = worker(run)
    feed(checker, run)
    assert not checker.finish(0.05)
    assert checker.left_out_ticks == COUNT
    gate.set()
