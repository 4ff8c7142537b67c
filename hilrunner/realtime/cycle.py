"""One period without a clock: decode, step, encode. The loop, the replay, the simulation and the tests call these three.

Nothing here knows when it runs: a period is a tick number, a count of grid periods to advance, and the frames in the inbox. That is
what makes a replay a proof.
"""

import numpy as np

from hilrunner.base import state_layout, status
from hilrunner.base.compiled import entry, folded, hot
from hilrunner.base.records import FRAME_STATUS_NONE
from hilrunner.plant.step import advance, current_load_force
from hilrunner.plant.wave import heave_motion
from hilrunner.plant.wave import load_scale as wave_load_scale
from hilrunner.realtime import command, encode, faults
from hilrunner.realtime.decode import NO_FRAME, accept_counter, check_frame, read_group, take_group
from hilrunner.realtime.handle import handle
from hilrunner.realtime.socketcan import FRAME_SIZE_CLASSIC, FRAME_SIZE_FD

NO_AXIS_BYTE = 255
_DATA_AT = 8  # data bytes in struct can_frame and struct canfd_frame
_FD_FLAGS = 0x04  # CANFD_FDF


@hot
def decode_stage(bench, tick, first, end):
    """Take the frames of this period, places `first` to `end` - 1 of the inbox: the newest valid command of every axis holds.

    Writes commands, last_counter, frame_axis, frame_status and the ring's frame counters.
    """
    begin_period(bench)
    decode_frames(bench, tick, first, end)


@hot
def begin_period(bench):
    """No frame has come in this period yet."""
    for axis in range(bench.commands.shape[0]):
        bench.commands[axis]["status"] = FRAME_STATUS_NONE


@entry  # cached by itself: what calls it need not compile it again
def decode_frames(bench, tick, first, end):
    """Check each of these frames of the inbox, keep the newest valid command of every axis, count all."""
    for k in range(first, end):
        _decode_one(bench, tick, k)


@hot
def _decode_one(bench, tick, k):
    """Check and take frame k of the inbox, and count it once for every axis it speaks to; 255 in frame_axis: to none."""
    message, code, counter = _check_one(bench, k)
    bench.frame_axis[k] = NO_AXIS_BYTE
    bench.frame_status[k] = code
    if message == NO_FRAME:
        bench.ring.frame_count[bench.commands.shape[0], code] += 1
        return
    row = bench.command_table.frames[message]
    group = np.int64(row["group_first"])
    end = group + np.int64(row["group_count"])
    good = np.int64(0)
    bad = np.int64(0)
    while group < end:
        axis = np.int64(bench.command_table.groups[group]["axis"])
        outcome = np.int64(FRAME_STATUS_NONE)
        while group < end and bench.command_table.groups[group]["axis"] == axis:  # the pages of one axis
            outcome = _decode_group(bench, tick, k, group, code, counter, outcome)
            group += 1
        if outcome == FRAME_STATUS_NONE:
            continue
        if outcome == status.FRAME_VALID:
            good += 1
            if faults.acts(bench.faults, faults.COMMAND_LOST, axis, tick):
                _note_lost(bench, k, good + bad)
                continue
        else:
            bad += 1
        bench.ring.frame_count[axis, outcome] += 1
        bench.commands[axis]["status"] = outcome
        if good + bad == 1 or (
            bad == 1 and outcome != status.FRAME_VALID
        ):  # the first axis, or the first that refuses it
            bench.frame_axis[k] = axis
            bench.frame_status[k] = outcome
    if good + bad == 0:
        bench.ring.frame_count[bench.commands.shape[0], code] += 1
    if code == status.FRAME_VALID and (good > 0 or bad == 0):
        accept_counter(bench.command_table, message, counter, bench)


@hot
def _decode_group(bench, tick, k, group, code, counter, outcome):
    """What became of one part of a frame: `outcome` is what became of the axis' parts before it."""
    data = bench.inbox.frame[k, _DATA_AT:]
    found = code
    if code == status.FRAME_VALID:
        found = read_group(bench.command_table, group, data, bench)
    if found == FRAME_STATUS_NONE:
        return outcome
    if found == status.FRAME_VALID:
        axis = np.int64(bench.command_table.groups[group]["axis"])
        lost = faults.acts(bench.faults, faults.COMMAND_LOST, axis, tick)
        if not lost and take_group(bench.command_table, group, tick, counter, bench):
            command.accept(bench.commands, axis, bench.fresh)
            bench.progress[0]["echo_real_ns"] = bench.inbox.kernel_real_ns[k]
    return found if outcome == FRAME_STATUS_NONE or outcome == status.FRAME_VALID else outcome


@hot
def _note_lost(bench, k, axis_number):
    """A frame that an injected fault keeps from its axis counts as one that belongs to none."""
    bench.ring.frame_count[bench.commands.shape[0], status.FRAME_UNKNOWN_ID] += 1
    if axis_number == 1:
        bench.frame_status[k] = status.FRAME_UNKNOWN_ID


@hot
def _check_one(bench, k):
    """(message, status, counter) of frame k of the inbox; a short or foreign-sized packet is a wrong length."""
    frame = bench.inbox.frame[k]
    size = bench.inbox.size_bytes[k]
    if size != FRAME_SIZE_CLASSIC and size != FRAME_SIZE_FD:
        return NO_FRAME, np.int64(status.FRAME_WRONG_LENGTH), np.int64(0)
    can_id = np.int64(frame[0]) | np.int64(frame[1]) << 8 | np.int64(frame[2]) << 16 | np.int64(frame[3]) << 24
    length = np.int64(frame[4])
    if length > size - _DATA_AT:
        return NO_FRAME, np.int64(status.FRAME_WRONG_LENGTH), np.int64(0)
    message, code, counter = check_frame(bench.command_table, can_id, length, frame[_DATA_AT:], bench)
    if code == status.FRAME_UNKNOWN_ID:
        code = np.int64(_foreign_status(bench.measurement_table, can_id))
    return message, code, counter


@hot
def _foreign_status(table, can_id):
    """Of a frame that is no command: an identifier this bench sends is another bench's, for its own are not received."""
    for message in range(table.message_count):
        if np.int64(table.can_id[message]) == can_id:
            return status.FRAME_OWN_ID
    return status.FRAME_UNKNOWN_ID


@entry  # cached by itself: what calls it need not compile it again
def step_stage(bench, tick, period_count):
    """Age the commands and advance every axis by `period_count` grid periods, the last of which ends this tick.

    Inputs are held over a period. A skipped period is simulated too, with the command as it had aged by then, so that plant
    time never falls behind the grid. Returns the OR of all state flags.
    """
    config = bench.config[0]
    faults.trigger(bench.faults, tick, bench.quantity)
    seen = np.int64(0)
    for axis in range(bench.state.shape[0]):
        flags = np.int64(0)
        for at in range(tick - period_count + 1, tick + 1):
            flags |= _advance_axis(bench, axis, at, config["period_ns"], config["period_s"])
        # at the time of the load above, so that the firmware is told the very heave that moves its load
        z, dz = heave_motion(bench.wave[axis], tick * config["period_s"])
        bench.quantity[axis, encode.QUANTITY_HEAVE_POSITION] = z
        bench.quantity[axis, encode.QUANTITY_HEAVE_VELOCITY] = dz
        if bench.commands[axis]["mode"] == status.MODE_FAIL_SAFE:
            flags |= status.FLAG_FAIL_SAFE
        if faults.any_active(bench.faults, axis, tick):
            flags |= status.FLAG_FAULT_ACTIVE
        bench.state_flags[axis] = flags
        seen |= flags
    return seen


@folded
def _advance_axis(bench, axis, tick, period_ns, period_s):
    """One grid period of one axis."""
    valve = _valve_command(bench, axis, tick, period_ns)
    scale = wave_load_scale(bench.wave[axis], tick * period_s)
    scale = faults.load_scale(bench.faults, axis, tick, scale)
    bench.load_scale[axis] = scale
    bench.commands[axis]["applied"] = valve
    return advance(bench.plant, axis, valve, scale, period_s, bench.state[axis], bench.plant_scratch)


@hot
def _valve_command(bench, axis, tick, period_ns):
    count = bench.config[0]["stimulus_tick_count"]
    if count > 0:
        valve = bench.stimulus[min(tick, count - 1), axis]
        bench.commands[axis]["mode"] = status.MODE_ACTIVE
        bench.commands[axis]["valid_tick"] = tick
    else:
        valve = command.apply_age(bench.commands, axis, tick, period_ns)
    return faults.valve_command(bench.faults, axis, tick, valve)


@hot
def measure(bench, tick):
    """What the sensors show after this period, SI, one row an axis of `bench.quantity`; faults included."""
    supply = bench.plant.parameters
    for axis in range(bench.state.shape[0]):
        state = bench.state[axis]
        row = bench.quantity[axis]
        row[encode.QUANTITY_CHAMBER_1_PRESSURE] = state[state_layout.CHAMBER_1_PRESSURE]
        row[encode.QUANTITY_CHAMBER_2_PRESSURE] = state[state_layout.CHAMBER_2_PRESSURE]
        row[encode.QUANTITY_SUPPLY_PRESSURE] = supply[axis]["supply_pressure_pa"]
        row[encode.QUANTITY_LINE_A_PRESSURE] = state[state_layout.LINE_A_PRESSURE]
        row[encode.QUANTITY_LINE_B_PRESSURE] = state[state_layout.LINE_B_PRESSURE]
        row[encode.QUANTITY_ROD_POSITION] = state[state_layout.ROD_POSITION]
        row[encode.QUANTITY_ROD_VELOCITY] = state[state_layout.ROD_VELOCITY]
        row[encode.QUANTITY_SPOOL_1_POSITION] = state[state_layout.SPOOL_1_POSITION]
        row[encode.QUANTITY_SPOOL_2_POSITION] = state[state_layout.SPOOL_2_POSITION]
        row[encode.QUANTITY_LOAD_FORCE] = current_load_force(
            bench.plant, axis, state[state_layout.ROD_POSITION], bench.load_scale[axis]
        )
        row[encode.QUANTITY_VALVE_COMMAND] = bench.commands[axis]["applied"]
        row[encode.QUANTITY_BENCH_STATE] = bench.commands[axis]["mode"]
        row[encode.QUANTITY_FLAGS] = bench.state_flags[axis] & status.BUS_FLAGS
        row[encode.QUANTITY_TICK] = tick
        row[encode.QUANTITY_DEADLINE_MISSES] = bench.progress[0]["miss_count"]
        row[encode.QUANTITY_ECHOED_TIMESTAMP] = bench.commands[axis]["timestamp_us"]
    faults.disturb_sensors(bench.faults, tick, bench.quantity)


@entry  # cached by itself: what calls it need not compile it again
def encode_stage(bench, tick):
    """Fill the outbox with the measurements due at this tick; returns how many frames."""
    measure(bench, tick)
    table = bench.measurement_table
    count = 0
    for message in range(table.message_count):
        if tick % table.period_ticks[message] != table.phase[message]:
            continue
        harmed = bench.faults.shape[0] > 0
        if harmed and faults.acts_on_any(bench.faults, faults.MEASUREMENT_LOST, table.axes[message], tick):
            continue
        frame = bench.outbox.frame[count]
        length = encode.encode_measurement(
            table, message, bench.quantity, bench.sent_counter, bench.ring.clamped_count, frame[_DATA_AT:]
        )
        if harmed and faults.acts_on_any(bench.faults, faults.MEASUREMENT_BAD_CRC, table.axes[message], tick):
            frame[_DATA_AT + table.checksum_byte[message]] ^= np.uint8(0xFF)
        can_id = np.int64(table.can_id[message])
        for byte in range(4):
            frame[byte] = np.uint8((can_id >> (8 * byte)) & 0xFF)
        frame[4] = np.uint8(length)
        is_fd = table.fd[message] != 0
        frame[5] = np.uint8(_FD_FLAGS | table.fd[message] >> 1 if is_fd else 0)
        bench.outbox.size_bytes[count] = FRAME_SIZE_FD if is_fd else FRAME_SIZE_CLASSIC
        count += 1
    return count


@hot
def fill_state_record(bench, axis, tick, record):
    """One row of /<axis>/state."""
    state = bench.state[axis]
    record["tick"] = tick
    record["rod_position_m"] = state[state_layout.ROD_POSITION]
    record["rod_velocity_mps"] = state[state_layout.ROD_VELOCITY]
    record["chamber_1_pressure_pa"] = state[state_layout.CHAMBER_1_PRESSURE]
    record["chamber_2_pressure_pa"] = state[state_layout.CHAMBER_2_PRESSURE]
    record["spool_1_position_m"] = state[state_layout.SPOOL_1_POSITION]
    record["spool_2_position_m"] = state[state_layout.SPOOL_2_POSITION]
    record["spool_1_velocity_mps"] = state[state_layout.SPOOL_1_VELOCITY]
    record["spool_2_velocity_mps"] = state[state_layout.SPOOL_2_VELOCITY]
    record["line_a_pressure_pa"] = state[state_layout.LINE_A_PRESSURE]
    record["line_b_pressure_pa"] = state[state_layout.LINE_B_PRESSURE]
    record["load_force_n"] = current_load_force(
        bench.plant, axis, state[state_layout.ROD_POSITION], bench.load_scale[axis]
    )
    record["load_scale"] = bench.load_scale[axis]
    record["flags"] = bench.state_flags[axis]


@hot
def fill_command_record(bench, axis, tick, record):
    """One row of /<axis>/command."""
    row = bench.commands[axis]
    record["tick"] = tick
    record["valve_command"] = row["applied"]
    record["age_ns"] = command.age_ns(bench.commands, axis, tick, bench.config[0]["period_ns"])
    record["echoed_timestamp_us"] = row["timestamp_us"]
    record["mode"] = row["mode"]
    record["counter"] = row["counter"]
    record["status"] = row["status"]
    record["control"] = row["control"]


@hot
def _fill_inbox(bench, frames, sizes, first, count):
    for k in range(count):
        for byte in range(FRAME_SIZE_FD):
            bench.inbox.frame[k, byte] = frames[first + k, byte]
        bench.inbox.size_bytes[k] = sizes[first + k]
        bench.inbox.kernel_real_ns[k] = 0


@entry
def run_offline(bench, ticks, period_counts, miss_counts, forced, frames, sizes, frame_first, command_out, state_out):
    """Run the same three stages for a list of ticks, without clock or bus: the heart of replay and simulate.

    Args:
        bench: Bench, its state moves on.
        ticks: int64[n], grid numbers. period_counts: int64[n], grid periods each tick advances (1 + skipped).
        miss_counts: int64[n], deadline misses known to the bench when each tick ran (they are sent on the bus).
        forced: int64[n], 1 where a deadline limit forced the fail-safe just before the tick.
        frames: uint8[f, 72], sizes: int64[f], struct can(fd)_frame in the order received.
        frame_first: int64[n + 1], frames of tick i are frame_first[i] .. frame_first[i + 1] - 1.
        command_out: records.COMMAND[n, axis], state_out: records.STATE[n, axis]; written.
    Returns:
        number of ticks run; fewer than n when a state left the finite numbers.
    """
    return _run_offline(
        handle(bench), ticks, period_counts, miss_counts, forced, frames, sizes, frame_first, command_out, state_out
    )


@hot
def _run_offline(bench, ticks, period_counts, miss_counts, forced, frames, sizes, frame_first, command_out, state_out):
    for i in range(ticks.shape[0]):
        tick = ticks[i]
        count = frame_first[i + 1] - frame_first[i]
        _fill_inbox(bench, frames, sizes, frame_first[i], count)
        bench.progress[0]["miss_count"] = miss_counts[i]
        if forced[i] != 0:
            for axis in range(bench.commands.shape[0]):
                command.force_fail_safe(bench.commands, axis)
        decode_stage(bench, tick, 0, count)
        flags = step_stage(bench, tick, period_counts[i])
        encode_stage(bench, tick)
        for axis in range(bench.state.shape[0]):
            fill_command_record(bench, axis, tick, command_out[i, axis])
            fill_state_record(bench, axis, tick, state_out[i, axis])
        if flags & status.FLAG_NOT_FINITE:
            return i + 1
    return ticks.shape[0]
