"""After a stall: the periods that were missed are computed one after the other, each with the frames that came in its time.

A host that stands still for 200 ms leaves 200 periods behind, and in the socket everything the firmware sent meanwhile. Were all of
that given to the first tick afterwards, the command would age through the whole stall and a firmware that never stopped sending
would be blamed. The kernel has stamped every frame when it came. So a frame belongs to the first period whose deadline is not before
its stamp, and the skipped periods run as they would have run, but for their answers, which nobody could use any more.

Stamps are CLOCK_REALTIME, which may be set at any time; the grid is CLOCK_MONOTONIC. A stamp is converted by the difference of the
two clocks now, or by the one before the stall where the clock was set in between and only that one puts the frame into the time
in which it can have come. Frames keep their order in any case.

Frames without stamps (a socketpair) cannot be placed: then all of them belong to the tick after the stall and act from the first
skipped period on, and the skipped periods have no rows in the log.
"""

import numpy as np

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.compiled import entry, folded, hot
from hilrunner.realtime.clock import clock_offset_ns, now_mono_ns
from hilrunner.realtime.cycle import begin_period, decode_frames, measure, step_stage
from hilrunner.realtime.recording import record_received, record_skipped
from hilrunner.realtime.socketcan import receive_frames

CLOCK_STEP_NS = 1_000_000  # a difference of the clocks that changed by more was set, not disciplined
ENDING_NS = 500_000_000  # who asked for the end while skipped periods are computed waits no longer than this
_STRIDE = ring_layout.HEADER_STRIDE


@entry
def serve_late(bench, descriptor, tick, skipped, deadline_mono_ns, wake_ns, now_ns, placed_before):
    """Run the skipped periods, and find which frames of the inbox belong to this tick.

    Args:
        bench: handle. tick: the one to be run now, `skipped` periods before it have not been run. deadline_mono_ns: of tick.
        wake_ns: when it woke up. now_ns: when its frames were received. placed_before: frames of the inbox that have a
        period already; later ones are placed here.

    Writes progress: inbox_head, frames_end, periods_due; and everything a period writes.

    Returns:
        status.EXIT_RUNNING, or why the run ends before this tick; progress["tick"] is then the last one that was run.
    """
    progress = bench.progress[0]
    config = bench.config[0]
    progress["frames_end"] = progress["inbox_tail"]
    progress["periods_due"] = skipped + 1
    if config["overrun"] == status.OVERRUN_STOP:
        return np.int64(status.EXIT_RUNNING)
    progress["placed_mono_ns"] = progress["emptied_before_mono_ns"]
    if not place_frames(bench, placed_before, progress["inbox_tail"], tick, deadline_mono_ns, now_ns):
        progress["skipped_count"] += skipped
        bench.ring.header[ring_layout.WORD_SKIPPED_TOTAL * _STRIDE] += skipped
        return np.int64(status.EXIT_RUNNING)
    progress["periods_due"] = 1
    for at in range(tick - skipped, tick):
        due_mono_ns = deadline_mono_ns - (tick - at) * config["period_ns"]
        flags = _serve_skipped(bench, descriptor, at, due_mono_ns, wake_ns)
        if flags & status.FLAG_NOT_FINITE:
            return np.int64(status.EXIT_NOT_FINITE)
        asked = bench.ring.header[ring_layout.WORD_STOP_REQUEST * _STRIDE] != 0
        if asked and now_mono_ns(bench.clock) - now_ns > ENDING_NS:
            return np.int64(status.EXIT_SIGNAL)
    if now_ns - deadline_mono_ns >= config["period_ns"]:  # later ones belong to later periods, or to none of this run
        progress["frames_end"] = _end_of_period(bench, tick)
    else:
        progress["frames_end"] = progress["inbox_tail"]
    return np.int64(status.EXIT_RUNNING)


@folded
def _serve_skipped(bench, descriptor, tick, deadline_mono_ns, wake_ns):
    """One skipped period; its state flags."""
    progress = bench.progress[0]
    progress["tick"] = tick
    begin_period(bench)
    received = np.int64(0)
    while True:
        first = progress["inbox_head"]
        end = _end_of_period(bench, tick)
        decode_frames(bench, tick, first, end)
        record_received(bench, tick, first, end, wake_ns)
        received += end - first
        progress["inbox_head"] = end
        # an inbox that is full and used up: the frames of this period may go on in the socket
        if end < bench.inbox.frame.shape[0] or not _refill(bench, descriptor, tick, deadline_mono_ns):
            break
    flags = step_stage(bench, tick, np.int64(1))
    measure(bench, tick)
    progress["frames_received"] += received
    progress["flags_seen"] |= flags
    progress["skipped_count"] += 1
    bench.ring.header[ring_layout.WORD_SKIPPED_TOTAL * _STRIDE] += 1
    record_skipped(bench, tick, deadline_mono_ns, wake_ns, received)
    return flags


@hot
def _end_of_period(bench, tick):
    """Behind the last waiting frame that came in this period or before."""
    end = bench.progress[0]["inbox_head"]
    tail = bench.progress[0]["inbox_tail"]
    while end < tail and bench.frame_period[end] <= tick:
        end += 1
    return end


@hot
def _refill(bench, descriptor, tick, deadline_mono_ns):
    """Receive into the inbox that was used up; False when nothing came."""
    progress = bench.progress[0]
    progress["inbox_head"] = 0
    progress["inbox_tail"] = 0
    if descriptor < 0:
        return False
    tail = np.int64(receive_frames(descriptor, bench.inbox, 0))
    if tail < 0:
        progress["bus_errno"] = -tail
        return False
    progress["inbox_tail"] = tail
    now_ns = now_mono_ns(bench.clock)
    if not place_frames(bench, 0, tail, tick, deadline_mono_ns, now_ns):
        for k in range(tail):  # stamps ceased: as near as can be told
            bench.frame_period[k] = tick
    if tail < bench.inbox.frame.shape[0]:
        progress["emptied_mono_ns"] = now_ns
    return tail > 0


@hot
def place_frames(bench, first, end, tick, deadline_mono_ns, now_ns):
    """Find the period of each frame `first` to `end` - 1 of the inbox; False when one has no stamp.

    Args:
        tick, deadline_mono_ns: any point of the grid. now_ns: when the frames were received.
    """
    progress = bench.progress[0]
    period_ns = bench.config[0]["period_ns"]
    for k in range(first, end):
        if bench.inbox.kernel_real_ns[k] == 0:
            return False
    if end == first:
        return True
    before_ns = progress["clock_offset_ns"]
    offset_ns = clock_offset_ns(bench.clock)
    progress["clock_offset_ns"] = offset_ns
    came_ns = progress["placed_mono_ns"]
    for k in range(first, end):
        came_ns = arrival_ns(bench.inbox.kernel_real_ns[k], before_ns, offset_ns, came_ns, now_ns)
        bench.frame_period[k] = tick + (came_ns - deadline_mono_ns + period_ns - 1) // period_ns
    progress["placed_mono_ns"] = came_ns
    return True


@hot
def arrival_ns(stamp_real_ns, offset_before_ns, offset_ns, earliest_ns, latest_ns):
    """CLOCK_MONOTONIC of a frame's stamp; frames came in order and in the time from `earliest_ns` to `latest_ns`.

    Args:
        offset_before_ns, offset_ns: CLOCK_REALTIME - CLOCK_MONOTONIC before that time and now.
    """
    came_ns = stamp_real_ns - offset_ns
    if abs(offset_ns - offset_before_ns) > CLOCK_STEP_NS:  # the clock was set: did this frame come before?
        before_ns = stamp_real_ns - offset_before_ns
        if earliest_ns - CLOCK_STEP_NS <= before_ns <= latest_ns:
            came_ns = before_ns
    return min(max(came_ns, earliest_ns), latest_ns)
