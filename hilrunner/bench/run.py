"""The parts of `hilrunner bench`, in order; each yields its tables as they are done."""

import argparse
import contextlib
import os
from collections.abc import Iterator

from hilrunner.base import status
from hilrunner.bench import capacity, compare, disturb, log_rate, network_pass, plant_step
from hilrunner.bench.results import Table
from hilrunner.bench.tick import TickBench, choose_place, say
from hilrunner.plant.step import AxisPlant
from hilrunner.setup import host
from hilrunner.setup.axes import engine_named, make_axis_plants
from hilrunner.setup.profile import load_profile

STEP_PROFILES = {"paper": "paper", "lift": "amc-lift"}
_STEP_SLICE_S_MAX = 0.2


def host_part(arguments: argparse.Namespace) -> dict:
    """The host's findings, wake-ups tried with the rights a run would ask for."""
    place = choose_place(arguments.cpu, arguments.priority)
    grants = host.enter_realtime(host.RealtimeOptions(priority=place.priority, cpu=place.cpu))
    try:
        report = host.inspect_host(cpu=place.cpu, probe_s=0.5)
    finally:
        host.leave_realtime(grants)
    label = host.mode_label(grants, report.findings)
    return {"label": label, "grants": [grant.as_dict() for grant in grants], **report.as_dict()}


def host_text(report: dict) -> str:
    """Two lines on the machine, one a finding that is not ok."""
    facts = report["facts"]
    lines = [
        f"{facts['processor']}, {facts['cores']} cores, Linux {facts['kernel']}; python {facts['python']}, "
        f"numpy {facts['numpy']}, numba {facts['numba']}",
        f"a run here is: {report['label']}",
    ]
    lines += [
        f"  {one['verdict']}: {one['name']}: {one['value']}" for one in report["findings"] if one["verdict"] != "ok"
    ]
    refused = [f"  refused: {one['name']}: {one['reason']}" for one in report["grants"] if not one["granted"]]
    return "\n".join(lines + refused) + "\n"


def _axis(profile: str, engine: int) -> AxisPlant:
    return make_axis_plants(load_profile(profile), engine)[0]


@contextlib.contextmanager
def _on_core(cpu: int) -> Iterator[None]:
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {cpu})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def step_part(arguments: argparse.Namespace) -> Iterator[Table]:
    """Network pass, RK4 step, and the cost of 1 ms by engine and circuit."""
    place = choose_place(arguments.cpu, arguments.priority)
    slice_s = min(_STEP_SLICE_S_MAX, arguments.slice_s)
    with _on_core(place.cpu):
        say("trained models")
        plants = {name: _axis(profile, status.ENGINE_SURROGATE) for name, profile in STEP_PROFILES.items()}
        for name, plant in plants.items():
            for role in plant.networks.networks:
                say(f"one pass, {name} {role}")
                yield network_pass.pass_table(name, plant.networks, role, arguments.rounds, slice_s)
        yield plant_step.rk4_step_table(plants, arguments.rounds, slice_s)
        for name, plant in plants.items():
            say(f"1 ms of the plant, {name}")
            onnx_plant = _axis(STEP_PROFILES[name], status.ENGINE_ONNX)
            yield plant_step.cost_table(name, plant, onnx_plant, arguments.rounds, slice_s)
        lines = plant_step.lines_plant(plants["lift"])
        yield plant_step.cost_table("lift-lines", lines, None, arguments.rounds, slice_s)


def loop_part(arguments: argparse.Namespace) -> Iterator[Table]:
    """The tick against cyclictest, and its phases."""
    place = choose_place(arguments.cpu, arguments.priority)
    say("tick against cyclictest")
    with TickBench(place, arguments.profile, engine=_engine(arguments)) as bench:
        yield from compare.compare(bench, arguments.rounds, arguments.slice_s, arguments.spin_us * 1000)


def capacity_part(arguments: argparse.Namespace) -> Iterator[Table]:
    """Most axes, shortest period."""
    place = choose_place(arguments.cpu, arguments.priority)
    engine = _engine(arguments)
    yield capacity.most_axes(place, arguments.profile, engine, min(arguments.slice_s, 2.0))
    yield capacity.shortest_period(place, arguments.profile, engine, arguments.slice_s)


def log_part(arguments: argparse.Namespace) -> Iterator[Table]:
    """10 kHz into the log."""
    say(f"log at 10 kHz for {arguments.log_s:g} s")
    place = choose_place(arguments.cpu, arguments.priority)
    yield log_rate.log_rate(place, arguments.profile, _engine(arguments), arguments.log_s)


def disturb_part(arguments: argparse.Namespace) -> Iterator[Table]:
    """The tick against cyclictest beside a busy interpreter, collector and writer."""
    place = choose_place(arguments.cpu, arguments.priority)
    with TickBench(place, arguments.profile, engine=_engine(arguments)) as bench:
        yield disturb.disturb_table(bench, arguments.rounds, arguments.slice_s)


def _engine(arguments: argparse.Namespace) -> int:
    return engine_named(load_profile(arguments.profile), arguments.engine)


PARTS = {"step": step_part, "loop": loop_part, "capacity": capacity_part, "log": log_part, "disturb": disturb_part}
