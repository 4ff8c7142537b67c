"""A stand-in for the loop: fills the ring like it, in real time or as fast as the recorder drains.

As a script it is the runner that the tests kill: `recorder_producer.py CONFIG.json`; it prints `ready <recorder pid>
<ring descriptor>`, runs, ends the run, and prints the recorder's summary.
"""

import json
import os
import sys
import time
from pathlib import Path

import numpy as np

from hilrunner.base import histogram_scale, records, ring, status
from hilrunner.record import launch
from hilrunner.record.config import RecorderConfig

START_MONO_NS = 5_000_000_000_000
START_REAL_NS = 1_800_000_000_000_000_000


def ring_shape(axis_count=1, tick_capacity=4096, can_data_size=8) -> ring.RingShape:
    return ring.RingShape(
        axis_count=axis_count,
        tick_capacity=tick_capacity,
        miss_capacity=256,
        can_capacity=4 * tick_capacity,
        can_data_size=can_data_size,
        histogram_count=len(records.HISTOGRAM_NAMES),
        bucket_count=histogram_scale.BUCKET_COUNT,
    )


def periods(first: int, count: int, axis_count: int, period_ns: int):
    """TICK, COMMAND, STATE, CAN (one received, three sent a tick) with values that depend on the tick only."""
    k = np.arange(first, first + count)
    tick = records.allocate(records.TICK, count)
    tick["tick"] = k
    tick["deadline_mono_ns"] = START_MONO_NS + k * period_ns
    tick["wake_mono_ns"] = tick["deadline_mono_ns"] + 3000 + k % 997
    tick["end_mono_ns"] = tick["wake_mono_ns"] + 20_000
    tick["step_ns"] = 900 + k % 13
    of_axis = np.repeat(k, axis_count)
    axis = np.tile(np.arange(axis_count), count)
    command = records.allocate(records.COMMAND, count * axis_count)
    command["tick"] = of_axis
    command["valve_command"] = np.sin(of_axis * 1e-3 + axis)
    command["mode"] = status.MODE_ACTIVE
    state = records.allocate(records.STATE, count * axis_count)
    state["tick"] = of_axis
    for place, name in enumerate(records.STATE_FIELDS):
        state[name] = np.cos(of_axis * 1e-3 + place + axis) * 10.0**place
    can = records.allocate(records.CAN_FRAME, 4 * count)
    can["tick"] = np.repeat(k, 4)
    can["mono_ns"] = np.repeat(tick["wake_mono_ns"], 4) + np.tile([100, 9000, 12000, 15000], count)
    can["kernel_real_ns"] = can["mono_ns"] - START_MONO_NS + START_REAL_NS - 50
    can["flags"] = np.tile([0, records.CAN_FRAME_SENT, records.CAN_FRAME_SENT, records.CAN_FRAME_SENT], count)
    can["can_id"] = np.tile([0x201, 0x181, 0x281, 0x381], count)
    can["length"] = 8
    can["data"][:, 0] = np.repeat(k, 4) & 0xFF
    return tick, command, state, can


class Producer:
    """Publishes periods as the loop does: frames, then tick, command and state, then the counts; drops when full."""

    def __init__(self, block_ring: ring.Ring, shape: ring.RingShape, period_ns: int = 1_000_000) -> None:
        self.ring = block_ring
        self.shape = shape
        self.period_ns = period_ns
        self.next_tick = 0
        self.store(ring.WORD_PERIOD_NS, period_ns)
        self.store(ring.WORD_START_REAL_NS, START_REAL_NS)
        self.store(ring.WORD_START_MONO_NS, START_MONO_NS)

    def word(self, index: int) -> int:
        return ring.word(self.ring, index)

    def store(self, index: int, value: int) -> None:
        self.ring.header[index * ring.HEADER_STRIDE] = value

    def publish(self, count: int) -> None:
        """`count` periods; those that find no room are dropped and counted."""
        tick, command, state, can = periods(self.next_tick, count, self.shape.axis_count, self.period_ns)
        self.next_tick += count
        self._put("can", can, 4 * count, ring.WORD_CAN_WRITTEN, self.shape.can_capacity)
        room = self.shape.tick_capacity - self.word(ring.WORD_TICK_WRITTEN) + self.word(ring.WORD_TICK_READ)
        kept = min(room, count)
        axes = self.shape.axis_count
        written = self.word(ring.WORD_TICK_WRITTEN)
        places = np.arange(written, written + kept) % self.shape.tick_capacity
        of_axes = (places[:, None] * axes + np.arange(axes)).ravel()
        self.ring.command[of_axes] = command[: kept * axes]
        self.ring.state[of_axes] = state[: kept * axes]
        self.ring.tick[places] = tick[:kept]
        self.store(ring.WORD_TICK_WRITTEN, written + kept)
        self.store(ring.WORD_TICK_DROPPED, self.word(ring.WORD_TICK_DROPPED) + count - kept)

    def publish_miss(self, tick: int, lateness_ns: int) -> None:
        miss = records.allocate(records.MISS, 1)
        miss["tick"] = tick
        miss["lateness_ns"] = lateness_ns
        miss["cause"] = status.CAUSE_PAGE_FAULT
        self._put("miss", miss, 1, ring.WORD_MISS_WRITTEN, self.shape.miss_capacity)

    def _put(self, name: str, entries: np.ndarray, count: int, word: int, capacity: int) -> None:
        written = self.word(word)
        room = capacity - written + self.word(word + 1)
        kept = min(room, count)
        getattr(self.ring, name)[np.arange(written, written + kept) % capacity] = entries[:kept]
        self.store(word, written + kept)
        self.store(word + 2, self.word(word + 2) + count - kept)

    def publish_all(self, count: int, batch: int = 256) -> None:
        """`count` periods, waiting for room instead of dropping."""
        while count > 0:
            room = self.shape.tick_capacity - self.word(ring.WORD_TICK_WRITTEN) + self.word(ring.WORD_TICK_READ)
            if room < batch:
                time.sleep(0.002)
                continue
            self.publish(min(batch, count))
            count -= batch

    def end(self, reason: int = status.EXIT_DURATION) -> None:
        self.store(ring.WORD_EXIT_REASON, reason)


def start(log_path, shape=None, period_ns=1_000_000, **settings):
    """Ring, producer and recorder; `settings` go into RecorderConfig."""
    shape = shape or ring_shape()
    block, block_ring = launch.create_ring(shape)
    config = RecorderConfig(
        ring_fd=block.fd,
        ring_shape=list(shape),
        axis_names=settings.pop("axis_names", None) or [f"axis_{i + 1}" for i in range(shape.axis_count)],
        period_ns=period_ns,
        parent_pid=os.getpid(),
        log_path=None if log_path is None else str(log_path),
        metadata=settings.pop("metadata", {"run": {"profile": "test"}, "host": {"mode": "simulated clock"}}),
        **settings,
    )
    handle = launch.start_recorder(config, block_ring)
    return block, Producer(block_ring, shape, period_ns), handle


def main() -> None:
    words = json.loads(Path(sys.argv[1]).read_text())
    shape = ring_shape(**words.get("shape", {}))
    period_ns = words.get("period_ns", 1_000_000)
    block, producer, handle = start(words["log_path"], shape, period_ns, **words.get("settings", {}))
    handle.wait_ready()
    print("ready", handle.process.pid, block.fd, flush=True)
    begin_ns = time.monotonic_ns()
    until_ns = begin_ns + int(words["duration_s"] * 1e9)
    while (now_ns := time.monotonic_ns()) < until_ns:
        due = (now_ns - begin_ns) // period_ns
        if due > producer.next_tick:
            producer.publish(int(due - producer.next_tick))
        time.sleep(words.get("sleep_s", 0.001))
    producer.end()
    summary = handle.finish()
    summary["published_ticks"] = producer.next_tick
    print(json.dumps(summary), flush=True)


if __name__ == "__main__":
    main()
