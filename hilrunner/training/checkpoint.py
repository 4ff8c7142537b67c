"""Training to be gone on with: one file a network, replaced whole, refused when the plan or the problem changed."""

import json
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from hilrunner.base.errors import UsageError
from hilrunner.training.bayesian import Progress

FILE = "checkpoint.npz"
_SCALARS = ("alpha", "beta", "gamma", "damping", "iteration", "best_validation", "failures", "seconds", "cpu_s")


def _identity(plan, problem) -> str:
    ranges = [[quantity.name, quantity.low, quantity.high] for quantity in problem.inputs]
    facts = asdict(plan)
    facts.pop("seconds")
    return json.dumps([facts, problem.role, list(problem.layers), ranges, problem.parameters], sort_keys=True)


def write(folder: Path, plan, problem, progress: Progress, next_stage: int) -> None:
    """Store everything a later call needs."""
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / (FILE + ".part")
    with open(temporary, "wb") as file:
        np.savez(
            file,
            identity=np.array(_identity(plan, problem)),
            parameters=progress.parameters.cpu().numpy(),
            best_parameters=progress.best_parameters.cpu().numpy(),
            scalars=np.array([getattr(progress, name) for name in _SCALARS], np.float64),
            curves=np.array(json.dumps(progress.curves)),
            reason=np.array(progress.reason),
            next_stage=np.array(next_stage),
        )
    os.replace(temporary, folder / FILE)


def read(folder: Path, plan, problem) -> tuple[Progress | None, int]:
    """(progress, stage to go on with), or (None, 0) where nothing is stored.

    Raises:
        UsageError: the checkpoint belongs to another plan or problem, or cannot be read.
    """
    path = folder / FILE
    if not path.is_file():
        return None, 0
    try:
        with np.load(path, allow_pickle=False) as stored:
            values = {name: stored[name] for name in stored.files}
    except (OSError, ValueError) as error:
        raise UsageError(str(path), f"cannot be read: {error}", remedy="delete it, or leave --resume out") from error
    if str(values["identity"]) != _identity(plan, problem):
        raise UsageError(
            str(path), "belongs to another plan, seed or range", remedy="another --out, or leave --resume out"
        )
    scalars = dict(zip(_SCALARS, values["scalars"].tolist(), strict=True))
    progress = Progress(
        parameters=torch.tensor(values["parameters"], device=plan.device),
        best_parameters=torch.tensor(values["best_parameters"], device=plan.device),
        curves=json.loads(str(values["curves"])),
        reason=str(values["reason"]),
        **(scalars | {"iteration": int(scalars["iteration"]), "failures": int(scalars["failures"])}),
    )
    return progress, int(values["next_stage"])
