"""Everything one period needs, as flat arrays: what is constant, what the next period needs, what is scratch.

`Bench` is what `setup.arm` allocates and every function of this room receives. Its fields stand in three groups; a comment
says who writes them. Arrays have a leading axis dimension; one axis is a special case of many.
"""

from typing import NamedTuple

import numpy as np

from hilrunner.base.ring import Ring
from hilrunner.plant.step import PlantModel
from hilrunner.realtime.decode import CommandTable
from hilrunner.realtime.encode import MeasurementTable
from hilrunner.realtime.socketcan import Mailbox

# The constants of the loop, one record.
CONFIG = np.dtype(
    [
        ("period_ns", "i8"),
        ("overrun", "i8"),  # status.OVERRUN_*
        ("warm_up_ticks", "i8"),  # kept out of the statistics
        ("burst_frame_count", "i8"),  # from this many frames a tick on, a miss is blamed on them
        ("near_miss_ticks", "i8"),  # ticks after a miss that carry the mark
        ("consecutive_miss_max", "i8"),  # -1: not watched
        ("consecutive_miss_action", "i8"),  # ACTION_*
        ("total_miss_max", "i8"),
        ("total_miss_action", "i8"),
        ("lateness_ns_max", "i8"),
        ("lateness_action", "i8"),
        ("stall_ns_max", "i8"),  # longest time without a served period; -1: not watched
        ("stall_action", "i8"),
        ("stimulus_tick_count", "i8"),  # 0: commands come from the bus
        ("schedstat_fd", "i8"),
        ("record", "i8"),  # 1: fill the ring
        ("rehearse", "i8"),  # 1: rehearse each tick before its deadline, where there is room
        ("period_s", "f8"),
    ],
    align=True,
)
ACTION_WARN = 0
ACTION_FAIL_SAFE = 1
ACTION_STOP = 2
ACTION_FAIL = 3  # the run goes on, its verdict fails
ACTION_NAMES = ("warn", "fail-safe", "stop", "fail")

# Counters of one run; written by the loop only, never reset during a run.
PROGRESS = np.dtype(
    [
        ("tick", "i8"),  # the tick being worked on
        ("tick_count", "i8"),  # ticks that ran
        ("miss_count", "i8"),
        ("consecutive_miss_count", "i8"),
        ("skipped_count", "i8"),
        ("warned_count", "i8"),  # times a limit with action warn was broken
        ("frames_received", "i8"),
        ("frames_sent", "i8"),
        ("frames_unsent", "i8"),  # transmit queue full
        ("bus_errno", "i8"),  # errno that ended the run
        ("near_miss_left", "i8"),
        ("record_ns_before", "i8"),
        ("wake_mono_ns_before", "i8"),
        ("carried_ns", "i8"),  # how late this tick already was when the tick before had ended; 0: in time
        ("forced_fail_safe", "i8"),  # 1: a limit forced the fail-safe at the end of the last tick
        ("flags_seen", "i8"),  # OR of all state flags
        ("rehearsal_ns", "i8"),  # how long a rehearsal is expected to take; 0: none yet
        ("rehearsal_ns_min", "i8"),  # the shortest so far
        ("echo_real_ns", "i8"),  # receive stamp of the command this tick answers; 0: none
        ("inbox_head", "i8"),  # first frame of the inbox that no period has taken yet
        ("inbox_tail", "i8"),  # first free place of the inbox
        ("frames_end", "i8"),  # behind the last frame of the inbox that belongs to this tick (`late`)
        ("periods_due", "i8"),  # grid periods the step of this tick advances (`late`)
        ("served_mono_ns", "i8"),  # when the newest period was served
        ("emptied_mono_ns", "i8"),  # when the socket was last seen empty: what waits came later
        ("emptied_before_mono_ns", "i8"),  # the same as known before this tick: its frames came later
        ("placed_mono_ns", "i8"),  # when the newest frame that `late` has placed came
        ("clock_offset_ns", "i8"),  # CLOCK_REALTIME - CLOCK_MONOTONIC, as last seen
    ],
    align=True,
)

# The measured quantities of one axis, as encode names them, are float64[axis, QUANTITY_COUNT].


class Bench(NamedTuple):
    """One armed bench."""

    # constant after arming (arrays read-only where nothing below writes them)
    config: np.ndarray  # (1,) CONFIG
    plant: PlantModel
    command_table: CommandTable
    measurement_table: MeasurementTable
    wave: np.ndarray  # (axis, component, k) float64: heave components of plant.wave; zero components: no wave
    stimulus: np.ndarray  # (tick, axis) float64 valve commands; shape (1, axis) when unused
    # state: what the next period needs
    state: np.ndarray  # (axis, STATE_SIZE) float64, base.state_layout
    commands: np.ndarray  # (axis,) command.COMMAND_STATE
    last_counter: np.ndarray  # (command message,) int64: alive counter of the newest accepted frame; -1: none
    input: np.ndarray  # (axis, INPUT_COUNT) float64: newest accepted value of each role, decode.INPUT_*
    group_tick: np.ndarray  # (group,) int64: tick of the newest accepted frame of each part of a command; -1: none
    sent_counter: np.ndarray  # (measurement message,) int64: alive counter of the newest frame of each stream
    faults: np.ndarray  # (fault,) faults.FAULT
    progress: np.ndarray  # (1,) PROGRESS
    quantity: np.ndarray  # (axis, QUANTITY_COUNT) float64: what was measured in this period
    load_scale: np.ndarray  # (axis,) float64: factor on the static load in this period
    state_flags: np.ndarray  # (axis,) int64: status.FLAG_* of this period
    # scratch: meaningless between periods
    fresh: np.ndarray  # (axis,) decode.FRESH
    field_value: np.ndarray  # (field,) float64: what a frame carries, before it is taken
    plant_scratch: np.ndarray  # (SCRATCH_SIZE,) float64
    inbox: Mailbox
    outbox: Mailbox
    frame_axis: np.ndarray  # (inbox,) int64: axis of each received frame; 255: none
    frame_status: np.ndarray  # (inbox,) int64: status.FRAME_* of each received frame
    frame_period: np.ndarray  # (inbox,) int64: period in which each frame came, by its stamp (`late`)
    phase_ns: np.ndarray  # (PHASE_COUNT,) int64: durations of this tick
    rusage: np.ndarray  # (18,) int64: struct rusage
    schedstat_text: np.ndarray  # (64,) uint8
    usage_before: np.ndarray  # (USAGE_SIZE,) int64
    usage_after: np.ndarray  # (USAGE_SIZE,) int64
    clock: np.ndarray  # (CLOCK_WORD_COUNT,) int64
    # side door
    ring: Ring
