"""The article's pipeline run anew: its own form of network, trained now, with Adam and L-BFGS as rivals. Needs torch."""

import time
from pathlib import Path

from hilrunner.base import status
from hilrunner.plant.parameters import make_parameters
from hilrunner.reproduce import article, cases, charts
from hilrunner.reproduce.compare import compare
from hilrunner.reproduce.models import with_networks
from hilrunner.reproduce.rows import Detail, Part, Row, number
from hilrunner.reproduce.trajectories import ONLY_TOLD, PAPER_RTOL, error_detail, error_rows
from hilrunner.setup.model import load_model
from hilrunner.training.publish import write_model
from hilrunner.training.recipes import make_recipe
from hilrunner.training.rivals import compare as compare_rivals
from hilrunner.training.train import Outcome, Plan, Stage, train_recipe

_SMALL = Plan(6_000, 5_000, 20_000, (Stage(1_500, 120), Stage(6_000, 40)))
_FULL = Plan(60_000, stages=(Stage(1_500, 300), Stage(15_000, 200), Stage(60_000, 20)))  # as the network that ships
_PLANS = {"small": _SMALL, "full": _FULL}
_RIVAL_S_MAX = {"small": 20.0, "full": float("inf")}


def training_part(folder: Path, size: str) -> Part:
    """Sample, train, export and drive the article's lift with the result; everything stays in `folder`/<size>."""
    begin_s = time.monotonic()
    plan, place = _PLANS[size], folder / size
    recipe = make_recipe(status.CIRCUIT_PAPER, "paper", make_parameters("paper"))
    place.mkdir(parents=True, exist_ok=True)
    outcomes = train_recipe(recipe.problems, plan, place, False, lambda role, what, share: None)
    stages = ",".join(f"{stage.points}:{stage.iterations}" for stage in plan.stages)
    words = (
        f"--points {plan.train_points} --validation-points {plan.validation_points} --test-points {plan.test_points}"
    )
    command = f"hilrunner train --profile paper --recipe paper {words} --stages {stages} --seed {plan.seed}"
    facts = {"name": "paper", "axis": "cylinder", "preset": "paper", "overrides": {}}
    path = write_model(recipe, outcomes, plan, place, command, facts)
    part = Part("training", f"Training anew: the article's own form of network, {size} size (Table 3)")
    wall_s = time.monotonic() - begin_s
    _training_rows(part, outcomes[0], command, wall_s)
    case = cases.paper_lift(False)
    networks, _ = load_model(path, "paper", case.plant.parameters)
    one = compare(case, with_networks(case.plant, networks), PAPER_RTOL)
    part.rows += error_rows("training.lift", one, ONLY_TOLD, article.NOMINAL_ERROR_MPA, "Table 4")
    part.details.append(error_detail("The article's lift with the network just trained", {"own form": one}))
    part.charts.append(charts.training_chart(f"Training, {size} size", outcomes[0].curves))
    _rivals(part, recipe.problems[0], plan, place, outcomes[0], _RIVAL_S_MAX[size])
    part.notes.append(f"made by: {command}; the file: {path.name}")
    return part


def _training_rows(part: Part, outcome: Outcome, command: str, wall_s: float) -> None:
    facts, test = outcome.facts, outcome.facts["test"]
    constant = number(test["constant_predictor_normalised_mean_square"])
    label = f"{facts['parameters']} parameters, {test['points']} test points, the best constant: {constant}; {command}"
    normalised, source = test["normalised_mean_square"], "Table 3"
    part.rows += [
        Row(
            "training.normalised", "normalised mean square error", normalised, "1", label, article.NORMALISED_ERROR, source,
            timing=True,  # the last bits depend on the machine's linear algebra
        ),
        Row("training.iterations", "iterations", float(facts["iterations"]), "1", label, float(article.TRAINING_ITERATIONS), source),
        Row("training.wall", "sampling, training, test, export", wall_s, "s", label, article.TRAINING_S, source, timing=True),
        Row("training.cpu", "training, processor time", facts["training_cpu_s"], "s", label, timing=True),
    ]  # fmt: skip


def _rivals(part: Part, problem, plan: Plan, folder: Path, outcome: Outcome, seconds_max: float) -> None:
    seconds = min(outcome.facts["training_s"], seconds_max)
    rows = [
        (
            "Levenberg-Marquardt, Bayesian regularisation (ours)",
            outcome.facts["training_s"],
            outcome.facts["test"]["normalised_mean_square"],
        )
    ]
    for rival in compare_rivals(problem, plan, folder, seconds):
        rows.append((rival["method"], rival["seconds"], rival["normalised_mean_square"]))
    head = ("method", "seconds", "normalised mean square error")
    part.details.append(Detail("Rivals on the same points", head, rows))
