"""`hilrunner doctor`: the exit code says what --require-realtime would, and both readers get the same findings."""

import json
import os

import pytest

from hilrunner import cli
from hilrunner.setup import host
from hilrunner.setup.host_words import FAIL, OK, Finding, Grant


def doctor(capsys, *words: str) -> tuple[int, str]:
    code = cli.main(["doctor", "--seconds", "0.05", *words])
    return code, capsys.readouterr().out


def test_of_this_host(capsys):
    code, out = doctor(capsys, "--json")
    found = json.loads(out)
    assert code == (0 if found["ready"] else 6)
    assert found["ready"] == (found["label"] == "real-time verified") == (not found["reasons"])
    assert {grant["name"] for grant in found["grants"]} >= {"scheduling", "memory lock", "core", "garbage collector"}
    assert {finding["name"] for finding in found["findings"]} >= {host.WAKE_UP, host.WAKE_UP_DISTURBED, "clock reading"}
    assert os.sched_getscheduler(0) == os.SCHED_OTHER, "the rights are given back"


def test_bus_load_and_period_come_from_the_profile(capsys):
    _, out = doctor(capsys, "--json", "--profile", "amc-lift")
    load = next(finding for finding in json.loads(out)["findings"] if finding["name"] == "CAN bus load")
    # one command and two measurements every millisecond, the status and the heave every ten: 3200 frames of at most 135 bits
    assert load["value"].startswith("43% of 1000 kbit/s (3200 frames/s") and load["verdict"] == OK


def test_an_interface_that_is_not_there_fails(capsys):
    code, out = doctor(capsys, "--can", "nosuchcan0")
    assert code == 6
    assert "CAN interface" in out and "nosuchcan0 does not exist" in out and "-> plug it in" in out


GOOD_GRANTS = [Grant("scheduling", "SCHED_FIFO 80", "SCHED_FIFO 80", True), Grant("memory lock", "all", "9 MiB", True)]
GOOD_FINDINGS = (
    Finding("kernel preemption", "PREEMPT_RT", OK),
    Finding("virtual machine", "no", OK),
    Finding(host.WAKE_UP, "late by …", OK),
)


@pytest.mark.parametrize("bad", [(), (Finding("clocksource", "jiffies", FAIL, "boot with tsc"),)])
def test_exit_code_follows_the_label(capsys, monkeypatch, bad):
    facts = dict.fromkeys(("processor", "cores", "memory", "kernel", "machine", "python", "numpy", "numba"), "x")
    monkeypatch.setattr(host, "enter_realtime", lambda options: GOOD_GRANTS)
    monkeypatch.setattr(host, "inspect_host", lambda *_, **__: host.HostReport(GOOD_FINDINGS + bad, facts))
    code, out = doctor(capsys)
    assert code == (6 if bad else 0)
    assert ("a run here is: best effort" in out) == bool(bad)
    assert ("because of clocksource: jiffies" in out) == bool(bad)
    assert ("a run here is: real-time verified" in out) == (not bad)


def test_a_profile_that_is_not_there_is_bad_input(capsys):
    assert cli.main(["doctor", "--profile", "no-such-profile"]) == 2
    assert "no such profile" in capsys.readouterr().err
