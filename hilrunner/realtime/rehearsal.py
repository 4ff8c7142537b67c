"""A dry run of the period shortly before its deadline: what the period will touch is in the caches when its time comes.

A core that has waited most of a millisecond runs the same code up to half as fast again: its caches, branch predictors and address
translations have gone to others. So the tick to come is received (peeked), decoded, stepped and encoded on copies of the
state, and the result is thrown away. Nothing is sent, counted or logged (but a bus found gone), and the period itself starts from the state it would have
started from: a run with and without rehearsal gives the same bits. `waiting` chooses the moment.
"""

import numpy as np

from hilrunner.base.compiled import folded, hot
from hilrunner.realtime.cycle import decode_stage, encode_stage, step_stage
from hilrunner.realtime.layout import Bench
from hilrunner.realtime.socketcan import peek_frame

# what the stages write and the next period needs; scratch is shared, so that it is warm too
_COPIED = (
    "state",
    "commands",
    "last_counter",
    "input",
    "group_tick",
    "sent_counter",
    "faults",
    "progress",
    "quantity",
    "load_scale",
    "state_flags",
    "plant_scratch",  # counts the evaluations of the run
)


def rehearsal_of(bench: Bench) -> Bench:
    """The same bench with a state of its own."""
    copies = {name: getattr(bench, name).copy() for name in _COPIED}
    ring = bench.ring._replace(frame_count=bench.ring.frame_count.copy(), clamped_count=bench.ring.clamped_count.copy())
    return bench._replace(ring=ring, **copies)


@folded
def rehearse(bench, shadow, descriptor, tick):
    """Run the tick to come on the shadow.

    Args:
        bench: handle of the Bench, read, but for the error of its bus. shadow: handle of `rehearsal_of` it, written. descriptor: as run_loop's.
    """
    _follow(bench, shadow)
    waiting = np.int64(peek_frame(descriptor, shadow.inbox)) if descriptor >= 0 else np.int64(0)
    if waiting < 0:  # the kernel tells of a bus that is gone once, and to whoever asks first
        bench.progress[0]["bus_errno"] = -waiting
    decode_stage(shadow, tick, np.int64(0), max(waiting, 0))
    step_stage(shadow, tick, np.int64(1))  # the types of the loop's own calls: compiled once
    encode_stage(shadow, tick)


@hot
def _follow(bench, shadow):
    """Copy the state of the bench into its shadow."""
    for axis in range(bench.state.shape[0]):
        for place in range(bench.state.shape[1]):
            shadow.state[axis, place] = bench.state[axis, place]
        for place in range(bench.quantity.shape[1]):
            shadow.quantity[axis, place] = bench.quantity[axis, place]
        shadow.commands[axis] = bench.commands[axis]
        for place in range(bench.input.shape[1]):
            shadow.input[axis, place] = bench.input[axis, place]
    for message in range(bench.last_counter.shape[0]):
        shadow.last_counter[message] = bench.last_counter[message]
    for group in range(bench.group_tick.shape[0]):
        shadow.group_tick[group] = bench.group_tick[group]
    for message in range(bench.sent_counter.shape[0]):
        shadow.sent_counter[message] = bench.sent_counter[message]
    for fault in range(bench.faults.shape[0]):
        shadow.faults[fault] = bench.faults[fault]
