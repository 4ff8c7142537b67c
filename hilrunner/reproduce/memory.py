"""Resident memory of a process that runs one engine, beside the article's Table 7; and what the models themselves weigh.

As a process of its own (`python -m hilrunner.reproduce.memory`): JSON request on stdin, bytes on stdout.
"""

import json
import sys
from pathlib import Path

from hilrunner.reproduce.rows import Detail, Part, Row

ENGINES = ("none", "reference", "surrogate", "ida")
_WORDS = {
    "reference": "first-principle model, compiled, RK4",
    "surrogate": "surrogate, compiled, RK4",
    "ida": "full DAE by IDA, compiled residual",
}
_PERIODS = 1000
_BYTES_PER_MB = 1e6
_BYTES_PER_KIB = 1024


def memory_part(models, quick: bool) -> Part:
    """Sizes of processes that load and run one engine of circuit lift for a second, and of the models."""
    from hilrunner.reproduce import article
    from hilrunner.reproduce.models import LIFT_FLOW, PAPER_FLOW, PAPER_RATES, reference_of
    from hilrunner.reproduce.timing import ask_process

    part = Part("memory", "Memory (Table 7)")
    path = str(models.path(LIFT_FLOW))
    found = {engine: ask_process("hilrunner.reproduce.memory", {"engine": engine, "model": path}) for engine in ENGINES}
    paper = {"reference": article.FIRST_PRINCIPLE_MB, "surrogate": article.SURROGATE_MB}
    empty_mb = found["none"]["resident_bytes"] / _BYTES_PER_MB
    rows = []
    for engine, words in _WORDS.items():
        total_mb = found[engine]["resident_bytes"] / _BYTES_PER_MB
        label = f"largest resident size of a process that runs circuit lift for 1 s; {empty_mb:.0f} MB of it without an engine"
        key, source = f"memory.process.{engine}", "Table 7" if engine in paper else ""
        what = f"process with: {words}"
        part.rows.append(Row(key, what, total_mb, "MB", label, paper.get(engine), source, timing=True))
        rows.append((words, total_mb, total_mb - empty_mb, found[engine]["state_bytes"]))
    part.details.append(
        Detail("Processes", ("engine", "MB", "MB over a process without", "bytes the engine reads in a period"), rows)
    )
    part.details.append(
        _files(models, {LIFT_FLOW: "amc-lift", PAPER_FLOW: "paper", PAPER_RATES: "paper"}, reference_of)
    )
    part.notes.append(
        "a process is mostly interpreter and libraries (reading ONNX alone brings protobuf), so a difference of two process sizes, the "
        "article's 128.26 MB, says nothing about a model: the network is a few kilobytes"
    )
    return part


def _files(models, files: dict[str, str], reference_of) -> Detail:
    from hilrunner.plant.network import assemble_bank

    rows = []
    for file, profile in files.items():
        networks = models.networks(file, reference_of(profile))
        packed = assemble_bank([networks]).words.nbytes
        numbers = sum(one.parameter_count for one in networks.networks.values())
        rows.append((file, numbers, 8 * numbers, packed, models.path(file).stat().st_size))
    return Detail(
        "Models", ("file", "parameters", "bytes of them", "bytes packed for the kernel", "bytes of the file"), rows
    )


def measure(request: dict) -> dict[str, int]:
    """Load and run one engine of circuit lift for a second; bytes."""
    import numpy as np

    from hilrunner.plant.ida import solve_ida
    from hilrunner.plant.step import assemble, initial_state
    from hilrunner.reproduce.cases import Case
    from hilrunner.reproduce.compare import run_engine
    from hilrunner.reproduce.models import LIFT_FLOW, PERIOD_S, Models, reference_of

    engine, state_bytes = request["engine"], 0
    if engine != "none":
        reference = reference_of("amc-lift")
        held = np.full(_PERIODS, 0.5)
        case = Case("memory", "", reference, held, np.ones(_PERIODS), initial_state(reference, 0.6))
        plant = reference
        if engine == "surrogate":
            plant = Models(Path(request["model"]).parent).surrogate(LIFT_FLOW, reference)
        if engine == "ida":
            solve_ida(reference, held, case.load_scales, PERIOD_S, case.start)
        else:
            run_engine(plant, case)
        model = assemble([plant], PERIOD_S)
        state_bytes = sum(array.nbytes for array in model[:-1]) + model.network.words.nbytes + case.start.nbytes
    return {"resident_bytes": largest_resident_bytes(), "state_bytes": state_bytes}


def largest_resident_bytes() -> int:
    """The most this program has held; not getrusage, which keeps what its parent held before it became this program."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * _BYTES_PER_KIB
    raise OSError("/proc/self/status has no VmHWM")


if __name__ == "__main__":
    print(json.dumps(measure(json.load(sys.stdin))))
