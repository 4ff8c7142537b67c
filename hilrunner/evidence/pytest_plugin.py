"""pytest plugin: a firmware team's bench test in a few lines (docs/evidence.md).

    def test_lifts(hil_bench):
        bench = hil_bench(profile="amc-lift")
        command = bench.send_every(0.005, "VALVE_COMMAND_1", control="Active", valve_setpoint=50)
        bench.wait_until(lambda b: b.signal("MOTION_1", "rod_velocity_mmps") > 5)
        command.update(valve_setpoint=0)
        bench.wait_until(lambda b: abs(b.signal("MOTION_1", "rod_velocity_mmps")) < 0.5)
        assert bench.stop().report().verdict.passed

The bus is `--hil-channel` (default vcan0) of `--hil-interface` (default socketcan), also as ini options.
"""

import itertools
from pathlib import Path

import pytest


def pytest_addoption(parser) -> None:
    """The bus and the profile every bench of a session uses unless it names its own."""
    group = parser.getgroup("hilrunner")
    for name, default, text in (
        ("interface", "socketcan", "python-can interface of the bench's bus"),
        ("channel", "vcan0", "channel of the bench's bus"),
        ("profile", "amc-lift", "profile of the bench: a name or a TOML file"),
    ):
        group.addoption(f"--hil-{name}", default=None, help=f"{text} (default: {default})")
        parser.addini(f"hil_{name}", text, default=default)


@pytest.fixture
def hil_bench(request, tmp_path):
    """Start benches: `hil_bench(profile=…, options=[…], dbc=…)` returns a running evidence.bench_client.Bench.

    Whatever the test does, nothing keeps running after it; a bench that the test did not stop itself is ended as by Ctrl-C, and
    the test fails if it ended with another exit code than 0. The log lies in the test's tmp_path.
    """
    started = []
    numbers = itertools.count(1)  # a bench that does not start has a log's name as well

    def start(profile: str | None = None, options: list[str] | None = None, dbc: str | Path | None = None):
        from hilrunner.evidence.bench_client import Bench, bench_command
        from hilrunner.evidence.signals import Messages
        from hilrunner.setup.contract import dbc_path
        from hilrunner.setup.profile import load_profile

        chosen = {name: _option(request.config, name) for name in ("interface", "channel", "profile")}
        name = str(profile or chosen["profile"])
        messages = Messages(dbc or dbc_path(load_profile(name)))
        log = tmp_path / f"run{next(numbers)}.mcap"
        command = bench_command(chosen["interface"], chosen["channel"], name, list(options or []))
        bench = Bench(command, log, chosen["interface"], chosen["channel"], messages)
        bench.wait_started()  # closes it where it does not start
        started.append(bench)
        return bench

    yield start
    _end(started)


def _option(config, name: str) -> str:
    return config.getoption(f"--hil-{name}") or config.getini(f"hil_{name}")


def _end(benches) -> None:
    failed = []
    for bench in benches:
        try:
            untouched = bench.outcome is None
            outcome = bench.stop()
            if untouched and outcome.exit_code != 0:
                failed.append(f"exit code {outcome.exit_code}: {outcome.messages}")
        finally:
            bench.close()
    if failed:
        pytest.fail("the bench ended with " + "; ".join(failed))
