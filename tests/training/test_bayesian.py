"""Levenberg-Marquardt with Bayesian regularisation: exact Jacobian, evidence of a model with known answer, checkpoints."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hilrunner.base.errors import UsageError
from hilrunner.training import bayesian, checkpoint
from hilrunner.training.bayesian import Limits, Progress
from hilrunner.training.dataset import Data, Scaling
from hilrunner.training.mlp import Shape
from hilrunner.training.problem import Problem, Quantity
from hilrunner.training.train import Plan, Stage, train_problem


def data_of(inputs, targets) -> Data:
    scaling = Scaling(
        -np.ones(inputs.shape[1]), np.ones(inputs.shape[1]), -np.ones(targets.shape[1]), np.ones(targets.shape[1])
    )
    return Data(scaling, (inputs, targets))


@pytest.mark.parametrize("sizes", [(3, 1), (2, 4, 1), (3, 5, 4, 2), (5, 25, 10, 20, 2)])
def test_jacobian_equals_automatic_differentiation(sizes):
    shape = Shape(sizes)
    parameters = shape.start(seed=1)
    assert len(parameters) == shape.parameter_count
    x = torch.randn(6, sizes[0], dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    outputs, jacobian = shape.values_and_jacobian(parameters, x)
    torch.testing.assert_close(outputs, shape.values(parameters, x), rtol=0.0, atol=1e-14)
    theirs = torch.autograd.functional.jacobian(lambda p: shape.values(p, x), parameters)
    torch.testing.assert_close(jacobian, theirs.permute(1, 0, 2), rtol=1e-12, atol=1e-13)


def test_normal_equations_do_not_depend_on_the_chunks():
    shape = Shape((2, 6, 2))
    random = np.random.default_rng(0)
    data = data_of(random.uniform(-1, 1, (300, 2)), random.uniform(-1, 1, (300, 2)))
    parameters = shape.start(seed=1)
    whole = bayesian.normal_equations(shape, parameters, data, chunk=1000)
    pieces = bayesian.normal_equations(shape, parameters, data, chunk=37)
    for one, other in zip(whole, pieces, strict=True):
        torch.testing.assert_close(torch.as_tensor(one), torch.as_tensor(other), rtol=1e-12, atol=1e-12)


def test_evidence_of_a_linear_model_meets_mackays_equations():
    """y = w x + noise: at the fixed point gamma = P - alpha tr(H^-1), and beta is the noise's 1 / (2 variance)."""
    random = np.random.default_rng(4)
    inputs = random.uniform(-1, 1, (4000, 3))
    noise = 0.05
    targets = inputs @ np.array([[0.3], [-0.4], [0.2]]) + 0.1 + noise * random.normal(size=(4000, 1))
    shape = Shape((3, 1))
    data = data_of(inputs, targets)
    progress = bayesian.train(shape, data, data, Progress(shape.start(1)), Limits(iterations=30, evidence_from=0))
    assert progress.beta == pytest.approx(1.0 / (2.0 * noise**2), rel=0.05)
    square, _, _ = bayesian.normal_equations(shape, progress.parameters, data)
    hessian = progress.beta * square + progress.alpha * torch.eye(4, dtype=torch.float64)
    gamma = 4.0 - progress.alpha * float(torch.linalg.inv(hessian).diagonal().sum())
    assert progress.gamma == pytest.approx(gamma, rel=1e-3) and 3.9 < progress.gamma <= 4.0
    weights = float((progress.parameters**2).sum())
    assert progress.alpha == pytest.approx(progress.gamma / (2.0 * weights), rel=1e-3)


def test_a_useless_input_costs_effective_parameters():
    random = np.random.default_rng(5)
    inputs = random.uniform(-1, 1, (60, 1))
    targets = 0.5 * np.sin(2.0 * inputs) + 0.05 * random.normal(size=(60, 1))
    shape = Shape((1, 30, 1))
    data = data_of(inputs, targets)
    progress = bayesian.train(shape, data, data, Progress(shape.start(1)), Limits(iterations=150, evidence_from=20))
    assert progress.gamma < 0.25 * shape.parameter_count  # 91 weights, few of which sixty noisy points determine


def test_training_learns_a_smooth_function_to_four_digits():
    random = np.random.default_rng(1)
    inputs = random.uniform(-1, 1, (900, 2))
    targets = (0.5 * np.sin(2.0 * inputs[:, 0]) * np.exp(-inputs[:, 1]))[:, None]
    shape = Shape((2, 10, 6, 1))
    progress = bayesian.train(
        shape, data_of(inputs[:600], targets[:600]), data_of(inputs[600:], targets[600:]),
        Progress(shape.start(1)), Limits(iterations=150),
    )  # fmt: skip
    assert progress.best_validation**0.5 < 1e-4
    objective = [row["train"] for row in progress.curves[:80]]
    assert all(later <= earlier for earlier, later in zip(objective[:-1], objective[1:], strict=True))


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        (Limits(iterations=3), "iteration limit"),
        (Limits(iterations=500, seconds=0.0), "time limit"),
        (Limits(iterations=500, goal=0.5), "goal reached"),
        (Limits(iterations=500, gradient=1e9), "gradient vanished"),
    ],
)
def test_every_limit_ends_training_with_its_reason(limits, reason):
    random = np.random.default_rng(1)
    data = data_of(random.uniform(-1, 1, (50, 2)), random.uniform(-0.1, 0.1, (50, 1)))
    shape = Shape((2, 3, 1))
    assert bayesian.train(shape, data, data, Progress(shape.start(1)), limits).reason == reason


def test_validation_that_does_not_improve_ends_training():
    random = np.random.default_rng(1)
    shape = Shape((2, 20, 1))
    train = data_of(random.uniform(-1, 1, (40, 2)), random.uniform(-1, 1, (40, 1)))
    other = data_of(random.uniform(-1, 1, (40, 2)), random.uniform(-1, 1, (40, 1)))
    progress = bayesian.train(
        shape, train, other, Progress(shape.start(1)), Limits(500, validation_failures=5, evidence_from=10**9)
    )
    assert "5 validations" in progress.reason or "no step" in progress.reason
    assert progress.best_validation <= min(row["validation"] for row in progress.curves)


def wave_problem() -> Problem:
    def answer(points):
        x = 2.0 * points - 1.0
        return x, np.sin(2.0 * x[:, :1]) + x[:, 1:] ** 2, np.ones(len(points), np.bool_)

    inputs = (Quantity("a_pa", "Pa", -1.0, 1.0), Quantity("b_pa", "Pa", -1.0, 1.0))
    return Problem("flow", inputs, (Quantity("c_pa", "Pa"),), 2, answer, {}, layers=(6, 5))


PLAN = Plan(400, 100, 200, stages=(Stage(200, 25), Stage(400, 15)), seed=2)


def silent(*_):
    """No progress lines."""


def test_a_resumed_training_ends_with_the_same_network_as_one_in_one_go(tmp_path):
    whole = train_problem(wave_problem(), PLAN, tmp_path / "whole", False, silent)
    calls = 0

    class InterruptedTrainingError(Exception):
        """Stands for the power button."""

    def interrupt(role, what, share):
        nonlocal calls
        calls += "iteration" in what
        if calls == 30:  # in the middle of the second stage
            raise InterruptedTrainingError

    with pytest.raises(InterruptedTrainingError):
        train_problem(wave_problem(), PLAN, tmp_path / "cut", False, interrupt)
    resumed = train_problem(wave_problem(), PLAN, tmp_path / "cut", True, silent)
    assert resumed.network.weights_sha256() == whole.network.weights_sha256()
    assert resumed.facts["test"] == whole.facts["test"]


def test_the_same_plan_gives_the_same_network_and_another_seed_another(tmp_path):
    one = train_problem(wave_problem(), PLAN, tmp_path / "a", False, silent)
    two = train_problem(wave_problem(), PLAN, tmp_path / "b", False, silent)
    other = train_problem(wave_problem(), replace(PLAN, seed=3), tmp_path / "c", False, silent)
    assert one.network.weights_sha256() == two.network.weights_sha256() != other.network.weights_sha256()


def test_the_constant_predictor_stands_beside_the_error(tmp_path):
    facts = train_problem(wave_problem(), PLAN, tmp_path, False, silent).facts["test"]
    assert facts["points"] == 200
    ratio = facts["normalised_mean_square"] / facts["constant_predictor_normalised_mean_square"]
    assert ratio == pytest.approx(facts["rms_over_standard_deviation"][0] ** 2, rel=1e-9) and ratio < 1e-2


def test_a_checkpoint_of_another_plan_is_refused(tmp_path):
    train_problem(wave_problem(), PLAN, tmp_path, False, silent)
    with pytest.raises(UsageError, match="another plan"):
        checkpoint.read(tmp_path / "flow", replace(PLAN, seed=9), wave_problem())
    (tmp_path / "flow" / checkpoint.FILE).write_bytes(b"damaged")
    with pytest.raises(UsageError, match="cannot be read"):
        checkpoint.read(tmp_path / "flow", PLAN, wave_problem())
    assert checkpoint.read(tmp_path / "nowhere", PLAN, wave_problem()) == (None, 0)
