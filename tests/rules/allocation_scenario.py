"""Allocations of Numba's runtime during loops of different length: allocation_scenario.py ENGINE, prints one JSON line.

Run with NUMBA_NRT_STATS=1. The loop is the real one: clock, a socketpair as bus with commands waiting, ring, misses, histograms.
"""

import json
import socket
import sys
import time

import numpy as np
from numba.core.runtime import rtsys

from hilrunner.base import compiled, status
from hilrunner.realtime import loop
from hilrunner.realtime.clock import WORD_SPIN_NS
from hilrunner.setup import arm as arming
from hilrunner.setup import axes as axis_setup
from hilrunner.setup.profile import load_profile
from tests.rules.interpreted_scenario import command_frame

TRIES = (100,) * 20  # a busy host may leave no time for a rehearsal in the first of them


@compiled.hot
def planted(tick_count):
    """What the loop must not do."""
    total = 0.0
    for tick in range(tick_count):
        total += np.full(3, float(tick))[1]
    return total


def allocations(call):
    """Blocks the runtime handed out during a call."""
    before = rtsys.get_allocation_stats().alloc
    call()
    return rtsys.get_allocation_stats().alloc - before


def drain(peer):
    """Take what the bench sent."""
    peer.setblocking(False)
    try:
        while True:
            peer.recv(128)
    except BlockingIOError:
        peer.setblocking(True)


def main():
    """Loops of 200 and 400 ticks on one armed bench, and the planted fault."""
    loaded = load_profile("amc-lift")
    axes = axis_setup.build_axes(loaded, status.ENGINE_NAMES.index(sys.argv[1]))
    ring = arming.local_ring(arming.ring_shape(loaded, seconds=0.1))
    armed = arming.arm(loaded, axes, ring, record=True, overrun="catch-up")
    ours, peer = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    found = {}
    for tick_count in (200, 200, 400):  # the first one also compiles
        for counter in range(16):
            peer.send(command_frame(0, counter, 0.3).tobytes())
        found[str(tick_count)] = allocations(
            lambda count=tick_count: loop.run_loop(armed.bench, ours.fileno(), time.monotonic_ns(), count)
        )
        drain(peer)
    found["ticks"] = int(armed.bench.progress[0]["tick_count"])
    armed.bench.clock[WORD_SPIN_NS] = 900_000  # room for a rehearsal also where the wake-up is late
    for tick_count in (*TRIES, 200, 400):  # on time, so that ticks are rehearsed
        if tick_count == TRIES[0] and armed.bench.progress[0]["rehearsal_ns"] > 0:
            continue
        start_mono_ns = time.monotonic_ns() + 5_000_000
        found[f"on time {tick_count}"] = allocations(
            lambda count=tick_count, start=start_mono_ns: loop.run_loop(armed.bench, ours.fileno(), start, count)
        )
        drain(peer)
    found["ticks on time"] = int(armed.bench.progress[0]["tick_count"]) - found["ticks"]
    found["rehearsal_ns"] = int(armed.bench.progress[0]["rehearsal_ns"])
    planted(1)
    found["planted 10"], found["planted 20"] = allocations(lambda: planted(10)), allocations(lambda: planted(20))
    found["frames"] = int(armed.bench.progress[0]["frames_received"])
    found["misses"] = int(armed.bench.progress[0]["miss_count"])
    print(json.dumps(found))


if __name__ == "__main__":
    main()
