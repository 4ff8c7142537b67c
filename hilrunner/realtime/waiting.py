"""How the loop waits for the deadline of its next tick: asleep, with a spin tail, with a rehearsal on the way.

Without a spin tail the loop gets up a little early, rehearses the tick and lies down again: the kernel's way out of the second sleep is
as warm as the tick then is. With a spin tail the rehearsal is timed to end just before the deadline. It is left out where it
would not fit: a short period or spin tail, a tick that takes long, a late wake-up, a host whose clock calls are dear.
"""

import numpy as np

from hilrunner.base.compiled import folded, hot
from hilrunner.base.status import PHASE_RECORD
from hilrunner.realtime.clock import WORD_CYCLE_RATE, WORD_SPIN_NS, now_mono_ns, sleep_until, spin_until, wait_until
from hilrunner.realtime.rehearsal import rehearse

_SLACK_NS = 2_000  # between the expected end of a rehearsal and the deadline
_WAKE_MARGIN_NS = 60_000  # an ordinary wake-up is not later than this
_PERIOD_SHARE_SHIFT = 3  # a rehearsal without spin tail may take an eighth of the period


@folded
def wait_for_tick(bench, shadow, descriptor, tick, deadline_mono_ns):
    """Return at the deadline, or later.

    Args:
        bench: handle of the Bench. shadow: handle of `rehearsal_of` it. descriptor: as run_loop's.
    """
    clock = bench.clock
    progress = bench.progress[0]
    spin_ns = clock[WORD_SPIN_NS]
    limit_ns = spin_ns if spin_ns > 0 else bench.config[0]["period_ns"] >> _PERIOD_SHARE_SHIFT
    room_ns = np.int64(0)
    if bench.config[0]["rehearse"] != 0 and clock[WORD_CYCLE_RATE] == 0:
        room_ns = _room_ns(progress, _tick_ns(bench.phase_ns), limit_ns)
    if room_ns == 0:
        wait_until(clock, deadline_mono_ns)
        return
    latest_mono_ns = deadline_mono_ns - room_ns + _SLACK_NS
    if spin_ns > 0:
        sleep_until(clock, deadline_mono_ns - spin_ns)
        if now_mono_ns(clock) < latest_mono_ns:
            spin_until(clock, deadline_mono_ns - room_ns)
            _rehearse_timed(bench, shadow, descriptor, tick)
        spin_until(clock, deadline_mono_ns)
        return
    sleep_until(clock, deadline_mono_ns - room_ns - _WAKE_MARGIN_NS)
    if now_mono_ns(clock) < latest_mono_ns:
        _rehearse_timed(bench, shadow, descriptor, tick)
    sleep_until(clock, deadline_mono_ns)


@hot
def _tick_ns(phase_ns):
    """What the tick before took from receive to send; 0 before the first one."""
    total_ns = np.int64(0)
    for phase in range(PHASE_RECORD):
        total_ns += phase_ns[phase]
    return total_ns


@hot
def _room_ns(progress, tick_ns, limit_ns):
    """How long before the deadline a rehearsal has to begin; 0: it would not fit."""
    expected_ns = progress["rehearsal_ns"]
    if expected_ns == 0:
        expected_ns = tick_ns  # the first one: like a tick
    elif _with_slack(expected_ns) > limit_ns:
        expected_ns = progress["rehearsal_ns_min"]  # the last one was held up, or there never is enough room
    room_ns = _with_slack(expected_ns)
    return room_ns if 0 < expected_ns and room_ns <= limit_ns else np.int64(0)


@hot
def _with_slack(expected_ns):
    return expected_ns + (expected_ns >> 2) + _SLACK_NS


@hot
def _rehearse_timed(bench, shadow, descriptor, tick):
    """Rehearse, and learn how long it takes: a longer one is followed at once, a shorter one slowly."""
    progress = bench.progress[0]
    begin_mono_ns = now_mono_ns(bench.clock)
    rehearse(bench, shadow, descriptor, tick)
    took_ns = now_mono_ns(bench.clock) - begin_mono_ns
    before_ns = progress["rehearsal_ns"]
    shortest_ns = progress["rehearsal_ns_min"]
    progress["rehearsal_ns"] = max(took_ns, before_ns - ((before_ns - took_ns) >> 4))
    progress["rehearsal_ns_min"] = took_ns if shortest_ns == 0 else min(took_ns, shortest_ns)
