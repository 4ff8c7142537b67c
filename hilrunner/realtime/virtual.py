"""Periods in virtual time: before each tick everything happens that happens earlier, then the tick itself, then its frames go out.

The three stages are those of the loop and of a replay. Nothing here waits for a clock or asks the kernel for anything: the bench's side of the
virtual bus (hilrunner/virtual/c) lets the firmware run up to the deadline, gives the frames that came, and takes those that are sent. Its
functions are called by address, so that this room knows nothing of it.
"""

import ctypes

import numpy as np

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.compiled import entry, hot
from hilrunner.base.records import HISTOGRAM_NAMES
from hilrunner.realtime.clock import WORD_VIRTUAL, WORD_VIRTUAL_NOW
from hilrunner.realtime.cycle import decode_stage, encode_stage, step_stage
from hilrunner.realtime.handle import handle
from hilrunner.realtime.histogram import record_value
from hilrunner.realtime.layout import Bench
from hilrunner.realtime.recording import record_received, record_sent, record_tick

from llvmlite import ir  # isort: skip
from numba import config, types  # isort: skip
from numba.extending import intrinsic  # isort: skip

_COMMAND_AGE = HISTOGRAM_NAMES.index("command_age")
_STRIDE = ring_layout.HEADER_STRIDE
CALL_HUB, CALL_ADVANCE, CALL_RECEIVE, CALL_SEND, CALL_COUNT = range(5)  # places of `calls`: the bus, and its functions


@intrinsic
def _call_compiled(typing, address, arguments):
    """int64 function(int64, ...) at an address; pointers travel as integers."""
    count = len(arguments)
    signature = types.int64(types.int64, arguments)

    def generate(context, builder, sig, values):
        word = ir.IntType(64)
        kind = ir.FunctionType(word, [word] * count)
        function = builder.inttoptr(values[0], kind.as_pointer())
        return builder.call(function, [builder.extract_value(values[1], k) for k in range(count)])

    return signature, generate


def _call_interpreted(address, arguments):
    kind = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_int64] * len(arguments))
    return kind(int(address))(*[int(one) for one in arguments])


_call = _call_interpreted if config.DISABLE_JIT else _call_compiled


@hot
def _count(progress, received, sent, due, flags):
    progress["tick_count"] += 1
    progress["frames_received"] += received
    progress["frames_sent"] += sent
    progress["frames_unsent"] += due - sent
    progress["flags_seen"] |= flags


@hot
def _run_tick(bench, calls, tick, deadline_mono_ns):
    """One period at its deadline; status.FLAG_* of its states."""
    progress = bench.progress[0]
    hub = calls[CALL_HUB]
    progress["tick"] = tick
    progress["echo_real_ns"] = 0
    box = bench.inbox
    received = _call(
        calls[CALL_RECEIVE],
        (
            hub,
            np.int64(box.frame.ctypes.data),
            np.int64(box.size_bytes.ctypes.data),
            np.int64(box.kernel_real_ns.ctypes.data),
            np.int64(box.frame.shape[0]),
        ),
    )
    decode_stage(bench, tick, 0, received)
    flags = step_stage(bench, tick, 1)
    due = np.int64(encode_stage(bench, tick))
    out = bench.outbox
    sent = np.int64(0)
    if due > 0:
        sent = _call(
            calls[CALL_SEND], (hub, np.int64(out.frame.ctypes.data), np.int64(out.size_bytes.ctypes.data), due)
        )
    _count(progress, received, sent, due, flags)
    record_received(bench, tick, 0, received, deadline_mono_ns)
    record_sent(bench, tick, sent, deadline_mono_ns)
    record_tick(
        bench, tick, 0, deadline_mono_ns, deadline_mono_ns, received, deadline_mono_ns + bench.config[0]["period_ns"]
    )
    if tick >= bench.config[0]["warm_up_ticks"]:
        for axis in range(bench.commands.shape[0]):
            valid_tick = bench.commands[axis]["valid_tick"]
            if valid_tick >= 0:
                age_ns = (tick - valid_tick) * bench.config[0]["period_ns"]
                record_value(bench.ring.histogram, bench.ring.extreme, _COMMAND_AGE, age_ns)
    return flags


@entry
def _run_compiled(bench, calls, start_mono_ns, first_tick, end_tick):
    return _run(handle(bench), calls, start_mono_ns, first_tick, end_tick)


@hot
def _run(bench, calls, start_mono_ns, first_tick, end_tick):
    period_ns = bench.config[0]["period_ns"]
    stimulus_ticks = bench.config[0]["stimulus_tick_count"]
    bench.clock[WORD_VIRTUAL] = 1
    for tick in range(first_tick, end_tick):
        if bench.ring.header[ring_layout.WORD_STOP_REQUEST * _STRIDE] != 0:
            return np.int64(status.EXIT_SIGNAL)
        if stimulus_ticks > 0 and tick >= stimulus_ticks:
            return np.int64(status.EXIT_STIMULUS_END)
        deadline_mono_ns = start_mono_ns + tick * period_ns
        if _call(calls[CALL_ADVANCE], (calls[CALL_HUB], deadline_mono_ns)) != 0:
            return np.int64(status.EXIT_FIRMWARE)
        bench.clock[WORD_VIRTUAL_NOW] = deadline_mono_ns
        if _run_tick(bench, calls, tick, deadline_mono_ns) & status.FLAG_NOT_FINITE:
            return np.int64(status.EXIT_NOT_FINITE)
    return np.int64(status.EXIT_RUNNING)


def run_virtual(bench: Bench, calls: np.ndarray, start_mono_ns: int, first_tick: int, end_tick: int) -> int:
    """Run ticks first_tick .. end_tick - 1 in virtual time.

    Args:
        bench: armed; its ring must have room for these ticks and their frames.
        calls: int64[CALL_COUNT]: address of the virtual bus, and of its functions advance, receive and send.
        start_mono_ns: deadline of tick 0 on the virtual clock.
    Returns:
        status.EXIT_*; EXIT_RUNNING when all of them were run.
    """
    return int(_run_compiled(bench, calls, start_mono_ns, first_tick, end_tick))
