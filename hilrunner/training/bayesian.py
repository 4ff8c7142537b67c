"""Levenberg-Marquardt with Bayesian regularisation (MacKay 1992; Foresee & Hagan 1997): what MATLAB's trainbr does.

Minimised: F = beta E_d + alpha E_w, E_d the sum of squared errors over all targets, E_w of squared parameters.
After each accepted step: gamma = P - alpha trace((beta J'J + alpha I)^-1), the number of parameters the data
determines; alpha = gamma / (2 E_w), beta = (N - gamma) / (2 E_d). J'J is summed over chunks of points, so memory does
not limit their number.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import torch

from hilrunner.training.dataset import Data
from hilrunner.training.mlp import Shape

DAMPING_START = 1e-3
DAMPING_GROWTH = 4.0
DAMPING_SHRINK = 0.2
DAMPING_LARGEST = 1e12
DAMPING_SMALLEST = 1e-20
VALIDATION_FAILURES_MAX = 100  # the article: stop after 100 validations that did not improve


@dataclass
class Progress:
    """Everything training needs to go on, and what it has been through; a checkpoint is this object."""

    parameters: torch.Tensor
    alpha: float = 0.0
    beta: float = 1.0
    gamma: float = 0.0
    damping: float = DAMPING_START
    iteration: int = 0
    best_parameters: torch.Tensor | None = None
    best_validation: float = math.inf
    failures: int = 0
    seconds: float = 0.0
    cpu_s: float = 0.0  # of the training thread: what the seconds would be on an idle machine
    reason: str = ""
    curves: list[dict] = field(default_factory=list)


@dataclass(frozen=True)
class Limits:
    """When to stop."""

    iterations: int = 500
    seconds: float = math.inf
    validation_failures: int = VALIDATION_FAILURES_MAX
    goal: float = 0.0  # mean squared validation error
    gradient: float = 1e-14
    evidence_from: int = (
        80  # first iterations without regularisation: from a bad fit the evidence settles on a stiff one
    )


def squared_error(shape: Shape, parameters: torch.Tensor, data: Data, chunk: int = 65536) -> float:
    """Sum of squared errors over all points and outputs."""
    total = 0.0
    for inputs, targets in data.batches(chunk, parameters.device):
        error = shape.values(parameters, inputs) - targets
        total += float((error * error).sum())
    return total


def normal_equations(
    shape: Shape, parameters: torch.Tensor, data: Data, chunk: int = 4096
) -> tuple[torch.Tensor, torch.Tensor, float]:
    """J'J (p, p), J'e (p,) and the sum of squared errors, summed over chunks of points."""
    count = shape.parameter_count
    square = torch.zeros((count, count), dtype=torch.float64, device=parameters.device)
    slope = torch.zeros(count, dtype=torch.float64, device=parameters.device)
    total = 0.0
    for inputs, targets in data.batches(chunk, parameters.device):
        outputs, jacobian = shape.values_and_jacobian(parameters, inputs)
        error = outputs - targets
        for output in range(outputs.shape[1]):
            square.addmm_(jacobian[output].T, jacobian[output])
            slope.addmv_(jacobian[output].T, error[:, output])
        total += float((error * error).sum())
    return square, slope, total


def train(
    shape: Shape,
    data: Data,
    validation: Data,
    progress: Progress,
    limits: Limits,
    report: Callable[[Progress], None] = lambda progress: None,
) -> Progress:
    """Go on training until a limit is met; `progress` is changed and returned, its best parameters are the result.

    report: called after every iteration (progress line, checkpoint).
    """
    started = time.monotonic() - progress.seconds
    cpu_started = time.thread_time() - progress.cpu_s
    target_count = data.target_count
    while not progress.reason:
        square, slope, error = normal_equations(shape, progress.parameters, data)
        weights = float((progress.parameters**2).sum())
        if progress.alpha == 0.0:
            progress.beta = max(target_count - shape.parameter_count, 1) / (2.0 * max(error, 1e-300))
        accepted = _step(shape, data, progress, square, slope, error, weights)
        progress.iteration += 1
        progress.seconds = time.monotonic() - started
        progress.cpu_s = time.thread_time() - cpu_started
        if accepted and progress.iteration >= limits.evidence_from:
            _update_evidence(shape, progress, square, accepted, target_count)
        _validate(shape, validation, progress, accepted or error, target_count)
        _judge(progress, limits, bool(accepted), slope)
        report(progress)
    return progress


def _step(shape, data, progress, square, slope, error, weights) -> float:
    """One Levenberg-Marquardt step; the new squared error, 0 if no damping gave a smaller objective."""
    objective = progress.beta * error + progress.alpha * weights
    gradient = progress.beta * slope + progress.alpha * progress.parameters
    # damping between Levenberg's (one number) and Marquardt's (the diagonal): converged several times faster than either
    diagonal = progress.beta * square.diagonal().clamp_min(0.0)
    scale = torch.sqrt(diagonal * diagonal.mean())
    while progress.damping <= DAMPING_LARGEST:
        shifted = progress.beta * square + torch.diag(progress.alpha + progress.damping * scale)
        factor, failed = torch.linalg.cholesky_ex(shifted)
        if not int(failed):
            step = torch.cholesky_solve(gradient[:, None], factor)[:, 0]
            candidate = progress.parameters - step
            candidate_error = squared_error(shape, candidate, data)
            candidate_objective = progress.beta * candidate_error + progress.alpha * float((candidate**2).sum())
            if candidate_objective < objective:
                progress.parameters = candidate
                progress.damping = max(progress.damping * DAMPING_SHRINK, DAMPING_SMALLEST)
                return candidate_error
        progress.damping *= DAMPING_GROWTH
    return 0.0


def _update_evidence(shape, progress, square, error, target_count) -> None:
    """alpha, beta and the effective number of parameters from the Gauss-Newton Hessian (Foresee & Hagan 1997)."""
    weights = float((progress.parameters**2).sum())
    if progress.alpha == 0.0:
        progress.alpha = shape.parameter_count / (2.0 * weights)
    values = torch.linalg.eigvalsh(square).clamp_min(0.0) * progress.beta
    progress.gamma = float((values / (values + progress.alpha)).sum())
    progress.alpha = progress.gamma / (2.0 * weights)
    progress.beta = max(target_count - progress.gamma, 1.0) / (2.0 * max(error, 1e-300))


def _validate(shape, validation, progress, error, target_count) -> None:
    mean = squared_error(shape, progress.parameters, validation) / validation.target_count
    if mean < progress.best_validation:
        progress.best_validation = mean
        progress.best_parameters = progress.parameters.clone()
        progress.failures = 0
    else:
        progress.failures += 1
    progress.curves.append(
        {
            "iteration": progress.iteration,
            "seconds": progress.seconds,
            "train": error / target_count,
            "validation": mean,
            "alpha": progress.alpha,
            "beta": progress.beta,
            "gamma": progress.gamma,
            "damping": progress.damping,
        }
    )


def _judge(progress, limits, accepted, slope) -> None:
    if not accepted:
        progress.reason = "no step reduces the objective"
    elif progress.iteration >= limits.iterations:
        progress.reason = "iteration limit"
    elif progress.seconds >= limits.seconds:
        progress.reason = "time limit"
    elif progress.failures >= limits.validation_failures:
        progress.reason = f"{limits.validation_failures} validations without improvement"
    elif progress.best_validation <= limits.goal:
        progress.reason = "goal reached"
    elif float(slope.abs().max()) < limits.gradient:
        progress.reason = "gradient vanished"
