"""The CAN interface: bits of a frame by hand, bus load, and the state of an interface from what the kernel tells."""

from pathlib import Path

import pytest

from hilrunner.setup import host_can
from hilrunner.setup.host_can import FrameTraffic
from hilrunner.setup.host_words import FAIL, OK, WARN, HostFiles

GOOD = {
    "linkinfo": {
        "info_kind": "can",
        "info_data": {"state": "ERROR-ACTIVE", "bittiming": {"bitrate": 500000}, "restart_ms": 100},
    }
}


def interface(root: Path, name: str, *, kind: int = 280, flags: str = "0x40081", queue: int = 1000) -> HostFiles:
    """An invented /sys/class/net entry."""
    folder = root / "sys/class/net" / name
    folder.mkdir(parents=True)
    for file, text in (("type", kind), ("flags", flags), ("tx_queue_len", queue)):
        (folder / file).write_text(f"{text}\n")
    return HostFiles(root)


# longest classic frames, shared/field.md and Davis et al. 2007, eq. (1) with the intermission: 135 and 160 bits of 8 bytes
@pytest.mark.parametrize("length, extended, bits", [(8, False, 135), (8, True, 160), (0, False, 55), (1, False, 65)])
def test_longest_frame(length, extended, bits):
    assert host_can.frame_bits(length, extended) == bits


def test_three_frames_a_millisecond():
    traffic = [FrameTraffic(1000.0)] * 3
    assert host_can.bus_load_ratio(traffic, 1_000_000) == pytest.approx(0.405)
    assert host_can.bus_load_ratio(traffic, 500_000) == pytest.approx(0.81)
    assert host_can.load_finding(traffic, 1_000_000).verdict == OK
    assert host_can.load_finding(traffic, 500_000).verdict == WARN
    assert host_can.load_finding(traffic, 250_000).verdict == FAIL


def test_faster_data_phase_lowers_the_load():
    slow = host_can.bus_load_ratio([FrameTraffic(100.0, 64, fd=True)], 500_000)
    fast = host_can.bus_load_ratio([FrameTraffic(100.0, 64, fd=True, data_bitrate=4_000_000)], 500_000)
    assert 0 < fast < slow / 3


def _verdicts(findings):
    return {finding.name: finding.verdict for finding in findings}


def test_a_sound_interface(tmp_path):
    found = host_can.interface_findings(interface(tmp_path, "can0"), "can0", GOOD)
    assert set(_verdicts(found).values()) == {OK}
    assert any("500 kbit/s" in finding.value for finding in found)


BAD = [
    ("can9", {}, GOOD, "CAN interface", FAIL),
    ("can0", {"kind": 1}, GOOD, "CAN interface", FAIL),
    ("can0", {"flags": "0x40080"}, GOOD, "CAN interface", FAIL),
    ("can0", {"queue": 10}, GOOD, "CAN transmit queue", WARN),
    ("can0", {}, {}, "CAN bit rate", WARN),
    ("can0", {}, {"linkinfo": {"info_data": {"state": "BUS-OFF"}}}, "CAN error state", FAIL),
    ("can0", {}, {"linkinfo": {"info_data": {"state": "ERROR-PASSIVE"}}}, "CAN error state", WARN),
    ("can0", {}, {"linkinfo": {"info_data": {"bittiming": {"bitrate": 500000}}}}, "CAN bit rate", WARN),
]


@pytest.mark.parametrize("asked, changes, details, name, verdict", BAD)
def test_an_unsound_interface(tmp_path, asked, changes, details, name, verdict):
    found = host_can.interface_findings(interface(tmp_path, "can0", **changes), asked, details)
    assert _verdicts(found)[name] == verdict
    assert all(finding.remedy for finding in found if finding.verdict != OK)


def test_a_virtual_interface_needs_neither_bit_rate_nor_queue(tmp_path):
    details = {"linkinfo": {"info_kind": "vcan"}}
    found = host_can.interface_findings(interface(tmp_path, "vcan0", queue=0), "vcan0", details)
    assert _verdicts(found) == {"CAN interface": OK, "CAN transmit queue": OK}
    assert "virtual" in found[0].value


def test_link_details_of_interfaces_that_are_and_are_not_there():
    assert host_can.link_details("nosuchcan0") == {}
    assert host_can.link_details("lo")["link_type"] == "loopback"
