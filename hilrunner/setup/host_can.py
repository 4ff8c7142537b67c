"""The CAN interface: there, up, at which bit rate, in which error state, how long its queue, and how full the bus will be."""

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass

from hilrunner.setup.host_words import FAIL, OK, WARN, Finding, HostFiles

ARPHRD_CAN = 280
IFF_UP = 1
QUEUE_FRAMES_MIN = 64  # room for a burst: 16 axes send 48 frames a period
LOAD_RATIO_WARN = 0.6
LOAD_RATIO_FAIL = 0.9
_SYSTEM_PATH = os.environ.get("PATH", "") + ":/usr/sbin:/sbin"


@dataclass(frozen=True)
class FrameTraffic:
    """Frames of one kind: how many a second, data bytes, 29-bit id, FD (with the data phase's bit rate)."""

    frames_per_s: float
    length: int = 8
    extended: bool = False
    fd: bool = False
    data_bitrate: int = 0


def frame_bits(length: int, extended: bool = False) -> int:
    """Bits of a classic frame on the wire with the most stuff bits possible and the intermission.

    ISO 11898-1: 47 (67 with a 29-bit id) bits around the data, a stuff bit after every four of the bits that are stuffed
    (34 or 54 and the data) but the first. 8 bytes: 135 (11-bit), 160 (29-bit).
    """
    framing, stuffed = (67, 54) if extended else (47, 34)
    return framing + 8 * length + (stuffed + 8 * length - 1) // 4


def _fd_time_s(traffic: FrameTraffic, bitrate: int) -> float:
    """Longest time of one FD frame: arbitration part at `bitrate`, data part at the faster rate (ISO 11898-1:2015)."""
    slow_bits = (49 if traffic.extended else 30) * 5 / 4
    crc_bits = 21 if traffic.length > 16 else 17
    fast_bits = 9 * 5 / 4 + 8 * traffic.length * 5 / 4 + (4 + crc_bits) * 5 / 4
    return slow_bits / bitrate + fast_bits / (traffic.data_bitrate or bitrate)


def bus_load_ratio(traffic: Sequence[FrameTraffic], bitrate: int) -> float:
    """Share of the bus (0..1 and beyond) that frames take at worst-case bit stuffing; bitrate in bit/s."""
    load = 0.0
    for kind in traffic:
        if kind.fd:
            load += kind.frames_per_s * _fd_time_s(kind, bitrate)
        else:
            load += kind.frames_per_s * frame_bits(kind.length, kind.extended) / bitrate
    return load


def load_finding(traffic: Sequence[FrameTraffic], bitrate: int) -> Finding:
    """The bus load of a profile against what a bus carries without starving low priorities."""
    ratio = bus_load_ratio(traffic, bitrate)
    frames = sum(kind.frames_per_s for kind in traffic)
    value = f"{ratio:.0%} of {bitrate / 1000:g} kbit/s ({frames:g} frames/s, worst-case stuffing)"
    if ratio < LOAD_RATIO_WARN:
        return Finding("CAN bus load", value, OK)
    verdict = FAIL if ratio >= LOAD_RATIO_FAIL else WARN
    return Finding("CAN bus load", value, verdict, "raise the bit rate, lengthen the period, or send fewer messages")


def link_details(interface: str) -> dict:
    """What `ip -details` says of an interface; empty when it cannot be asked."""
    ip = shutil.which("ip", path=_SYSTEM_PATH)
    if ip is None:
        return {}
    try:
        answer = subprocess.run([ip, "-d", "-j", "link", "show", "dev", interface], capture_output=True, timeout=5)
        return json.loads(answer.stdout or b"[{}]")[0]
    except (OSError, subprocess.TimeoutExpired, ValueError, IndexError):
        return {}


def interface_findings(files: HostFiles, interface: str, details: dict | None = None) -> list[Finding]:
    """Existence, link, bit rate, error state and transmit queue of one interface.

    Args:
        details: what `link_details` returns (a test brings its own); None asks.
    """
    folder = f"sys/class/net/{interface}"
    kind = files.number(f"{folder}/type")
    if kind is None:
        remedy = f"plug it in, or: ip link add dev {interface} type vcan; or hilrunner lab -- COMMAND"
        return [Finding("CAN interface", f"{interface} does not exist", FAIL, remedy)]
    if kind != ARPHRD_CAN:
        return [
            Finding("CAN interface", f"{interface} is not a CAN interface", FAIL, "name a CAN interface (ip -br link)")
        ]
    details = link_details(interface) if details is None else details
    info = details.get("linkinfo", {})
    data = info.get("info_data", {})
    virtual = info.get("info_kind") in ("vcan", "vxcan") or interface.startswith(("vcan", "vxcan"))
    return [
        _link(files, folder, interface, virtual),
        *([] if virtual else [_bit_rate(data, interface), _error_state(data, interface)]),
        _queue(files, folder, interface, virtual),
    ]


def _link(files: HostFiles, folder: str, interface: str, virtual: bool) -> Finding:
    flags = int(files.text(f"{folder}/flags") or "0", 16)
    name = f"{interface}{' (virtual: no arbitration, no bit rate, no errors)' if virtual else ''}"
    if flags & IFF_UP:
        return Finding("CAN interface", f"{name} is up", OK)
    up = (
        f"ip link set {interface} up"
        if virtual
        else f"ip link set {interface} type can bitrate 1000000 && ip link set {interface} up"
    )
    return Finding("CAN interface", f"{name} is down", FAIL, up)


def _bit_rate(data: dict, interface: str) -> Finding:
    bitrate = data.get("bittiming", {}).get("bitrate")
    if not bitrate:
        return Finding(
            "CAN bit rate", "not told", WARN, "install iproute2, or set it: ip link set CAN type can bitrate N"
        )
    fast = data.get("data_bittiming", {}).get("bitrate")
    value = f"{bitrate / 1000:g} kbit/s" + (f", data phase {fast / 1000:g} kbit/s" if fast else "")
    if data.get("restart_ms"):
        return Finding("CAN bit rate", value, OK)
    remedy = f"ip link set {interface} type can restart-ms 100 (bus-off then lasts 0.1 s, not for ever)"
    return Finding("CAN bit rate", f"{value}, no restart after bus-off", WARN, remedy)


def _error_state(data: dict, interface: str) -> Finding:
    state = data.get("state")
    counters = data.get("berr_counter", {})
    value = f"{state or 'not told'}" + (f", errors tx {counters.get('tx')} rx {counters.get('rx')}" if counters else "")
    if state == "ERROR-ACTIVE":
        return Finding("CAN error state", value, OK)
    if state in ("BUS-OFF", "STOPPED"):
        return Finding(
            "CAN error state",
            value,
            FAIL,
            f"check bit rate, termination and wiring, then ip link set {interface} down; … up",
        )
    return Finding(
        "CAN error state", value, WARN, "check bit rate, termination (60 ohm) and that another node acknowledges"
    )


def _queue(files: HostFiles, folder: str, interface: str, virtual: bool) -> Finding:
    length = files.number(f"{folder}/tx_queue_len")
    if virtual:
        return Finding("CAN transmit queue", "none needed (virtual)", OK)
    if length is None or length >= QUEUE_FRAMES_MIN:
        return Finding("CAN transmit queue", "not told" if length is None else f"{length} frames", OK)
    return Finding(
        "CAN transmit queue", f"{length} frames", WARN, f"ip link set {interface} txqueuelen {4 * QUEUE_FRAMES_MIN}"
    )
