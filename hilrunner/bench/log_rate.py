"""The side door under load: 10 kHz into the log, and ticks as fast as they go; what is lost, what the recorder costs."""

import os
import time
from pathlib import Path

from hilrunner.base import ring as ring_layout
from hilrunner.bench.results import Table
from hilrunner.bench.tick import Place, TickBench

PERIOD_US = 100
_DRAIN_LIMIT_S = 60.0


def process_cpu_s(pid: int) -> float:
    """Processor time a process has used, user and system, s (proc(5), stat fields 14 and 15)."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def _drained_s(bench: TickBench) -> float:
    """Seconds until the recorder has read everything written."""
    start_s = time.monotonic()
    ring = bench.ring
    while time.monotonic() - start_s < _DRAIN_LIMIT_S:
        done = ring_layout.word(ring, ring_layout.WORD_TICK_READ) == ring_layout.word(
            ring, ring_layout.WORD_TICK_WRITTEN
        )
        if done and ring_layout.word(ring, ring_layout.WORD_CAN_READ) == ring_layout.word(
            ring, ring_layout.WORD_CAN_WRITTEN
        ):
            break
        time.sleep(0.005)
    return time.monotonic() - start_s


def log_rate(place: Place, profile: str, engine: int, duration_s: float) -> Table:
    """10 kHz for `duration_s`, then a burst of as many ticks as the ring holds half of, without sleep."""
    rows = []
    with TickBench(place, profile, period_us=PERIOD_US, engine=engine) as bench:
        bench.run(0.2)
        rows.append(_row(f"{1000 // PERIOD_US} kHz", bench, duration_s, flat_out=False))
        half_ring_s = len(bench.ring.tick) / 2 * PERIOD_US * 1e-6
        rows.append(_row("flat out", bench, half_ring_s, flat_out=True))
        ran = int(ring_layout.word(bench.ring, ring_layout.WORD_TICK_WRITTEN))
    summary = bench.recorder_summary
    logged = summary.get("messages", {}).get("/rt/tick")
    notes = [
        f"{ran} ticks into the ring, {logged} in the finished log; {summary.get('lost_bytes', 0)} bytes lost",
        f"longest write of the recorder {summary.get('write_stall_ns_max', 0) / 1e6:.1f} ms, "
        f"ring filled to {summary.get('ring_fill_ratio_max', 0):.1%}",
    ]
    columns = ("", "ticks", "dropped", "late or skipped", "messages/s", "MB/s", "recorder core share")
    title = f"Log: one axis at {1000 // PERIOD_US} kHz for {duration_s:g} s, and without sleep; recorder on core {place.other_cpu}"
    values = {
        "ticks_logged": logged,
        "ticks_published": ran,
        "ticks_dropped": sum(row[2] for row in rows),
        "recorder_core_ratio": rows[0][6],
    }
    return Table("log", title, columns, rows, notes, values)


def _row(name: str, bench: TickBench, duration_s: float, flat_out: bool) -> tuple:
    cpu_s, start_s = process_cpu_s(bench.recorder_pid), time.monotonic()
    frames = ring_layout.word(bench.ring, ring_layout.WORD_CAN_WRITTEN)
    size_bytes = bench.log_path.stat().st_size
    taken = bench.run(duration_s, flat_out=flat_out)
    _drained_s(bench)
    wall_s = time.monotonic() - start_s
    frames = ring_layout.word(bench.ring, ring_layout.WORD_CAN_WRITTEN) - frames
    written = bench.log_path.stat().st_size - size_bytes
    axes = len(bench.armed.bench.state)
    messages = (taken.ticks - taken.dropped) * (1 + 2 * axes) + frames
    late = 0 if flat_out else taken.misses + taken.skipped
    share = (process_cpu_s(bench.recorder_pid) - cpu_s) / wall_s
    return name, taken.ticks, taken.dropped, late, messages / wall_s, written / wall_s / 1e6, share
