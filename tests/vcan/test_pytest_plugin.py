"""The plugin as a firmware team uses it, on a real bus; the inner tests run in a pytest of their own."""

import pytest

from hilrunner.base import compiled
from tests.tools import vcan_bench

pytestmark = pytest.mark.vcan
pytest_plugins = ["pytester"]

CACHE = compiled.cache_folder().parent  # pytester gives its tests another home, and with it a cold cache

TEN_LINES = """
import pytest

def test_lifts(hil_bench):
    # a slow period: the lab has one core, and the test needs some of it
    bench = hil_bench(profile="amc-lift.toml", options=["--engine", "reference", "--period-us", "5000", "--priority", "0"])
    command = bench.send_every(0.005, "VALVE_COMMAND_1", control="Active", valve_setpoint=50)
    bench.wait_until(lambda b: b.signal("MOTION_1", "rod_velocity_mmps") > 5, timeout_s=60)
    command.update(valve_setpoint=0)
    bench.wait_until(lambda b: abs(b.signal("MOTION_1", "rod_velocity_mmps")) < 0.5, timeout_s=60)
    bench.holds_for(lambda b: b.signal("BENCH_STATUS_1", "bench_state") == "active", 0.2)
    with pytest.raises(AssertionError, match="not within 0.1 s; newest signals: .*MOTION_1.*rod_position_mm"):
        bench.wait_until(lambda b: b.signal("MOTION_1", "rod_position_mm") > 9999, timeout_s=0.1)
    outcome = bench.stop()
    log = outcome.log()
    assert log.state["luffing"]["rod_position_m"].max() > 0.600
    taken = log.can_rx[log.can_rx["can_id"] == 0x201]
    assert len(taken) > 5 and taken["status"].max() == 0
    assert outcome.summary["exit_reason"] == "stopped by signal"

def test_refused(hil_bench):
    hil_bench(options=["--period-us", "1"])
"""


def test_a_bench_test_in_a_few_lines(pytester, monkeypatch):
    monkeypatch.setenv("HILRUNNER_CACHE", str(CACHE))
    vcan_bench.patient_profile(pytester.path)
    pytester.makepyfile(TEN_LINES)
    result = pytester.runpytest_subprocess("--timeout=280", "--durations=0")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*--period-us*1 us*"])
