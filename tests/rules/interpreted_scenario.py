"""A short run through every hot function, compiled or interpreted: interpreted_scenario.py FOLDER

The compiled run comes first and leaves its start (substeps and initial states, whose search would take minutes interpreted) in
FOLDER. With NUMBA_DISABLE_JIT=1 the decorators of base.compiled only note which functions are entered, and the foreign functions
of libc are called through ctypes. The numbers must be those of the compiled run.
"""

import ctypes
import dataclasses
import functools
import json
import os
import pickle
import socket
import sys
import time
from pathlib import Path

import numpy as np

from hilrunner.base import compiled

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
ENTERED: set[str] = set()


def _noted(function):
    key = f"{function.__module__}:{function.__qualname__.replace('<locals>.', '')}"

    @functools.wraps(function)
    def call(*arguments):
        ENTERED.add(key)
        return function(*arguments)

    return call


if INTERPRETED:  # before any hot function is defined
    compiled.hot = _noted
    compiled.inlined = _noted
    compiled.folded = _noted
    compiled.entry = _noted

from hilrunner.base import records, status  # noqa: E402
from hilrunner.plant import hydraulics, initial, line, rates_paper, residual, rk4, stability, step, wave  # noqa: E402
from hilrunner.realtime import clock, cycle, loop, miss, rehearsal, socketcan, waiting  # noqa: E402
from hilrunner.record import crosscheck  # noqa: E402
from hilrunner.setup import arm as arming  # noqa: E402
from hilrunner.setup import axes as axis_setup  # noqa: E402
from hilrunner.setup.profile import load_profile  # noqa: E402
from tests.rules.virtual_scenario import virtually  # noqa: E402
from tests.rules.wire_scenario import wire_forms  # noqa: E402

PROFILE = """
name = "every-function"

[bench]
period_us = 200
overrun = "catch-up"
warm_up_ticks = 2

[deadline]
total_misses = { max = 0, action = "fail-safe" }

[[axis]]
name = "boom"
circuit = "lift"
[axis.load]
kind = "knuckle-boom"
equivalent_mass = true
[axis.wave]
significant_height_m = 1.0
peak_period_s = 7.0

[[axis]]
name = "lines"
circuit = "lift-lines"
[axis.load]
kind = "constant"
force_kn = 400.0

[[axis]]
name = "article"
circuit = "paper"
preset = "paper"
initial_position_mm = 300.0

[[axis]]
name = "simple"
circuit = "lift"
reference = "fast"
"""
PERIOD_S = 2e-4  # as in the profile above: fewer RK4 steps a period than at 1 ms, and the same functions
FAULTS = "".join(
    f'\n[[fault]]\nkind = "{kind}"\naxis = "{axis}"\nat_s = {tick * PERIOD_S}\nduration_s = {3 * PERIOD_S}\nvalue = {value}\n{more}'
    for kind, axis, tick, value, more in (
        ("valve-stuck", "lines", 4, 0.3, ""),
        ("valve-gain", "boom", 1, 0.5, ""),
        ("load-factor", "boom", 2, 1.1, ""),
        ("sensor-offset", "boom", 1, 1e5, 'quantity = "chamber_1_pressure"\n'),
        ("sensor-gain", "lines", 1, 1.1, 'quantity = "rod_position"\n'),
        ("sensor-stuck", "article", 2, 0.0, 'quantity = "rod_velocity"\n'),
        ("measurement-lost", "simple", 3, 0.0, ""),
        ("measurement-bad-crc", "boom", 4, 0.0, ""),
        ("command-lost", "boom", 5, 0.0, ""),
    )
)
TICKS = 8
SURROGATE_PROFILES = ("amc-lift", "paper")


def use_libc_through_ctypes():
    """Give the interpreted edges what the compiled ones link to."""
    libc = ctypes.CDLL(None)
    libc.__errno_location.restype = ctypes.POINTER(ctypes.c_int32)

    def foreign(name):
        function = getattr(libc, name)
        return lambda *words: function(*(word if hasattr(word, "_as_parameter_") else int(word) for word in words))

    clock._clock_gettime, clock._clock_nanosleep = foreign("clock_gettime"), foreign("clock_nanosleep")
    socketcan._recvmmsg, socketcan._sendmmsg = foreign("recvmmsg"), foreign("sendmmsg")
    socketcan._errno_location = libc.__errno_location


def command_frame(axis, counter, valve, control=status.CONTROL_ACTIVE):
    """`struct can_frame` of a valid VALVE_COMMAND, by cantools and autosar-e2e."""
    from tests.tools import contract

    message = contract.database().get_message_by_name(f"VALVE_COMMAND_{axis + 1}")
    values = {
        "crc8": 0,
        "alive_counter": counter,
        "control": control,
        "valve_setpoint": 100 * valve,
        "timestamp_us": 77,
    }
    data = contract.protected(message.name, message.encode(values, strict=False))
    return np.frombuffer(message.frame_id.to_bytes(4, "little") + bytes([len(data), 0, 0, 0]) + bytes(data), np.uint8)


def traffic():
    """Frames of a few ticks: good ones, and one of every kind that is refused."""
    good = [command_frame(axis, 0, 0.4) for axis in range(4)]
    bad_crc, remote, error, unknown, own, short, control = (command_frame(0, 1, 0.2).copy() for _ in range(7))
    bad_crc[8] ^= 0xFF
    remote[3] |= 0x40
    error[3] |= 0x20
    unknown[0] ^= 0x0F
    own[:2] = 0x81, 0x02  # a measurement, as only this bench sends it
    short[4] = 5
    control = command_frame(0, 1, 0.2, control=9)
    jump = command_frame(1, 9, 0.2)
    again = command_frame(2, 0, 0.2)
    return [good, [bad_crc, remote, error, unknown, own, short, control], [jump, again], [command_frame(0, 1, -0.5)]]


def offline(armed, out, name):
    """run_offline with frames tick by tick."""
    lost = [command_frame(0, 2, 0.3)]  # while the fault keeps commands from this axis
    batches = [*traffic(), [], [], lost, *[[]] * (TICKS - 7)]  # a fault begins after the frames of its tick were read
    frames = [frame for batch in batches for frame in batch]
    box = np.zeros((len(frames), socketcan.FRAME_SIZE_FD), np.uint8)
    for row, frame in zip(box, frames, strict=True):
        row[:16] = frame
    first = np.concatenate([[0], np.cumsum([len(batch) for batch in batches])]).astype(np.int64)
    axis_count = len(armed.axes.plants)
    command_out = np.zeros((TICKS, axis_count), records.COMMAND)
    state_out = np.zeros((TICKS, axis_count), records.STATE)
    forced = np.zeros(TICKS, np.int64)
    forced[6] = 1
    ran = cycle.run_offline(
        armed.bench, np.arange(TICKS), np.ones(TICKS, np.int64), np.zeros(TICKS, np.int64), forced, box,
        np.full(len(frames), 16, np.int64), first, command_out, state_out,
    )  # fmt: skip
    assert armed.bench.ring.frame_count[axis_count, status.FRAME_OWN_ID] == 1
    out[f"{name} ticks"] = np.array([ran])
    for field in records.STATE.names[2:]:
        out[f"{name} state {field}"] = state_out[field]
    for field in records.COMMAND.names[2:]:
        out[f"{name} command {field}"] = command_out[field]
    out[f"{name} frames"] = armed.bench.ring.frame_count.copy()
    out[f"{name} sent"] = armed.bench.outbox.frame.copy()


def in_time(loaded, axes, out):
    """run_loop over a socketpair, every tick run (catch-up), all frames waiting at tick 0."""
    ring = arming.local_ring(arming.ring_shape(loaded, seconds=0.01)._replace(tick_capacity=4, can_capacity=4))
    bench_end, peer = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    bench_end.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS
    for frame in [frame for batch in traffic() for frame in batch]:
        peer.send(frame.tobytes())
    with open("/proc/thread-self/schedstat") as schedstat:
        armed = arming.arm(loaded, axes, ring, record=True, spin_ns=20_000, schedstat_fd=schedstat.fileno())
        if (
            INTERPRETED
        ):  # no time for it below; compiled it lives in the loop, and alone it would be compiled anew each time
            waiting._rehearse_timed(armed.bench, rehearsal.rehearsal_of(armed.bench), bench_end.fileno(), 0)
        start_mono_ns = time.monotonic_ns() + 3_000_000
        reason = loop.run_loop(armed.bench, bench_end.fileno(), start_mono_ns, 4)
    out["loop reason"] = np.array([reason])
    out["loop state"] = armed.bench.state.copy()
    out["loop frames"] = ring.frame_count.copy()
    peer.close()
    bench_end.close()


def late(loaded, axes, out):
    """run_loop that begins after its own end: all periods but the last are skipped ones, and more frames wait than the inbox takes."""
    ring = arming.local_ring(arming.ring_shape(loaded, seconds=0.01))
    bench_end, peer = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    bench_end.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS
    for frame in [frame for batch in traffic() for frame in batch]:
        peer.send(frame.tobytes())
    armed = arming.arm(loaded, axes, ring, record=True, overrun="skip")
    bench = armed.bench._replace(inbox=socketcan.make_mailbox(4))
    start_mono_ns = time.monotonic_ns() + 1_000_000
    time.sleep(0.02)
    out["late reason"] = np.array([loop.run_loop(bench, bench_end.fileno(), start_mono_ns, 4)])
    out["late state"] = bench.state.copy()
    out["late frames"] = ring.frame_count.copy()
    out["late rows"] = ring.tick["tick"][:4].copy()
    out["late frames of rows"] = ring.tick["frames_received"][:4].copy()
    peer.close()
    bench_end.close()


def single_functions(out):
    """What the runs above do not reach: series, searches, rates."""
    failing = clock.make_clock(0)
    clock.sleep_until(failing, -3_000_000_000)  # before all time: the kernel refuses
    out["failed sleep"] = failing[clock.WORD_FAILURE :].copy()
    clock.wait_until(clock.make_clock(20_000), time.monotonic_ns() + 100_000)
    components = wave.heave_components(1.0, 7.0, 1)
    out["heave"] = np.array(wave.heave_series(components, np.linspace(0.0, 5.0, 7)))
    out["reference motion"] = np.array(wave.reference_motion(components, 1.0, 0.6, 2.0))


def starts_and_rates(plants, out):
    """An initial state and the rates there, of every circuit."""
    for name, plant in zip(("lift", "lines", "article", "simple"), plants, strict=True):
        for valve in (0.0, 0.3):
            state = initial.initial_state(plant, 0.5, valve)
            out[f"start {name} {valve}"] = state
            rates = np.zeros((1, len(state)))
            fast = stability.spools_have_no_mass(plant)
            load = plant.load.record()
            stability.state_rates(plant.parameters, load, 1.0, plant.circuit, fast, valve, state[None, :].copy(), rates)
            out[f"rates {name} {valve}"] = rates


def equations(plants, states):
    """The DAE residuals, interpreted only (compiled they live in the solver): zero where a state is consistent."""
    for plant, state in zip(plants, states, strict=True):
        record = np.zeros(1, residual.PLANT_INPUT)[0]
        record["valve_command"], record["load_scale"], record["circuit"] = 0.3, 1.0, plant.circuit
        record["parameters"], record["load"] = plant.parameters[0], plant.load.record()[0]
        y = state[list(residual.UNKNOWNS[plant.circuit])].copy()
        dy, r = np.zeros_like(y), np.ones_like(y)
        residual.make_consistent(record, y, dy)
        residual.residual(record, y, dy, r)
        assert np.all(np.abs(r) < 1e-3 * np.maximum(1.0, np.abs(dy).max())), (plant.circuit, r)


def side_branches(plants):
    """Functions of offline users and rare branches, interpreted only: each with a truth that needs no second computation."""
    article = plants[2]
    uniform = rk4.make_rk4(lambda _, y, lines: ((y[1], 0.0, 0.0, 0.0), lines), 4)  # x' = v, v' = 0, no bounds to keep
    moved, _ = uniform(0, (0.0, 1.0, 0.0, 0.0), 0, 0.5, 2)
    np.testing.assert_allclose(moved, (1.0, 1.0, 0.0, 0.0), 1e-14)
    prm, load = article.parameters[0], article.load.record()[0]
    assert [hydraulics.check_opening(drop, 1e5, 1e5) for drop in (0.0, 2e5)] == [0.0, 1.0]
    _, supply_flow, _ = line.solve_supply_line(0, prm, 5e6, 0.0, prm["valve_pa_si"], 6e6)
    _, return_flow, _ = line.solve_return_line(0, prm, 5e6, prm["cbv_si"], prm["valve_bt_si"], 4e6)
    assert supply_flow > 0.0 > return_flow
    (speed, *_), _ = rates_paper.quasi_static_paper_rates((prm, load, 1.0, 0.3), (0.5, 0.01, 9e6, 1e6), (0.0, 0.0, 0))
    assert speed == 0.01
    before, after = np.zeros(miss.USAGE_SIZE, np.int64), np.zeros(miss.USAGE_SIZE, np.int64)
    after[miss.USAGE_FAULTS_MAJOR] = 1
    phases = np.full(status.PHASE_COUNT, 5_000_000, np.int64)
    _, cause = miss.suspect_cause(0, 0, phases, before, after, 0, 64, True, False)
    assert cause == status.CAUSE_PAGE_FAULT
    assert wave.load_scale_series(wave.no_heave(), np.zeros(2)).tolist() == [1.0, 1.0]


def stepped(plants, states, out, name):
    """A few periods of every axis by the offline entry point."""
    model = step.assemble(plants, PERIOD_S)
    count = 3
    for axis in range(len(plants)):
        rows, flags, scratch = (
            np.zeros((count, states.shape[1])),
            np.zeros(count, np.int64),
            np.zeros(step.SCRATCH_SIZE),
        )
        step.advance_many(
            model, axis, np.full(count, 0.2), np.ones(count), PERIOD_S, states[axis].copy(), scratch, rows, flags
        )
        out[f"{name} {axis}"] = rows
    return model, out[f"{name} 0"]


def in_vacuum(plants, states, out):
    """Periods that start with a chamber below the pressure where a void opens in the oil."""
    empty = states[:1].copy()
    empty[0, 2] = -9.5e4
    assert empty[0, 2] < plants[0].parameters[0]["cavitation_pressure_pa"]
    stepped(plants[:1], empty, out, "vacuum")


def networks_alone(loaded, axes):
    """A bench whose surrogate hands no period over: in so short a run every period but a few would be."""
    plants = [dataclasses.replace(plant, exact_substep_count=0) for plant in axes.plants]
    return arm_offline(loaded, dataclasses.replace(axes, plants=plants))


def checked(plants, states, out):
    """Exact and fast reference, and the recorder's comparison, over a few periods."""
    stepped([dataclasses.replace(plant, fast=True) for plant in plants], states, out, "fast")
    model, rows = stepped(plants, states, out, "exact")
    count = len(rows)
    logged, command = np.zeros(count, records.STATE), np.zeros(count, records.COMMAND)
    for field, column in zip(records.STATE_FIELDS[:10], range(10), strict=False):
        logged[field] = rows[:, column]
    logged["tick"] = (0, 1, 4)  # the jump restarts the reference
    logged["load_scale"] = 1.0
    command["valve_command"] = 0.25
    walk, check = crosscheck.new_walk(states[0]), np.zeros(count, records.CHECK)
    limits = np.full(crosscheck.ROW_COUNT, 1e-9)
    skipped = np.zeros(count, np.int64)
    crosscheck.check_periods(model, 0, PERIOD_S, skipped, command, logged, walk, limits, 1, np.zeros(0), check)
    for field in records.CHECK.names[2:]:
        out[f"check {field}"] = check[field]
    walk, known = crosscheck.new_walk(states[0]), np.zeros(count, records.CHECK)
    skipped[2] = 2
    stimulus = np.full(4, 0.25)  # the last one is held
    crosscheck.check_periods(model, 0, PERIOD_S, skipped, command, logged, walk, limits, 1, stimulus, known)
    out["check with a stimulus"] = known["chamber_1_pressure_error_pa"]


def axis_sets(folder):
    """Plants and starts of every run; made by the compiled run, taken over by the interpreted one."""
    path, kept = folder / "every-function.toml", folder / "axis_sets.pickle"
    path.write_text(PROFILE + FAULTS)
    runs = {"reference": (load_profile(str(path)), status.ENGINE_REFERENCE)}
    for profile in SURROGATE_PROFILES:
        for engine in (status.ENGINE_SURROGATE, status.ENGINE_ONNX):
            runs[f"{profile} {status.ENGINE_NAMES[engine]}"] = (load_profile(profile), engine)
    if not INTERPRETED:
        made = {name: axis_setup.build_axes(*run) for name, run in runs.items()}
        starts = {name: ([p.substep_count for p in axes.plants], axes.initial_states) for name, axes in made.items()}
        kept.write_bytes(pickle.dumps(starts))
        return {name: (loaded, made[name]) for name, (loaded, _) in runs.items()}
    starts = pickle.loads(kept.read_bytes())
    return {name: (loaded, taken_over(loaded, engine, *starts[name])) for name, (loaded, engine) in runs.items()}


def taken_over(loaded, engine, substep_counts, states):
    """Axes built here, without the two searches."""
    counts = iter(substep_counts)
    axis_setup._substeps = lambda *_: next(counts)
    axis_setup.initial_states = lambda *_: states.copy()
    return axis_setup.build_axes(loaded, engine)


def arm_offline(loaded, axes):
    """A bench without clock and bus."""
    shape = arming.ring_shape(loaded, seconds=0.01)._replace(tick_capacity=16, can_capacity=16, miss_capacity=16)
    return arming.arm(loaded, axes, arming.local_ring(shape), record=False)


def main():
    """All of it."""
    folder = Path(sys.argv[1])
    if INTERPRETED:
        use_libc_through_ctypes()
    out = {}
    runs = axis_sets(folder)
    for name, (loaded, axes) in runs.items():
        offline(arm_offline(loaded, axes), out, name)
        if name.endswith(status.ENGINE_NAMES[status.ENGINE_SURROGATE]):
            offline(networks_alone(loaded, axes), out, f"{name} alone")
    loaded, axes = runs["reference"]
    in_time(loaded, axes, out)
    late(loaded, axes, out)
    starts_and_rates(axes.plants, out)
    checked(axes.plants, axes.initial_states, out)
    in_vacuum(axes.plants, axes.initial_states, out)
    if INTERPRETED:
        equations(axes.plants, axes.initial_states)
        side_branches(axes.plants)
    single_functions(out)
    wire_forms(out)
    virtually(loaded, axes, command_frame(0, 1, 0.4), out)
    np.savez(folder / ("interpreted.npz" if INTERPRETED else "compiled.npz"), **out)
    (folder / "entered.json").write_text(json.dumps(sorted(ENTERED)))


if __name__ == "__main__":
    main()
