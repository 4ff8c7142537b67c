"""Allocate, check, compile, warm, freeze: a profile becomes a Bench whose every array is in place before tick 0."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilrunner.base import records, status
from hilrunner.base import ring as ring_layout
from hilrunner.base.errors import ProfileError
from hilrunner.base.histogram_scale import BUCKET_COUNT
from hilrunner.base.state_layout import STATE_SIZE
from hilrunner.base.units import NS_PER_MS, NS_PER_US
from hilrunner.plant.step import SCRATCH_SIZE, assemble
from hilrunner.realtime import command, decode, encode, faults
from hilrunner.realtime.clock import make_clock
from hilrunner.realtime.layout import ACTION_NAMES, CONFIG, PROGRESS, Bench
from hilrunner.realtime.miss import NO_SCHEDSTAT, make_usage_scratch
from hilrunner.realtime.socketcan import make_mailbox
from hilrunner.setup import axes as axis_setup
from hilrunner.setup.contract import dbc_path, sent_signal_names, signal_tables
from hilrunner.setup.fault_values import fault_value_si, threshold_si
from hilrunner.setup.load_faults import check_load_faults
from hilrunner.setup.profile import DeadlineLimit, Fault, LoadedProfile, StallLimit

INBOX_FRAMES = 1024  # most frames one tick takes; the rest waits in the socket
RING_SECONDS = 8  # how long the recorder may stand still before a tick is dropped
RING_TICKS_MIN = 16_384  # the periods of a stall of the host come at once: at 1 kHz those of 16 s find room
NEAR_MISS_TICKS = 10
BURST_FRAMES = 64


@dataclass
class Armed:
    """A bench ready to run, and what was learnt on the way."""

    bench: Bench
    loaded: LoadedProfile
    axes: axis_setup.AxisSet
    dbc_path: Path


def ring_shape(loaded: LoadedProfile, seconds: float | None = None) -> ring_layout.RingShape:
    """Sizes of the ring between loop and recorder for this profile; `seconds` in place of what a run takes."""
    ticks_per_s = 1_000_000 / loaded.profile.bench.period_us
    wanted = max(RING_SECONDS * ticks_per_s, RING_TICKS_MIN) if seconds is None else seconds * ticks_per_s
    ticks = _power_of_two(wanted)
    return ring_layout.RingShape(
        axis_count=len(loaded.profile.axis),
        tick_capacity=ticks,
        miss_capacity=4096,
        can_capacity=_power_of_two(max(16 * INBOX_FRAMES, 8 * ticks * len(loaded.profile.axis))),
        can_data_size=64 if loaded.profile.can.fd else 8,
        histogram_count=len(records.HISTOGRAM_NAMES),
        bucket_count=BUCKET_COUNT,
        sent_signal_count=len(sent_signal_names(loaded)),
    )


def local_ring(shape: ring_layout.RingShape) -> ring_layout.Ring:
    """A ring in this process' own memory: simulations, replays, tests, runs without a recorder."""
    ring = ring_layout.view(bytearray(ring_layout.size_bytes(shape)), shape)
    ring_layout.initialise(ring, shape)
    return ring


def arm(
    loaded: LoadedProfile,
    axes: axis_setup.AxisSet,
    ring: ring_layout.Ring,
    *,
    record: bool,
    stimulus: np.ndarray | None = None,
    spin_ns: int | None = None,
    overrun: str | None = None,
    schedstat_fd: int = NO_SCHEDSTAT,
) -> Armed:
    """Build the bench of a profile.

    Args:
        axes: from axes.build_axes. ring: from launch.create_ring or local_ring. record: fill the ring.
        stimulus: float64[tick, axis] valve commands instead of the bus.
        spin_ns, overrun: in place of the profile's.

    Raises:
        ProfileError, ModelError, DbcError, StateError: what the profile asks for cannot be built.
    """
    commands, measurements = signal_tables(loaded)
    axis_count = len(axes.plants)
    receiver = decode.new_receiver(commands, axis_count)
    rusage, schedstat_text, usage_before, usage_after = make_usage_scratch()
    bench = Bench(
        config=_config(loaded, stimulus, overrun, schedstat_fd, record),
        plant=_assembled(loaded, axes),
        command_table=commands,
        measurement_table=measurements,
        wave=_stack_waves(axes.waves),
        stimulus=np.zeros((1, axis_count)) if stimulus is None else np.ascontiguousarray(stimulus, np.float64),
        state=axes.initial_states.copy(),
        commands=np.concatenate([_command_rules(axis.command) for axis in loaded.profile.axis]),
        last_counter=receiver.last_counter,
        input=receiver.input,
        group_tick=receiver.group_tick,
        sent_counter=encode.send_counters(measurements),
        faults=_faults(loaded),
        progress=np.zeros(1, PROGRESS),
        quantity=encode.no_quantities(axis_count),
        load_scale=np.ones(axis_count),
        state_flags=np.zeros(axis_count, np.int64),
        fresh=receiver.fresh,
        field_value=receiver.field_value,
        plant_scratch=np.zeros(SCRATCH_SIZE),
        inbox=make_mailbox(INBOX_FRAMES),
        outbox=make_mailbox(max(1, measurements.message_count)),
        frame_axis=np.zeros(INBOX_FRAMES, np.int64),
        frame_status=np.zeros(INBOX_FRAMES, np.int64),
        frame_period=np.zeros(INBOX_FRAMES, np.int64),
        phase_ns=np.zeros(status.PHASE_COUNT, np.int64),
        rusage=rusage,
        schedstat_text=schedstat_text,
        usage_before=usage_before,
        usage_after=usage_after,
        clock=make_clock(loaded.profile.bench.spin_us * NS_PER_US if spin_ns is None else spin_ns),
        ring=ring,
    )
    return Armed(bench=bench, loaded=loaded, axes=axes, dbc_path=dbc_path(loaded))


def _assembled(loaded: LoadedProfile, axes: axis_setup.AxisSet):
    check_load_faults(loaded, axes.plants)
    try:
        return assemble(axes.plants, axis_setup.period_s(loaded))
    except ProfileError as error:
        raise ProfileError(f"{loaded.path}: {error.place}", error.problem, error.limit, error.remedy) from error


def arm_offline(loaded: LoadedProfile, engine: int, stimulus: np.ndarray | None = None) -> Armed:
    """A bench for `realtime.cycle.run_offline`: no recorder, no clock, no bus."""
    shape = ring_shape(loaded, seconds=0.01)._replace(tick_capacity=16, can_capacity=16, miss_capacity=16)
    return arm(loaded, axis_setup.build_axes(loaded, engine), local_ring(shape), record=False, stimulus=stimulus)


def _config(loaded: LoadedProfile, stimulus, overrun: str | None, schedstat_fd: int, record: bool) -> np.ndarray:
    profile = loaded.profile
    config = np.zeros(1, CONFIG)
    config["period_ns"] = axis_setup.period_ns(loaded)
    config["period_s"] = axis_setup.period_s(loaded)
    config["overrun"] = status.OVERRUN_NAMES.index(overrun or profile.bench.overrun)
    config["warm_up_ticks"] = profile.bench.warm_up_ticks
    config["burst_frame_count"] = BURST_FRAMES
    config["near_miss_ticks"] = NEAR_MISS_TICKS
    config["stimulus_tick_count"] = 0 if stimulus is None else len(stimulus)
    config["schedstat_fd"] = schedstat_fd
    config["record"] = int(record)
    config["rehearse"] = int(profile.bench.rehearse)
    for limit, limit_field, action_field, factor in (
        (profile.deadline.consecutive_misses, "consecutive_miss_max", "consecutive_miss_action", 1),
        (profile.deadline.total_misses, "total_miss_max", "total_miss_action", 1),
        (profile.deadline.lateness_us, "lateness_ns_max", "lateness_action", NS_PER_US),
    ):
        _set_limit(config, limit, limit_field, action_field, factor)
    stall = profile.deadline.stall_ms
    _set_limit(config, stall, "stall_ns_max", "stall_action", NS_PER_MS)
    return config


def _set_limit(
    config: np.ndarray, limit: DeadlineLimit | StallLimit | None, limit_field: str, action_field: str, factor: int
):
    config[limit_field] = -1 if limit is None else limit.max * factor
    config[action_field] = 0 if limit is None else ACTION_NAMES.index(limit.action)


def _command_rules(rules) -> np.ndarray:
    return command.make_command_state(
        round(rules.stale_after_ms * NS_PER_MS),
        round(rules.hold_for_ms * NS_PER_MS),
        round(rules.ramp_for_ms * NS_PER_MS),
    )


def _stack_waves(waves: list[np.ndarray]) -> np.ndarray:
    """Heave components of all axes in one array, padded with components of amplitude zero."""
    longest = max(len(wave) for wave in waves)
    stacked = np.zeros((len(waves), longest, waves[0].shape[1]))
    for index, wave in enumerate(waves):
        stacked[index, : len(wave)] = wave
    return stacked


def _faults(loaded: LoadedProfile) -> np.ndarray:
    table = np.zeros(len(loaded.profile.fault), faults.FAULT)
    names = [axis.name for axis in loaded.profile.axis]
    ticks_per_s = 1_000_000 / loaded.profile.bench.period_us
    for row, fault in zip(table, loaded.profile.fault, strict=True):
        _fill_fault(row, fault, names, ticks_per_s)
    return table


def _fill_fault(row: np.void, fault: Fault, names: list[str], ticks_per_s: float) -> None:
    row["kind"] = faults.FAULT_NAMES.index(fault.kind)
    row["axis"] = names.index(fault.axis)
    row["value"] = fault_value_si(fault)
    row["quantity"] = encode.QUANTITY_NAMES.index(fault.quantity) if fault.quantity else 0
    row["duration_ticks"] = round(fault.duration_s * ticks_per_s)
    row["active_from_tick"] = faults.NEVER
    if fault.when is None:
        row["start_tick"] = round(fault.at_s * ticks_per_s)
        return
    row["start_tick"] = faults.NEVER
    row["condition_quantity"] = encode.QUANTITY_NAMES.index(fault.when.quantity)
    row["condition_above"] = int(fault.when.above)
    row["condition_threshold"] = threshold_si(fault.when)


def _power_of_two(count: float) -> int:
    return 1 << max(4, int(np.ceil(np.log2(count))))


assert len(records.STATE_FIELDS) == STATE_SIZE
