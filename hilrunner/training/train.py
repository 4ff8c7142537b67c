"""From a recipe to a model file: sample, train in stages, test, export, data sheet."""

import json
import platform
import threading
import time
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from hilrunner import __version__
from hilrunner.training import bayesian, checkpoint
from hilrunner.training.bayesian import Limits, Progress
from hilrunner.training.dataset import Data, Samples, Scaling, make_samples, scaling_of
from hilrunner.training.export import Trained
from hilrunner.training.mlp import Shape
from hilrunner.training.problem import Problem, Quantity
from hilrunner.training.sampling import splits

IN_MEMORY_ROWS = 2_000_000  # above it points are read from disk chunk by chunk


@dataclass(frozen=True)
class Stage:
    """So many of the training points, so many iterations; few points first, because an iteration costs points."""

    points: int
    iterations: int


STAGES = (Stage(1_500, 300), Stage(6_000, 120), Stage(20_000, 30))


@dataclass(frozen=True)
class Plan:
    """Everything that decides the result of a training; equal plans give equal networks on equal machines."""

    train_points: int = 20_000
    validation_points: int = 20_000
    test_points: int = 100_000
    stages: tuple[Stage, ...] = STAGES
    seed: int = 1
    validation_failures: int = bayesian.VALIDATION_FAILURES_MAX
    seconds: float = float("inf")  # a network; the clock makes a result irreproducible, so none by default
    device: str = "cpu"


@dataclass(frozen=True)
class Outcome:
    """One trained network with what its data sheet says."""

    network: Trained
    facts: dict
    curves: list[dict]


Report = Callable[[str, str, float], None]  # role, what, share done 0..1


def train_problem(problem: Problem, plan: Plan, folder: Path, resume: bool, report: Report) -> Outcome:
    """Sample, train and test one network; checkpoints and samples stay in `folder`/<role>."""
    place = folder / problem.role
    started = time.monotonic()
    samples = make_samples(
        problem,
        place / "samples",
        splits(plan.train_points, plan.validation_points, plan.test_points),
        plan.seed,
        report=lambda done, total: report(problem.role, f"{done} of {total} points", done / total),
    )
    sampled_s = time.monotonic() - started
    head_inputs, head_targets = samples.load("train", IN_MEMORY_ROWS)
    scaling = scaling_of(problem, head_targets)
    shape = Shape((len(problem.inputs), *problem.layers, len(problem.outputs)))
    validation = Data(scaling, samples.load("validation", IN_MEMORY_ROWS))
    progress, first = checkpoint.read(place, plan, problem) if resume else (None, 0)
    progress = progress or Progress(shape.start(plan.seed, plan.device))
    for index, stage in enumerate(plan.stages):
        if index < first:
            continue
        data = _stage_data(samples, scaling, stage.points, (head_inputs, head_targets))
        progress = _run_stage(shape, data, validation, progress, plan, index, place, problem, report)
    network = _network(problem, shape, progress, scaling)
    facts = _facts(problem, plan, samples, shape, progress, network, scaling)
    facts["sampling_s"] = sampled_s
    return Outcome(network, facts, progress.curves)


def _stage_data(samples: Samples, scaling: Scaling, points: int, head) -> Data:
    if points <= len(head[0]):
        return Data(scaling, (head[0][:points], head[1][:points]))
    return Data(scaling, files=samples.files("train"))


def _run_stage(shape, data, validation, progress, plan, index, place, problem, report) -> Progress:
    stage = plan.stages[index]
    before = progress.iteration
    progress.reason = ""
    progress.failures = 0
    progress.damping = max(progress.damping, 1e-9)
    limits = Limits(
        iterations=before + stage.iterations,
        seconds=plan.seconds,
        validation_failures=plan.validation_failures,
    )
    saved = time.monotonic()

    def after(now: Progress) -> None:
        nonlocal saved
        share = (now.iteration - before) / stage.iterations
        rms = now.best_validation**0.5
        report(problem.role, f"stage {index + 1}, iteration {now.iteration}, validation RMS {rms:.2e}", share)
        if now.reason or time.monotonic() - saved > 10.0:
            # a finished stage is stored as the next one's start
            done = bool(now.reason)
            checkpoint.write(place, plan, problem, now, index + 1 if done else index)
            saved = time.monotonic()

    return bayesian.train(shape, data, validation, progress, limits, after)


def _network(problem: Problem, shape: Shape, progress: Progress, scaling: Scaling) -> Trained:
    layers = [(w.cpu().numpy().copy(), b.cpu().numpy().copy()) for w, b in shape.unpack(progress.best_parameters)]
    outputs = tuple(
        replace(quantity, low=float(low), high=float(high))
        for quantity, low, high in zip(problem.outputs, scaling.target_low, scaling.target_high, strict=True)
    )
    return Trained(
        problem.role,
        problem.inputs,
        outputs,
        tuple(w for w, _ in layers),
        tuple(b for _, b in layers),
        scaling.target_low,
        scaling.target_high,
    )


def test_errors(shape: Shape, parameters, samples: Samples, scaling: Scaling) -> dict:
    """Errors on the test split, chunk by chunk: root mean square and largest in SI, and normalised mean squares.

    The normalised figure is the article's: mean square of targets mapped to -1..1. Beside it stands what the best constant
    would reach, without which it says nothing.
    """
    outputs = len(scaling.target_low)
    half = 0.5 * (scaling.target_high - scaling.target_low)
    square, largest, count = np.zeros(outputs), np.zeros(outputs), 0
    total, total_square = np.zeros(outputs), np.zeros(outputs)
    for path in samples.files("test"):
        table = np.load(path, mmap_mode="r")
        for first in range(0, len(table), 65536):
            part = np.array(table[first : first + 65536])
            x, y = scaling.normalised(part[:, : len(scaling.input_low)], part[:, len(scaling.input_low) :])
            error = shape.values(parameters, torch.tensor(x, device=parameters.device)).cpu().numpy() - y
            square += (error**2).sum(axis=0)
            largest = np.maximum(largest, np.abs(error).max(axis=0))
            total += y.sum(axis=0)
            total_square += (y**2).sum(axis=0)
            count += len(y)
    mean = total / count
    constant = total_square / count - mean**2
    return {
        "points": count,
        "rms": (np.sqrt(square / count) * half).tolist(),
        "largest": (largest * half).tolist(),
        "normalised_mean_square": float((square / count).mean()),
        "constant_predictor_normalised_mean_square": float(constant.mean()),
        "rms_over_standard_deviation": np.sqrt(square / count / constant).tolist(),
    }


def _facts(problem, plan, samples, shape, progress, network: Trained, scaling) -> dict:
    return {
        "role": problem.role,
        "layers": list(problem.layers),
        "parameters": shape.parameter_count,
        "effective_parameters": progress.gamma,
        "alpha": progress.alpha,
        "beta": progress.beta,
        "iterations": progress.iteration,
        "stopped_by": progress.reason,
        "training_s": progress.seconds,
        "training_cpu_s": progress.cpu_s,
        "train_points": plan.train_points,
        "validation_points": plan.validation_points,
        "unsolved_points": samples.unsolved(),
        "validation_normalised_mean_square": progress.best_validation,
        "test": test_errors(shape, progress.best_parameters, samples, scaling),
        "inputs": [asdict(quantity) for quantity in network.inputs],
        "outputs": [asdict(quantity) for quantity in network.outputs],
        "weights_sha256": network.weights_sha256(),
    }


def train_recipe(
    problems: tuple[Problem, ...], plan: Plan, folder: Path, resume: bool, report: Report
) -> list[Outcome]:
    """All networks of a recipe, two at a time, each on one core (two threads on one small matrix only wait).

    When one fails, or the caller is interrupted, the others end at their next report; their checkpoints stay.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    given_up = threading.Event()

    def watched(role: str, what: str, share: float) -> None:
        if given_up.is_set():
            raise _GivenUpError
        report(role, what, share)

    pool = ThreadPoolExecutor(2)
    try:
        jobs = [pool.submit(train_problem, problem, plan, folder, resume, watched) for problem in problems]
        wait(jobs, return_when=FIRST_EXCEPTION)
        return [job.result() for job in jobs if job.done()]  # the one that failed raises here
    finally:
        given_up.set()
        pool.shutdown(wait=True, cancel_futures=True)
        torch.set_num_threads(threads)


class _GivenUpError(Exception):
    """Ends a training thread whose result nobody waits for."""


def versions() -> dict[str, str]:
    """What made the numbers."""
    import onnx
    import onnxruntime

    return {
        "hilrunner": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": torch.__version__,
        "onnx": onnx.__version__,
        "onnxruntime": onnxruntime.__version__,
    }


def write_json(path: Path, value: dict) -> None:
    """A readable JSON file."""
    path.write_text(json.dumps(value, indent=1, sort_keys=True) + "\n", "utf-8")


__all__ = ["Outcome", "Plan", "Quantity", "Stage", "train_problem", "train_recipe"]
