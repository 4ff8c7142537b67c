"""The files that give rights: what they grant is what the loop asks for, and no more."""

import configparser
import re
from pathlib import Path

from hilrunner.cli import INTERRUPTED
from hilrunner.setup.host_rights import RealtimeOptions

FOLDER = Path(__file__).resolve().parents[2] / "tools" / "systemd"


def _unit() -> configparser.ConfigParser:
    unit = configparser.ConfigParser(interpolation=None, strict=True)
    unit.optionxform = str
    unit.read_string((FOLDER / "hilrunner@.service").read_text())
    return unit


def test_the_unit_grants_what_the_loop_asks_for():
    service = _unit()["Service"]
    assert int(service["LimitRTPRIO"]) >= RealtimeOptions().priority
    assert service["LimitMEMLOCK"] == "infinity"
    assert {"CAP_SYS_NICE", "CAP_IPC_LOCK"} <= set(service["AmbientCapabilities"].split())
    assert set(service["AmbientCapabilities"].split()) == set(service["CapabilityBoundingSet"].split())
    assert "CPUSchedulingPolicy" not in service  # the loop's thread asks for itself; the interpreter stays ordinary


def test_the_unit_ends_a_run_cleanly_and_does_not_repeat_it():
    service = _unit()["Service"]
    assert service["KillSignal"] == "SIGINT" and service["SuccessExitStatus"] == str(INTERRUPTED)
    assert service["Restart"] == "no"
    assert "--require-realtime" in service["ExecStart"] and "--can %i" in service["ExecStart"]


def test_limits_are_lines_pam_reads():
    lines = [line for line in (FOLDER / "hilrunner-limits.conf").read_text().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"@realtime\s+-\s+(rtprio|memlock|nice)\s+(-?\d+|unlimited)", line) for line in lines)
    granted = {line.split()[2]: line.split()[3] for line in lines}
    assert int(granted["rtprio"]) >= RealtimeOptions().priority and granted["memlock"] == "unlimited"


def test_the_device_rule_names_the_device_and_the_group_of_the_unit():
    rule = [line for line in (FOLDER / "99-hilrunner.rules").read_text().splitlines() if not line.startswith("#")]
    assert rule == ['KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660"']
    assert _unit()["Service"]["SupplementaryGroups"] == "realtime"
