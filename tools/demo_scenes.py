"""The three scenes of the demo, played where there is a vcan0: the loop closed, the firmware lost, the runner killed.

    demo_scenes.py OUTPUT_FOLDER

Writes the logs, what the programs said, and scenes.json. Judges nothing: that is demo_checks.py, outside.
"""

import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OUT = "runs/demo"
PROFILE = "amc-lift"
INTERFACE = "vcan0"
FIRMWARE = ROOT / "firmware_iface" / "c" / "build" / "reference_firmware"
PERIODS_US = (
    1000,
    2000,
    4000,
)  # the shortest this host's bus and core can hold is taken; User-Mode Linux is one slow core
TICKS_RUN_RATIO_MIN = 0.95
CLOSED_LOOP_S = 26
FIRMWARE_LOST_S = 16
FIRMWARE_LOST_AT_S = 6
FIRMWARE_BACK_AT_S = 11
RUNNER_KILLED_AT_S = 6
CANDUMP_FRAMES = 40
START_LIMIT_S = 180
BENCH_STATUS_ID = 0x381
MCAP_MAGIC = b"\x89MCAP0\r\n"


def say(text: str) -> None:
    """One line of the story."""
    print(f"  {text}", flush=True)


class Bus:
    """A raw CAN socket that sees one identifier."""

    def __init__(self, can_id: int) -> None:
        self.socket = socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", can_id, 0x7FF))
        self.socket.bind((INTERFACE,))
        self.socket.settimeout(0.5)

    def wait(self, limit_s: float, alive: subprocess.Popen) -> None:
        """Until a frame comes."""
        end_s = time.monotonic() + limit_s
        while time.monotonic() < end_s and alive.poll() is None:
            try:
                self.socket.recv(16)
                return
            except TimeoutError:
                continue
        raise SystemExit(f"demo: no frame from the bench within {limit_s} s (exit code {alive.poll()})")

    def newest(self) -> bytes:
        """The data of the newest frame that waits."""
        self.socket.setblocking(False)
        data = b""
        while True:
            try:
                data = self.socket.recv(16)[8:]
            except BlockingIOError:
                return data


def start_bench(out: Path, name: str, period_us: int, *options: str) -> tuple[subprocess.Popen, Bus]:
    """Start hilrunner and wait for its first frame on the bus."""
    words = ["--can", INTERFACE, "--profile", PROFILE, "--log", str(out / f"{name}.mcap"), *options]
    words += ["--period-us", str(period_us)] if period_us != PERIODS_US[0] else []
    say(f"$ hilrunner {' '.join(words[:4])} {' '.join(options)} --log {OUT}/{name}.mcap")
    bus = Bus(BENCH_STATUS_ID)
    with open(out / f"{name}.txt", "wb") as said:
        bench = subprocess.Popen(
            [sys.executable, "-m", "hilrunner", *words], stdout=said, stderr=subprocess.STDOUT, cwd=ROOT
        )
    bus.wait(START_LIMIT_S, bench)
    return bench, bus


def start_firmware(out: Path, name: str, period_us: int) -> subprocess.Popen:
    """Start the reference firmware; it prints one line of JSON when it ends."""
    priority = ["--priority", "70"] if os.geteuid() == 0 else []  # below the bench's 80, above everything else
    with open(out / f"{name}-firmware.json", "wb") as said:
        return subprocess.Popen([FIRMWARE, "-i", INTERFACE, "-p", str(period_us), *priority], stdout=said)


def end_firmware(out: Path, name: str, firmware: subprocess.Popen) -> dict:
    """SIGINT, and what it says about its tracking."""
    firmware.send_signal(signal.SIGINT)
    firmware.wait(20)
    return json.loads((out / f"{name}-firmware.json").read_text())


def show(out: Path, name: str) -> None:
    """What the bench printed."""
    for line in (out / f"{name}.txt").read_text().splitlines():
        print(f"    | {line[:150]}", flush=True)


def closed_loop(out: Path, period_us: int) -> dict:
    """Firmware and bench, both healthy; a few frames of the bus are kept as candump shows them."""
    name = "closed-loop"
    say(f"scene 1: closed loop for {CLOSED_LOOP_S} s, period {period_us} us")
    bench, _ = start_bench(out, name, period_us, "--duration", str(CLOSED_LOOP_S))
    firmware = start_firmware(out, name, period_us)
    time.sleep(CLOSED_LOOP_S * 0.6)
    with open(out / "candump.log", "wb") as frames:
        subprocess.run(["candump", "-L", "-n", str(CANDUMP_FRAMES), INTERFACE], stdout=frames, timeout=20)
    exit_code = bench.wait(CLOSED_LOOP_S * 4 + 120)
    controller = end_firmware(out, name, firmware)
    show(out, name)
    return {"exit_code": exit_code, "firmware": controller}


def firmware_lost(out: Path, period_us: int) -> dict:
    """The firmware is killed in the middle; later a new one starts and takes over by Reset."""
    name = "firmware-lost"
    say(
        f"scene 2: firmware killed (SIGKILL) after {FIRMWARE_LOST_AT_S} s, another one starts at {FIRMWARE_BACK_AT_S} s"
    )
    bench, _ = start_bench(out, name, period_us, "--duration", str(FIRMWARE_LOST_S))
    began_s = time.monotonic()
    firmware = start_firmware(out, name, period_us)
    time.sleep(FIRMWARE_LOST_AT_S)
    firmware.kill()
    firmware.wait()
    time.sleep(max(0.0, began_s + FIRMWARE_BACK_AT_S - time.monotonic()))
    firmware = start_firmware(out, name, period_us)
    exit_code = bench.wait(FIRMWARE_LOST_S * 4 + 120)
    controller = end_firmware(out, name, firmware)
    show(out, name)
    return {"exit_code": exit_code, "firmware": controller}


def runner_killed(out: Path, period_us: int) -> dict:
    """kill -9 on the runner while everything moves; the recorder finishes the log."""
    name = "runner-killed"
    say(f"scene 3: runner killed (SIGKILL) after {RUNNER_KILLED_AT_S} s")
    bench, bus = start_bench(out, name, period_us)
    firmware = start_firmware(out, name, period_us)
    time.sleep(RUNNER_KILLED_AT_S)
    os.kill(bench.pid, signal.SIGKILL)
    bench.wait()
    status_frame = bus.newest()
    closed_after_s = wait_closed(out / f"{name}.mcap", 60.0)
    controller = end_firmware(out, name, firmware)
    show(out, name)
    return {"status_frame": status_frame.hex(), "closed_after_s": closed_after_s, "firmware": controller}


def wait_closed(path: Path, limit_s: float) -> float | None:
    """Seconds until the log ends as a finished MCAP file does; None: it never did."""
    began_s = time.monotonic()
    while time.monotonic() - began_s < limit_s:
        if path.exists() and path.read_bytes()[-8:] == MCAP_MAGIC and path.stat().st_size > 64:
            return round(time.monotonic() - began_s, 2)
        time.sleep(0.2)
    return None


def ticks_run_ratio(out: Path, name: str, period_us: int, duration_s: float) -> float:
    """Share of the planned periods that ran, as the bench itself tells it; 0 where it does not."""
    told = re.search(r"run ended: .*?; (\d+) ticks", (out / f"{name}.txt").read_text())
    return int(told[1]) * period_us * 1e-6 / duration_s if told else 0.0


def closed_loop_at_the_shortest_period(out: Path) -> tuple[dict, int]:
    """Scene 1, again with a longer period where the host cannot hold the first; its findings and the period in us."""
    for period_us in PERIODS_US:
        (out / "closed-loop.mcap").unlink(
            missing_ok=True
        )  # of the period tried before: the bench replaces no log unasked
        found = closed_loop(out, period_us)
        ratio = ticks_run_ratio(out, "closed-loop", period_us, CLOSED_LOOP_S)
        if ratio >= TICKS_RUN_RATIO_MIN:
            break
        say(f"{100 * ratio:.1f} % of the periods of {period_us} us ran: more than this host can do with both programs")
    return found, period_us


def main() -> None:
    """Play all, keep the findings."""
    out = Path(sys.argv[1])
    found, period_us = closed_loop_at_the_shortest_period(out)
    scenes = {
        "lab": os.environ.get("HILRUNNER_CAN_LAB", "own interface"),
        "period_us": period_us,
        "closed_loop": found,
        "firmware_lost": firmware_lost(out, period_us),
        "runner_killed": runner_killed(out, period_us),
    }
    (out / "scenes.json").write_text(json.dumps(scenes, indent=1))


if __name__ == "__main__":
    main()
