"""A rival of the training that diverges is judged by the best it has reached, and never ends the comparison."""

import pytest
import torch

from hilrunner.training import rivals
from hilrunner.training.mlp import Shape

SHAPE = Shape((3, 8, 1))


class Points:
    """Fifty points of a smooth function."""

    rows = 50

    def batches(self, _count, _device):
        random = torch.Generator().manual_seed(1)
        inputs = torch.rand(50, 3, dtype=torch.float64, generator=random) * 2 - 1
        yield inputs, torch.sin(3 * inputs[:, :1])


def loss_of(parameters) -> float:
    inputs, targets = next(Points().batches(50, "cpu"))
    return float(((SHAPE.values(parameters, inputs) - targets) ** 2).mean())


@pytest.mark.parametrize("how", ["overflow", "far away", "no number"])
def test_lbfgs_keeps_the_best_of_its_steps(monkeypatch, how):
    honest, reached = torch.optim.LBFGS.step, []

    def step(optimiser, closure):
        (parameters,) = optimiser.param_groups[0]["params"]
        if len(reached) < 2:
            loss = honest(optimiser, closure)
            reached.append(loss_of(parameters.detach()))
            return loss
        parameters.data.fill_(float("nan") if how == "no number" else 1e200)
        if how == "overflow":
            raise OverflowError(34, "Numerical result out of range")
        return closure()

    monkeypatch.setattr(torch.optim.LBFGS, "step", step)
    found = rivals._lbfgs(SHAPE, Points(), 1, 60.0)
    assert loss_of(found) == min(reached) < loss_of(SHAPE.start(1))
