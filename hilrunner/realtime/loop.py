"""The whole period as one compiled function that needs no interpreter; with `waiting`, all that knows time.

The grid never moves: tick k is due at start + k period. A tick that ends past the end of its period is a miss. After a miss the next
tick starts at once if less than a whole period is lost, so 0.1 ms late costs 0.1 ms; whole lost periods are handled by the
overrun policy: `skip` (their frames are not sent; the plant advances through them), `catch-up` (each is run in full, late), `stop`.
"""

import numpy as np

from hilrunner.base import ring as ring_layout
from hilrunner.base import status
from hilrunner.base.compiled import entry, hot
from hilrunner.base.records import (
    CAN_FRAME_SENT,
    HISTOGRAM_NAMES,
    TICK_FLAG_FORCED_FAIL_SAFE,
    TICK_FLAG_MISS,
    TICK_FLAG_NEAR_MISS,
)
from hilrunner.realtime import command, ring
from hilrunner.realtime.clock import WORD_CYCLE_RATE, anchor, now_mono_ns, now_real_ns
from hilrunner.realtime.cycle import decode_stage, encode_stage, fill_command_record, fill_state_record, step_stage
from hilrunner.realtime.handle import handle
from hilrunner.realtime.histogram import record_corrected, record_value
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


@hot
def _run(bench, shadow, descriptor, start_mono_ns, tick_limit):
    """The loop itself; `bench` and `shadow` are handles from here on."""
    progress = bench.progress[0]
    config = bench.config[0]
    period_ns = config["period_ns"]
    tick = np.int64(0)
    skipped = np.int64(0)
    reason = np.int64(status.EXIT_RUNNING)
    read_usage(config["schedstat_fd"], bench.rusage, bench.schedstat_text, bench.usage_before)
    progress["wake_mono_ns_before"] = 0
    while reason == status.EXIT_RUNNING:
        reason = _end_reason(bench, tick, tick_limit)
        if reason != status.EXIT_RUNNING:
            break
        deadline_mono_ns = start_mono_ns + tick * period_ns
        ahead_ns = deadline_mono_ns - now_mono_ns(bench.clock)
        progress["carried_ns"] = max(-ahead_ns, 0)
        if ahead_ns > 0:
            wait_for_tick(bench, shadow, descriptor, tick, deadline_mono_ns)
        wake_ns = anchor(bench.clock)  # before anything of the tick is touched: those memory lines are cold
        reason = _run_tick(bench, descriptor, tick, skipped, deadline_mono_ns, wake_ns)
        late_ns = now_mono_ns(bench.clock) - (deadline_mono_ns + period_ns)
        skipped = np.int64(0)
        if late_ns >= period_ns and config["overrun"] == status.OVERRUN_SKIP:
            skipped = late_ns // period_ns
            progress["skipped_count"] += skipped
            bench.ring.header[ring_layout.WORD_SKIPPED_TOTAL * _STRIDE] += skipped
        tick += 1 + skipped
    return reason


@hot
def _end_reason(bench, tick, tick_limit):
    """Why the run ends before this tick, or EXIT_RUNNING."""
    if bench.ring.header[ring_layout.WORD_STOP_REQUEST * _STRIDE] != 0:
        return np.int64(status.EXIT_SIGNAL)
    if tick >= tick_limit:
        return np.int64(status.EXIT_DURATION)
    stimulus_ticks = bench.config[0]["stimulus_tick_count"]
    if stimulus_ticks > 0 and tick >= stimulus_ticks:
        return np.int64(status.EXIT_STIMULUS_END)
    return np.int64(status.EXIT_RUNNING)


@hot
def _run_tick(bench, descriptor, tick, skipped, deadline_mono_ns, wake_ns):
    """One period: receive, decode, step, encode and send, record, account. Returns status.EXIT_*."""
    progress = bench.progress[0]
    progress["tick"] = tick
    clock = bench.clock

    received = np.int64(0)
    if descriptor >= 0:
        received = receive_frames(descriptor, bench.inbox)
        if received < 0:
            progress["bus_errno"] = -received
            received = np.int64(0)
    received_ns = now_mono_ns(clock)

    decode_stage(bench, tick, received)
    decoded_ns = now_mono_ns(clock)

    flags = step_stage(bench, tick, skipped + 1)
    stepped_ns = now_mono_ns(clock)

    due = encode_stage(bench, tick)
    sent = _send(bench, descriptor, due)
    response_ns = _response_ns(bench, sent)
    sent_ns = now_mono_ns(clock)

    bench.phase_ns[status.PHASE_RECEIVE] = received_ns - wake_ns
    bench.phase_ns[status.PHASE_DECODE] = decoded_ns - received_ns
    bench.phase_ns[status.PHASE_STEP] = stepped_ns - decoded_ns
    bench.phase_ns[status.PHASE_ENCODE] = sent_ns - stepped_ns
    progress["tick_count"] += 1
    progress["frames_received"] += received
    progress["flags_seen"] |= flags

    _record_frames(bench, tick, received, due, sent, wake_ns, sent_ns)
    dropped = _record_tick(bench, tick, skipped, deadline_mono_ns, wake_ns, received, sent_ns)
    recorded_ns = now_mono_ns(clock)
    bench.phase_ns[status.PHASE_RECORD] = recorded_ns - sent_ns
    progress["record_ns_before"] = recorded_ns - sent_ns

    reason = _judge_tick(bench, tick, skipped, deadline_mono_ns, wake_ns, recorded_ns, received, dropped)
    _count_times(bench, tick, skipped, deadline_mono_ns, wake_ns, recorded_ns, response_ns)
    if progress["bus_errno"] != 0:
        return np.int64(status.EXIT_CAN_LOST)
    if flags & status.FLAG_NOT_FINITE:
        return np.int64(status.EXIT_NOT_FINITE)
    return reason


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
def _response_ns(bench, sent):
    """From the kernel's stamp of the newest command to its answer on the bus; -1 when this tick answers none."""
    stamp_ns = bench.progress[0]["echo_real_ns"]
    if stamp_ns == 0 or sent == 0:  # no clock call in a tick that answers nothing
        return np.int64(-1)
    return now_real_ns(bench.clock) - stamp_ns


@hot
def _record_frames(bench, tick, received, due, sent, wake_ns, sent_ns):
    if bench.config[0]["record"] == 0:
        return
    for k in range(received):
        frame = bench.inbox.frame[k]
        length = min(np.int64(frame[4]), np.int64(64))
        fd = np.int64(1 if bench.inbox.size_bytes[k] > 16 else 0)
        ring.push_can(
            bench.ring, tick, _frame_id(frame), fd, length, bench.frame_status[k], bench.frame_axis[k],
            bench.inbox.kernel_real_ns[k], wake_ns, frame, 8,
        )  # fmt: skip
    for k in range(sent):
        frame = bench.outbox.frame[k]
        fd = np.int64(1 if bench.outbox.size_bytes[k] > 16 else 0)
        ring.push_can(
            bench.ring, tick, _frame_id(frame), fd | CAN_FRAME_SENT, np.int64(frame[4]), np.int64(0), np.int64(255),
            np.int64(0), sent_ns, frame, 8,
        )  # fmt: skip


@hot
def _frame_id(frame):
    return np.int64(frame[0]) | np.int64(frame[1]) << 8 | np.int64(frame[2]) << 16 | np.int64(frame[3]) << 24


@hot
def _record_tick(bench, tick, skipped, deadline_mono_ns, wake_ns, received, sent_ns):
    """Fill TICK, COMMAND and STATE of this tick and publish them together; True when the ring was full."""
    if bench.config[0]["record"] == 0:
        return False
    box = bench.ring
    header = box.header
    capacity = box.tick.shape[0]
    if not ring.has_room(header, ring_layout.WORD_TICK_WRITTEN, ring_layout.WORD_TICK_READ, capacity):
        ring.count_drop(header, ring_layout.WORD_TICK_DROPPED)
        return True
    slot = header[ring_layout.WORD_TICK_WRITTEN * _STRIDE] & (capacity - 1)
    axis_count = bench.state.shape[0]
    for axis in range(axis_count):
        fill_command_record(bench, axis, tick, box.command[slot * axis_count + axis])
        fill_state_record(bench, axis, tick, box.state[slot * axis_count + axis])
    row = box.tick[slot]
    row["tick"] = tick
    row["deadline_mono_ns"] = deadline_mono_ns
    row["wake_mono_ns"] = wake_ns
    row["receive_ns"] = bench.phase_ns[status.PHASE_RECEIVE]
    row["decode_ns"] = bench.phase_ns[status.PHASE_DECODE]
    row["step_ns"] = bench.phase_ns[status.PHASE_STEP]
    row["encode_ns"] = bench.phase_ns[status.PHASE_ENCODE]
    row["record_ns"] = bench.progress[0]["record_ns_before"]
    row["frames_received"] = received
    row["skipped_count"] = skipped
    end_ns = now_mono_ns(bench.clock)
    row["end_mono_ns"] = end_ns
    row["flags"] = _tick_flags(bench, end_ns - (deadline_mono_ns + bench.config[0]["period_ns"]))
    ring.publish(header, ring_layout.WORD_TICK_WRITTEN)
    return False


@hot
def _tick_flags(bench, late_ns):
    progress = bench.progress[0]
    flags = TICK_FLAG_NEAR_MISS if late_ns > 0 or progress["near_miss_left"] > 0 else 0
    if late_ns > 0:
        flags |= TICK_FLAG_MISS
    if progress["forced_fail_safe"] != 0:  # by a limit, after the tick before: the one input a replay cannot derive
        flags |= TICK_FLAG_FORCED_FAIL_SAFE
        progress["forced_fail_safe"] = 0
    return flags


@hot
def _judge_tick(bench, tick, skipped, deadline_mono_ns, wake_ns, end_ns, received, dropped):
    """Count and explain a miss, and act on the profile's limits; status.EXIT_*."""
    progress = bench.progress[0]
    config = bench.config[0]
    late_ns = end_ns - (deadline_mono_ns + config["period_ns"])
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
        _record_miss(bench, tick, skipped, late_ns, wake_ns - deadline_mono_ns, end_ns - wake_ns, received, dropped)
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
