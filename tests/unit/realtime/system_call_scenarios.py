"""The loop on a kernel of its own, interpreted: each of its system calls fails, at the n-th call for every n; prints one JSON object.

    NUMBA_DISABLE_JIT=1 python tests/unit/realtime/system_call_scenarios.py

The kernel is a handful of functions over a simulated time. A trial is (call, errno, n, once or for good); what is noted of it: why the
run ended, whether a tick began before its deadline, and how many calls it took. `LIMIT` calls without an end is a loop that hangs.
"""

import errno
import json
import os
import tempfile
from pathlib import Path

assert os.environ.get("NUMBA_DISABLE_JIT") == "1", "the simulated kernel replaces compiled functions"

import loop_scenarios as scenarios  # noqa: E402
import numpy as np  # noqa: E402

from hilrunner.realtime import clock, loop, miss, socketcan  # noqa: E402
from hilrunner.setup.arm import arm, local_ring, ring_shape  # noqa: E402
from hilrunner.setup.profile import load_profile  # noqa: E402

TICKS = 6
LIMIT = 60_000
CALL_COST_NS = 200
CALLS = {
    "clock_gettime": (errno.EINVAL, errno.EINTR),
    "clock_nanosleep": (errno.EINTR, errno.EINVAL, errno.ENOSYS),
    "recvmmsg": (errno.EINTR, errno.EAGAIN, errno.ENETDOWN, errno.ENOBUFS, errno.ENOMEM),
    "sendmmsg": (
        errno.EINTR,
        errno.EAGAIN,
        errno.ENOBUFS,
        errno.ENETDOWN,
        errno.ENXIO,
        0,
    ),  # 0: none was sent, no error
    "getrusage": (errno.EPERM,),
    "sched_getcpu": (errno.ENOSYS,),
    "pread": (errno.EIO,),
}


class HangError(Exception):
    """More calls than any run takes."""


class Kernel:
    """The calls of the loop; one of them fails."""

    def __init__(self, call="", code=0, first=0, count=0):
        self.call, self.code, self.first, self.count = call, code, first, count
        self.now_ns = scenarios.START_NS - 500_000
        self.errno = 0
        self.made = dict.fromkeys(CALLS, 0)
        self.early = []

    def fails(self, call):
        self.made[call] += 1
        self.now_ns += CALL_COST_NS
        if sum(self.made.values()) > LIMIT:
            raise HangError
        number = self.made[call]
        if call != self.call or number < self.first or (self.count >= 0 and number >= self.first + self.count):
            return False
        self.errno = self.code
        return True

    def clock_gettime(self, which, words):
        if self.fails("clock_gettime"):
            return -1
        now_ns = int(self.now_ns) + (scenarios.WALL_NS if which == clock.CLOCK_REALTIME else 0)
        self.bench.clock[0], self.bench.clock[1] = divmod(now_ns, 1_000_000_000)
        return 0

    def clock_nanosleep(self, which, flags, words, rest):
        if self.fails("clock_nanosleep"):
            return self.code
        self.now_ns = max(self.now_ns, int(self.bench.clock[0]) * 1_000_000_000 + int(self.bench.clock[1]))
        return 0

    def recvmmsg(self, descriptor, messages, count, flags, limit):
        if self.fails("recvmmsg"):
            return -1
        self.errno = errno.EAGAIN
        return -1

    def sendmmsg(self, descriptor, messages, count, flags):
        if self.fails("sendmmsg"):
            return 0 if self.code == 0 else -1
        return int(count)

    def other(self, call):
        return lambda *_: -1 if self.fails(call) else 0

    def bind(self, bench):
        self.bench = bench
        clock._clock_gettime, clock._clock_nanosleep = self.clock_gettime, self.clock_nanosleep
        socketcan._recvmmsg, socketcan._sendmmsg = self.recvmmsg, self.sendmmsg
        socketcan.last_errno = clock.last_errno = lambda: np.int64(self.errno)
        miss._getrusage, miss._sched_getcpu, miss._pread = map(self.other, ("getrusage", "sched_getcpu", "pread"))

        def step(bench, tick, periods):
            due_ns = scenarios.START_NS + int(tick) * scenarios.PERIOD_NS
            if self.now_ns < due_ns:
                self.early.append(int(tick))
            return np.int64(0)

        loop.step_stage = step
        loop.encode_stage = lambda bench, tick: 2


def bench_of(folder):
    path = Path(folder) / "calls.toml"
    path.write_text(scenarios.PROFILE.format(overrun="skip", warm_up=0, more="", rehearse="false"))
    loaded = load_profile(str(path))
    made = loaded, scenarios.axes_of(loaded), ring_shape(loaded, 0.02)

    def fresh():
        armed = arm(made[0], made[1], local_ring(made[2]), record=True, schedstat_fd=3)
        bench = armed.bench
        two = socketcan.make_mailbox(2)
        two.size_bytes[:] = 16
        return bench._replace(outbox=two)

    return fresh


def trial(fresh, *failure) -> dict:
    kernel = Kernel(*failure)
    bench = fresh()
    kernel.bind(bench)
    try:
        reason = int(loop.run_loop(bench, 9, scenarios.START_NS, TICKS))
    except HangError:
        reason = -1
    progress = bench.progress[0]
    told = int(bench.clock[clock.WORD_FAILURE])
    return {
        "reason": reason,
        "early": kernel.early,
        "calls": kernel.made,
        "bus_errno": int(progress["bus_errno"]),
        "failure": [told >> clock.CALL_SHIFT, told & ((1 << clock.CALL_SHIFT) - 1)],
        "unsent": int(progress["frames_unsent"]),
        "ticks": int(progress["tick_count"]),
    }


def main():
    with tempfile.TemporaryDirectory() as folder:
        fresh = bench_of(folder)
        sound = trial(fresh)
        found = {"sound": sound, "trials": []}
        for call, codes in CALLS.items():
            for code in codes:
                for first in range(1, sound["calls"][call] + 1):
                    for count in (1, -1):
                        result = trial(fresh, call, code, first, count)
                        found["trials"].append([call, code, first, count, result])
    print(json.dumps(found))


if __name__ == "__main__":
    main()
