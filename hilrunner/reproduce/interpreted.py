"""A process of its own: 1 ms of a circuit by each engine without any compilation. JSON request on stdin, seconds on stdout."""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

_SHARES = 5  # the periods are timed in so many slices; the median is told


def measure(request: dict) -> dict[str, float]:
    """Seconds of one period by engine, and how far cold Newton's states are from the warm ones; the start, whose search would take minutes interpreted, comes with the request."""
    import numba

    from hilrunner.base import status
    from hilrunner.bench.cold_newton import cold_newton_states
    from hilrunner.plant.load import knuckle_boom
    from hilrunner.plant.parameters import make_parameters
    from hilrunner.plant.step import SCRATCH_SIZE, AxisPlant, advance_many, assemble
    from hilrunner.setup.model import load_model

    if not numba.config.DISABLE_JIT:
        raise SystemExit("this process measures interpreted code: start it with NUMBA_DISABLE_JIT=1")
    name = request["circuit"]
    parameters = make_parameters(name)
    circuit = status.CIRCUIT_NAMES.index(name)
    reference = AxisPlant(circuit, parameters, knuckle_boom(), substep_count=request["reference_substeps"])
    networks, _ = load_model(Path(request["model"]), name, parameters)
    surrogate = replace(
        reference, engine=status.ENGINE_SURROGATE, networks=networks, substep_count=request["surrogate_substeps"]
    )
    start = np.array(request["start"])
    count = max(1, request["periods"] // _SHARES)
    held = np.full(count, request["command"])

    def advancing(plant: AxisPlant):
        model, scratch = assemble([plant], 1e-3), np.zeros(SCRATCH_SIZE)
        states, flags = np.zeros((count, 10)), np.zeros(count, np.int64)

        def run() -> np.ndarray:
            advance_many(model, 0, held, np.ones(count), 1e-3, start.copy(), scratch, states, flags)
            return states

        return run

    cold = assemble([reference], 1e-3)
    engines = {
        "surrogate": advancing(surrogate),
        "reference": advancing(reference),
        "cold_newton": lambda: cold_newton_states(cold, held, 1e-3, start),
    }
    times: dict[str, list[float]] = {key: [] for key in engines}
    for _ in range(_SHARES):
        for key, run in engines.items():
            begin_s = time.perf_counter()
            run()
            times[key].append((time.perf_counter() - begin_s) / count)
    found = {f"{key}_s": float(np.median(values)) for key, values in times.items()}
    warm, fresh = engines["reference"](), engines["cold_newton"]()
    size = np.abs(warm[:, :4]).max(axis=0)
    return found | {"cold_newton_difference": float((np.abs(fresh - warm)[:, :4] / size).max())}


if __name__ == "__main__":
    print(json.dumps(measure(json.load(sys.stdin))))
