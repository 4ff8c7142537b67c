"""The same networks trained with the usual methods for the same time: what Levenberg-Marquardt is worth."""

import time
from pathlib import Path

import torch

from hilrunner.training.dataset import Data, make_samples, scaling_of
from hilrunner.training.mlp import Shape
from hilrunner.training.problem import Problem
from hilrunner.training.sampling import splits
from hilrunner.training.train import Plan, test_errors

_BATCH = 512


def compare(problem: Problem, plan: Plan, folder: Path, seconds: float) -> list[dict]:
    """Adam and L-BFGS on the network's own samples, each for `seconds`; test errors as in the data sheet."""
    sizes = splits(plan.train_points, plan.validation_points, plan.test_points)
    samples = make_samples(problem, folder / problem.role / "samples", sizes, plan.seed)
    arrays = samples.load("train", 2_000_000)
    scaling = scaling_of(problem, arrays[1])
    data = Data(scaling, arrays)
    shape = Shape((len(problem.inputs), *problem.layers, len(problem.outputs)))
    rows = []
    for method, run in (("Adam", _adam), ("L-BFGS", _lbfgs)):
        started = time.monotonic()
        parameters = run(shape, data, plan.seed, seconds)
        errors = test_errors(shape, parameters, samples, scaling)
        rows.append({"role": problem.role, "method": method, "seconds": time.monotonic() - started} | errors)
    return rows


def _adam(shape: Shape, data: Data, seed: int, seconds: float) -> torch.Tensor:
    """Adam (Kingma & Ba 2015) on batches of 512, step falling from 3e-3 to 1e-5 along a cosine of the time left."""
    torch.manual_seed(seed)
    parameters = shape.start(seed).requires_grad_(True)
    optimiser = torch.optim.Adam([parameters], lr=3e-3)
    inputs, targets = next(iter(data.batches(data.rows, torch.device("cpu"))))
    started = time.monotonic()
    while (spent := (time.monotonic() - started) / seconds) < 1.0:
        optimiser.param_groups[0]["lr"] = 1e-5 + 3e-3 * 0.5 * (1.0 + torch.cos(torch.tensor(torch.pi * spent)).item())
        for rows in torch.randperm(data.rows).split(_BATCH):
            optimiser.zero_grad()
            loss = ((shape.values(parameters, inputs[rows]) - targets[rows]) ** 2).mean()
            loss.backward()
            optimiser.step()
    return parameters.detach()


def _lbfgs(shape: Shape, data: Data, seed: int, seconds: float) -> torch.Tensor:
    """L-BFGS with strong Wolfe line search on all points; of its steps the best, where one diverges."""
    parameters = shape.start(seed).requires_grad_(True)
    optimiser = torch.optim.LBFGS([parameters], max_iter=20, history_size=50, line_search_fn="strong_wolfe")
    inputs, targets = next(iter(data.batches(data.rows, torch.device("cpu"))))

    def closure():
        optimiser.zero_grad()
        loss = ((shape.values(parameters, inputs) - targets) ** 2).mean()
        loss.backward()
        return loss

    started, best, kept = time.monotonic(), float("inf"), parameters.detach().clone()
    while time.monotonic() - started < seconds:
        try:
            optimiser.step(closure)
        except OverflowError:  # a step that left the numbers: torch's line search squares them as Python's
            break
        with torch.no_grad():  # the step tells the loss before it, and its last trial may be worse
            loss = float(((shape.values(parameters, inputs) - targets) ** 2).mean())
        if not loss < best:  # nor is one that is no number
            break
        best, kept = loss, parameters.detach().clone()
    return kept
