"""The whole period as one compiled function that needs no interpreter; with `waiting`, all that knows time.

The grid never moves: tick k is due at start + k period. A tick that ends past the end of its period is a miss. After a miss the next
tick starts at once if less than a whole period is lost, so 0.1 ms late costs 0.1 ms; whole lost periods are handled by the
overrun policy: `skip` (computed at once by `late`, nothing of them is sent), `catch-up` (each is run in full, late), `stop`.

A stall may hit anywhere: while the loop sleeps, works, or takes its frames. So it is looked for where the frames have just been
taken: a tick that is a whole period late by then gives its place to the newest one that is due. The last tick of the grid is run
in any case, however late.
"""

import numpy as np

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.compiled import entry, folded, hot
from hilrunner.base.records import HISTOGRAM_NAMES
from hilrunner.realtime import command, ring
from hilrunner.realtime.clock import (
    WORD_CYCLE_RATE,
    WORD_FAILURE,
    anchor,
    clock_offset_ns,
    now_mono_ns,
    now_real_ns,
)
from hilrunner.realtime.cycle import decode_stage, encode_stage, step_stage
from hilrunner.realtime.handle import handle
from hilrunner.realtime.histogram import record_corrected, record_value
from hilrunner.realtime.late import serve_late
from hilrunner.realtime.layout import ACTION_FAIL_SAFE, ACTION_STOP, Bench
from hilrunner.realtime.miss import (
    USAGE_CPU,
    USAGE_FAULTS_MAJOR,
    USAGE_FAULTS_MINOR,
    USAGE_SWITCHES_INVOLUNTARY,
    USAGE_SWITCHES_VOLUNTARY,
    read_usage,
    suspect_cause,
)
from hilrunner.realtime.recording import record_received, record_sent, record_tick
from hilrunner.realtime.rehearsal import rehearsal_of
from hilrunner.realtime.socketcan import receive_frames, send_frames
from hilrunner.realtime.waiting import wait_for_tick

_STRIDE = ring_layout.HEADER_STRIDE
_WAKE_LATENESS = HISTOGRAM_NAMES.index("wake_lateness")
_FIRST_PHASE = HISTOGRAM_NAMES.index("receive")
_EXECUTION = HISTOGRAM_NAMES.index("execution")
_PERIOD = HISTOGRAM_NAMES.index("period")
_COMMAND_AGE = HISTOGRAM_NAMES.index("command_age")
_RESPONSE = HISTOGRAM_NAMES.index("response")
_RESPONSE_SLACK_NS = 1_000_000  # between two readings of two clocks
NO_BUS = -1


def run_loop(bench: Bench, descriptor: int, start_mono_ns: int, tick_limit: int) -> int:
    """Run ticks 0 … tick_limit - 1 on the grid start_mono_ns + tick period.

    Args:
        bench: Bench, armed. descriptor: file descriptor that carries struct can_frame, or NO_BUS.
        start_mono_ns: deadline of tick 0. tick_limit: the first tick that is not run.
    Returns:
        status.EXIT_*.
    """
    return _run_compiled(bench, rehearsal_of(bench), descriptor, start_mono_ns, tick_limit)


@entry
def _run_compiled(bench, shadow, descriptor, start_mono_ns, tick_limit):
    return _run(handle(bench), handle(shadow), descriptor, start_mono_ns, tick_limit)


@folded
def _run(bench, shadow, descriptor, start_mono_ns, tick_limit):
    """The loop itself; `bench` and `shadow` are handles from here on."""
    progress = bench.progress[0]
    config = bench.config[0]
    period_ns = config["period_ns"]
    tick = np.int64(0)
    skipped = np.int64(0)
    last_tick = _last_tick(config, tick_limit)
    _begin(bench, start_mono_ns)
    reason = np.int64(status.EXIT_RUNNING)
    while reason == status.EXIT_RUNNING:
        reason = _end_reason(bench, tick, skipped, tick_limit)
        if reason != status.EXIT_RUNNING:
            break
        deadline_mono_ns = start_mono_ns + tick * period_ns
        ahead_ns = deadline_mono_ns - now_mono_ns(bench.clock)
        progress["carried_ns"] = max(-ahead_ns, 0)
        if ahead_ns > 0:
            wait_for_tick(bench, shadow, descriptor, tick, deadline_mono_ns)
        wake_ns = anchor(bench.clock)  # before anything of the tick is touched: those memory lines are cold
        if bench.clock[WORD_FAILURE] != 0:  # the time may not have come at all
            return np.int64(status.EXIT_SYSTEM_CALL)
        reason = _run_tick(bench, descriptor, tick, skipped, last_tick, deadline_mono_ns, wake_ns)
        tick = progress["tick"]
        late_ns = now_mono_ns(bench.clock) - (start_mono_ns + (tick + 1) * period_ns)
        before = skipped
        skipped = np.int64(0)
        if late_ns >= period_ns and config["overrun"] == status.OVERRUN_SKIP and tick < last_tick:
            skipped = min(late_ns // period_ns, last_tick - tick - 1)
        if reason == status.EXIT_RUNNING and _asked_to_stop(bench) and (skipped == 0 or before > 0):
            reason = np.int64(status.EXIT_SIGNAL)
        tick += 1 + skipped
    if tick_limit > 0:
        _note_stall(bench, now_mono_ns(bench.clock) - progress["served_mono_ns"] - period_ns, tick)
    if bench.clock[WORD_FAILURE] != 0:
        return np.int64(status.EXIT_SYSTEM_CALL)
    return reason


@hot
def _begin(bench, start_mono_ns):
    """What must hold before tick 0."""
    progress = bench.progress[0]
    read_usage(bench.config[0]["schedstat_fd"], bench.rusage, bench.schedstat_text, bench.usage_before)
    progress["wake_mono_ns_before"] = 0
    progress["served_mono_ns"] = start_mono_ns - bench.config[0]["period_ns"]
    progress["emptied_mono_ns"] = 0
    progress["emptied_before_mono_ns"] = 0
    progress["inbox_head"] = 0
    progress["inbox_tail"] = 0
    progress["clock_offset_ns"] = clock_offset_ns(bench.clock)


@hot
def _last_tick(config, tick_limit):
    """The last tick of the grid: it is run however late, so that the run is as long as it was meant to be."""
    last = np.int64(tick_limit)
    if config["stimulus_tick_count"] > 0:
        last = min(last, config["stimulus_tick_count"])
    return last - 1


@hot
def _asked_to_stop(bench):
    return bench.ring.header[ring_layout.WORD_STOP_REQUEST * _STRIDE] != 0


@hot
def _end_reason(bench, tick, skipped, tick_limit):
    """Why the run ends before this tick, or EXIT_RUNNING. Periods that were skipped are computed before a stop is heeded."""
    if skipped == 0 and _asked_to_stop(bench):
        return np.int64(status.EXIT_SIGNAL)
    if tick >= tick_limit:
        return np.int64(status.EXIT_DURATION)
    stimulus_ticks = bench.config[0]["stimulus_tick_count"]
    if stimulus_ticks > 0 and tick >= stimulus_ticks:
        return np.int64(status.EXIT_STIMULUS_END)
    return np.int64(status.EXIT_RUNNING)


@folded
def _run_tick(bench, descriptor, tick, skipped, last_tick, deadline_mono_ns, wake_ns):
    """One period: receive, decode, step, encode and send, record, account. Returns status.EXIT_*.

    progress["tick"] tells which one was run: a later one than `tick` where that was found late by whole periods.
    """
    progress = bench.progress[0]
    period_ns = bench.config[0]["period_ns"]
    clock = bench.clock
    progress["tick"] = tick
    progress["echo_real_ns"] = 0

    placed = progress["inbox_tail"]
    _receive(bench, descriptor)
    received_ns = now_mono_ns(clock)
    progress["emptied_before_mono_ns"] = progress["emptied_mono_ns"]
    if progress["inbox_tail"] < bench.inbox.frame.shape[0]:
        progress["emptied_mono_ns"] = received_ns

    due_mono_ns = deadline_mono_ns + period_ns  # when the first period that nobody has judged yet had to be over
    late_ns = received_ns - deadline_mono_ns
    if received_ns - wake_ns >= period_ns:  # it stood still on the way to its frames: that was no wake-up yet
        wake_ns = received_ns
    if late_ns >= period_ns and bench.config[0]["overrun"] == status.OVERRUN_SKIP and tick < last_tick:
        more = min(late_ns // period_ns, last_tick - tick)
        tick += more
        skipped += more
        deadline_mono_ns += more * period_ns
    stalled = _note_stall(bench, wake_ns - progress["served_mono_ns"] - period_ns, tick)
    progress["served_mono_ns"] = wake_ns

    progress["frames_end"] = progress["inbox_tail"]
    progress["periods_due"] = 1
    if late_ns >= period_ns or skipped > 0:
        reason = serve_late(bench, descriptor, tick, skipped, deadline_mono_ns, wake_ns, received_ns, placed)
        if reason != status.EXIT_RUNNING:
            return reason
        progress["tick"] = tick
    reason = _serve_tick(bench, descriptor, tick, skipped, deadline_mono_ns, due_mono_ns, wake_ns, received_ns)
    if reason == status.EXIT_RUNNING and stalled:
        return np.int64(status.EXIT_STALLED)
    return reason


@folded
def _serve_tick(bench, descriptor, tick, skipped, deadline_mono_ns, due_mono_ns, wake_ns, received_ns):
    """Everything of a tick behind its frames: decode, step, encode and send, record, account."""
    progress = bench.progress[0]
    clock = bench.clock
    first = progress["inbox_head"]
    end = progress["frames_end"]
    periods = progress["periods_due"]

    begin_ns = now_mono_ns(clock) if skipped > 0 else received_ns
    decode_stage(bench, tick, first, end)
    decoded_ns = now_mono_ns(clock)

    flags = step_stage(bench, tick, periods)
    stepped_ns = now_mono_ns(clock)

    due = encode_stage(bench, tick)
    sent = _send(bench, descriptor, due)
    real_ns = np.int64(0)
    if progress["echo_real_ns"] != 0 and sent > 0:  # no clock call in a tick that answers nothing
        real_ns = now_real_ns(clock)
    sent_ns = now_mono_ns(clock)

    bench.phase_ns[status.PHASE_RECEIVE] = received_ns - wake_ns
    bench.phase_ns[status.PHASE_DECODE] = decoded_ns - begin_ns
    bench.phase_ns[status.PHASE_STEP] = stepped_ns - decoded_ns + (begin_ns - received_ns)
    bench.phase_ns[status.PHASE_ENCODE] = sent_ns - stepped_ns
    progress["tick_count"] += 1
    progress["frames_received"] += end - first
    progress["flags_seen"] |= flags

    record_received(bench, tick, first, end, wake_ns)
    record_sent(bench, tick, sent, sent_ns)
    _use_up(progress, end)
    dropped = record_tick(bench, tick, periods - 1, deadline_mono_ns, wake_ns, end - first, due_mono_ns)
    recorded_ns = now_mono_ns(clock)
    bench.phase_ns[status.PHASE_RECORD] = recorded_ns - sent_ns
    progress["record_ns_before"] = recorded_ns - sent_ns

    reason = _judge_tick(bench, tick, skipped, due_mono_ns, wake_ns, recorded_ns, end - first, dropped)
    response_ns = _response_ns(progress, real_ns, sent_ns)
    _count_times(bench, tick, skipped, deadline_mono_ns, wake_ns, recorded_ns, response_ns)
    if progress["bus_errno"] != 0:
        return np.int64(status.EXIT_CAN_LOST)
    if flags & status.FLAG_NOT_FINITE:
        return np.int64(status.EXIT_NOT_FINITE)
    return reason


@hot
def _receive(bench, descriptor):
    """Take the waiting frames into the inbox, behind those that wait there; a bus that is gone is noted."""
    if descriptor < 0:
        return
    progress = bench.progress[0]
    tail = np.int64(receive_frames(descriptor, bench.inbox, progress["inbox_tail"]))
    if tail < 0:
        progress["bus_errno"] = -tail
        return
    progress["inbox_tail"] = tail
    dropped = (bench.inbox.overflow[0] - max(bench.inbox.overflow[1], 0)) & 0xFFFFFFFF  # the kernel counts in 32 bits
    if dropped != bench.ring.header[ring_layout.WORD_KERNEL_DROPPED * _STRIDE]:
        bench.ring.header[ring_layout.WORD_KERNEL_DROPPED * _STRIDE] = dropped


@hot
def _use_up(progress, frames_end):
    """The frames up to here have had their period; an empty inbox begins anew."""
    progress["inbox_head"] = frames_end
    if frames_end == progress["inbox_tail"]:
        progress["inbox_head"] = 0
        progress["inbox_tail"] = 0


@hot
def _note_stall(bench, silent_ns, tick):
    """Count a time in which no period was served, beyond the period itself; True when the run must end for it."""
    header = bench.ring.header
    if silent_ns > header[ring_layout.WORD_STALL_NS_MAX * _STRIDE]:
        header[ring_layout.WORD_STALL_NS_MAX * _STRIDE] = silent_ns
    limit_ns = bench.config[0]["stall_ns_max"]
    if limit_ns < 0 or silent_ns <= limit_ns:
        return False
    header[ring_layout.WORD_STALL_NS_LAST * _STRIDE] = silent_ns
    header[ring_layout.WORD_STALL_TICK_LAST * _STRIDE] = tick
    if header[ring_layout.WORD_STALL_COUNT * _STRIDE] == 0:
        header[ring_layout.WORD_STALL_TICK_FIRST * _STRIDE] = tick + 1
    header[ring_layout.WORD_STALL_COUNT * _STRIDE] += 1
    return bench.config[0]["stall_action"] == ACTION_STOP


@hot
def _send(bench, descriptor, due):
    """Send the outbox; frames sent. A bus that is gone is noted, a full queue is counted."""
    if descriptor < 0 or due == 0:
        return np.int64(0)
    progress = bench.progress[0]
    sent = send_frames(descriptor, bench.outbox, due)
    if sent < 0:
        progress["bus_errno"] = -sent
        sent = np.int64(0)
    progress["frames_sent"] += sent
    progress["frames_unsent"] += due - sent
    return np.int64(sent)


@hot
def _response_ns(progress, real_ns, sent_ns):
    """From the kernel's stamp of the newest command to its answer on the bus; -1 when this tick answers none.

    By CLOCK_MONOTONIC: the stamp, of CLOCK_REALTIME, is converted by the difference of the clocks as seen before the command came or
    by the one now, whichever puts it into the time in which it can have come. Where neither does, the clock was set on the way.
    """
    if real_ns == 0:
        return np.int64(-1)
    stamp_ns = progress["echo_real_ns"]
    before_ns = progress["clock_offset_ns"]
    progress["clock_offset_ns"] = real_ns - sent_ns
    longest_ns = sent_ns - progress["emptied_before_mono_ns"] + _RESPONSE_SLACK_NS
    response_ns = real_ns - stamp_ns
    if 0 <= response_ns <= longest_ns:
        return response_ns
    response_ns = sent_ns + before_ns - stamp_ns
    return response_ns if 0 <= response_ns <= longest_ns else np.int64(-1)


@hot
def _judge_tick(bench, tick, skipped, due_mono_ns, wake_ns, end_ns, received, dropped):
    """Count and explain a miss, and act on the profile's limits; status.EXIT_*.

    due_mono_ns: when this tick had to be over; after a stall that nobody has judged yet, the first period lost to it.
    """
    progress = bench.progress[0]
    config = bench.config[0]
    late_ns = end_ns - due_mono_ns
    counted = tick >= config["warm_up_ticks"]
    # where a system call is dear the counters are read at misses only, and tell of the time since the miss before
    read = bench.clock[WORD_CYCLE_RATE] == 0 or late_ns > 0 or dropped
    if read:
        read_usage(config["schedstat_fd"], bench.rusage, bench.schedstat_text, bench.usage_after)
    reason = np.int64(status.EXIT_RUNNING)
    if late_ns > 0 and counted:
        progress["miss_count"] += 1
        progress["consecutive_miss_count"] += 1
        progress["near_miss_left"] = config["near_miss_ticks"]
        bench.ring.header[ring_layout.WORD_MISS_TOTAL * _STRIDE] = progress["miss_count"]
        reason = _act_on_limits(bench, late_ns)
    else:
        progress["consecutive_miss_count"] = 0
        if progress["near_miss_left"] > 0:
            progress["near_miss_left"] -= 1
    if counted and (late_ns > 0 or dropped):
        wake_lateness_ns = wake_ns - (due_mono_ns - config["period_ns"])
        _record_miss(bench, tick, skipped, late_ns, wake_lateness_ns, end_ns - wake_ns, received, dropped)
    if read:
        for k in range(bench.usage_before.shape[0]):
            bench.usage_before[k] = bench.usage_after[k]
    if late_ns > 0 and counted and config["overrun"] == status.OVERRUN_STOP:
        return np.int64(status.EXIT_DEADLINE)
    return reason


@hot
def _act_on_limits(bench, late_ns):
    progress = bench.progress[0]
    config = bench.config[0]
    reason = _act(
        bench, progress["consecutive_miss_count"], config["consecutive_miss_max"], config["consecutive_miss_action"]
    )
    if reason == status.EXIT_RUNNING:
        reason = _act(bench, progress["miss_count"], config["total_miss_max"], config["total_miss_action"])
    if reason == status.EXIT_RUNNING:
        reason = _act(bench, late_ns, config["lateness_ns_max"], config["lateness_action"])
    return reason


@hot
def _act(bench, value, limit, action):
    if limit < 0 or value <= limit:
        return np.int64(status.EXIT_RUNNING)
    if action == ACTION_STOP:
        return np.int64(status.EXIT_DEADLINE)
    if action == ACTION_FAIL_SAFE:
        for axis in range(bench.commands.shape[0]):
            command.force_fail_safe(bench.commands, axis)
        bench.progress[0]["forced_fail_safe"] = 1
    bench.progress[0]["warned_count"] += 1
    return np.int64(status.EXIT_RUNNING)


@hot
def _record_miss(bench, tick, skipped, late_ns, wake_lateness_ns, execution_ns, received, dropped):
    if bench.config[0]["record"] == 0:
        return
    header = bench.ring.header
    capacity = bench.ring.miss.shape[0]
    if not ring.has_room(header, ring_layout.WORD_MISS_WRITTEN, ring_layout.WORD_MISS_READ, capacity):
        ring.count_drop(header, ring_layout.WORD_MISS_DROPPED)
        return
    before = bench.usage_before
    after = bench.usage_after
    phase, cause = suspect_cause(
        wake_lateness_ns, bench.progress[0]["carried_ns"], bench.phase_ns, before, after, received,
        bench.config[0]["burst_frame_count"], late_ns > 0, dropped,
    )  # fmt: skip
    row = bench.ring.miss[header[ring_layout.WORD_MISS_WRITTEN * _STRIDE] & (capacity - 1)]
    row["tick"] = tick
    row["lateness_ns"] = late_ns
    row["wake_lateness_ns"] = wake_lateness_ns
    row["execution_ns"] = execution_ns
    row["page_faults_minor"] = after[USAGE_FAULTS_MINOR] - before[USAGE_FAULTS_MINOR]
    row["page_faults_major"] = after[USAGE_FAULTS_MAJOR] - before[USAGE_FAULTS_MAJOR]
    row["switches_voluntary"] = after[USAGE_SWITCHES_VOLUNTARY] - before[USAGE_SWITCHES_VOLUNTARY]
    row["switches_involuntary"] = after[USAGE_SWITCHES_INVOLUNTARY] - before[USAGE_SWITCHES_INVOLUNTARY]
    row["frames_queued"] = received
    row["skipped_count"] = skipped
    row["cpu"] = after[USAGE_CPU]
    row["cpu_before"] = before[USAGE_CPU]
    row["phase"] = phase
    row["cause"] = cause
    ring.publish(header, ring_layout.WORD_MISS_WRITTEN)


@hot
def _count_times(bench, tick, skipped, deadline_mono_ns, wake_ns, end_ns, response_ns):
    """Histograms of this tick; warm-up ticks stay out."""
    progress = bench.progress[0]
    config = bench.config[0]
    before_ns = progress["wake_mono_ns_before"]
    progress["wake_mono_ns_before"] = wake_ns
    if tick < config["warm_up_ticks"]:
        return
    period_ns = config["period_ns"]
    histogram = bench.ring.histogram
    extreme = bench.ring.extreme
    # the first deadline that was missed by skipping was due `skipped` periods before this one
    record_corrected(
        histogram, extreme, _WAKE_LATENESS, wake_ns - deadline_mono_ns + skipped * period_ns, skipped, period_ns
    )
    for phase in range(status.PHASE_COUNT):
        record_value(histogram, extreme, _FIRST_PHASE + phase, bench.phase_ns[phase])
    record_value(histogram, extreme, _EXECUTION, end_ns - wake_ns)
    if before_ns > 0:
        record_value(histogram, extreme, _PERIOD, wake_ns - before_ns)
    for axis in range(bench.commands.shape[0]):
        age = command.age_ns(bench.commands, axis, tick, period_ns)
        if age >= 0:
            record_value(histogram, extreme, _COMMAND_AGE, age)
    if response_ns >= 0:
        record_value(histogram, extreme, _RESPONSE, response_ns)
