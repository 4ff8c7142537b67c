"""Every trained network by itself: error on points no training saw, beside the best constant's, size, and training."""

from dataclasses import dataclass

import numpy as np

from hilrunner.plant.network import RECIPE_NAMES, ROLES, Mlp, SurrogateNetworks, assemble_bank, forward_many
from hilrunner.plant.parameters import make_parameters
from hilrunner.plant.step import AxisPlant
from hilrunner.reproduce import article, charts
from hilrunner.reproduce.models import LIFT_FLOW, PAPER_FLOW, PAPER_RATES, Models, reference_of
from hilrunner.reproduce.rows import Detail, Part, Row, number

FRESH_SEED = 20_250_702
POINTS, QUICK_POINTS = 100_000, 10_000
LITERAL_POINTS, QUICK_LITERAL_POINTS = 400_000, 40_000
TRAINING_MUST_S, TRAINING_AIM_S = 15 * 60.0, 5 * 60.0


@dataclass(frozen=True)
class TestError:
    """Errors on fresh points; normalised: targets mapped to -1..1 by their range over these points."""

    __test__ = False  # not a test of pytest

    points: int
    normalised: float  # mean square over points and outputs
    constant: float  # the same of the best constant
    rms: tuple[float, ...]  # by output, SI
    over_deviation: tuple[float, ...]  # RMS over the standard deviation of the target


def fresh_seed(sheet: dict) -> int:
    """A seed of points that the training did not use."""
    return FRESH_SEED + (sheet.get("seed") == FRESH_SEED)


def test_error(network: Mlp, networks: SurrogateNetworks, problem, points: int, seed: int) -> TestError:
    """A network against what the plant answers at fresh points of its range of training."""
    from hilrunner.training.sampling import unit_points

    inputs, targets, solved = problem.answer(unit_points(0, points, points, problem.dimensions, seed))
    inputs, targets = np.ascontiguousarray(inputs[solved]), targets[solved]
    bank = assemble_bank([networks])
    outputs = np.zeros_like(targets)
    forward_many(bank.words, bank.axis_start[0, ROLES[problem.role]], inputs, outputs)
    return _normalised(outputs - targets, targets)


def _normalised(error: np.ndarray, targets: np.ndarray) -> TestError:
    half = 0.5 * np.ptp(targets, axis=0)
    square = np.mean((error / half) ** 2, axis=0)
    constant = np.var(targets / half, axis=0)
    return TestError(
        len(targets),
        float(square.mean()),
        float(constant.mean()),
        tuple(float(one) for one in np.sqrt(square) * half),
        tuple(float(one) for one in np.sqrt(square / constant)),
    )


def networks_part(models: Models, quick: bool) -> Part:
    """Test errors, parameters and training of every network; the constant predictor of the article's own ranges."""
    part = Part("networks", "Networks: error on fresh points, parameters, training (Table 3)")
    points = QUICK_POINTS if quick else POINTS
    table = []
    for file, profile in ((PAPER_FLOW, "paper"), (LIFT_FLOW, "amc-lift"), (PAPER_RATES, "paper")):
        plant = reference_of(profile)
        own_form = file == PAPER_RATES
        table += _file_rows(part, models, file, plant, points, own_form)
        _training_row(part, models, file)
    part.details.append(
        Detail(
            "Test errors on fresh points",
            (
                "file",
                "network",
                "parameters",
                "points",
                "normalised",
                "in its sheet",
                "best constant",
                "RMS / deviation",
                "RMS, SI",
            ),
            table,
        )
    )
    literal = literal_constant(QUICK_LITERAL_POINTS if quick else LITERAL_POINTS)
    label = f"no network: the mean of {literal.points} points over Table 2 with the printed dead volume of 20 mm^3"
    what = "best constant on the article's own pressure rates: normalised mean square error"
    part.rows.append(
        Row("networks.literal_constant", what, literal.constant, "1", label, article.NORMALISED_ERROR, "Table 3")
    )
    part.notes += _notes(quick)
    return part


def _notes(quick: bool) -> list[str]:
    notes = [
        "a normalised error says something only beside the best constant's: with 20 mm^3 of dead volume a few points next to "
        "x = 0 stretch the range, so even a constant comes out small, the smaller the more points are drawn",
        "the rates network (the article's own form) is judged by no limit: it ships for comparison, no profile uses it",
        f"the article counts {article.PARAMETERS_PRINTED} parameters; its 5-25-10-20-2 network has {article.PARAMETERS}",
    ]
    return notes + ([f"quick: {QUICK_POINTS} points a network instead of {POINTS}"] if quick else [])


def _file_rows(part: Part, models: Models, file: str, plant: AxisPlant, points: int, own_form: bool) -> list[tuple]:
    from hilrunner.training.recipes import make_recipe

    networks = models.networks(file, plant)
    recipe = make_recipe(plant.circuit, RECIPE_NAMES[networks.recipe], plant.parameters)
    seed = fresh_seed(models.sheet(file))
    table = []
    for problem in recipe.problems:
        network = networks.networks[problem.role]
        error = test_error(network, networks, problem, points, seed)
        label = (
            f"{file}, compiled; {error.points} fresh points (seed {seed}); the best constant: {number(error.constant)}"
        )
        what = f"network {problem.role} of {file}: normalised mean square error"
        limits = (None, None) if own_form else (article.NORMALISED_ERROR, 1e-11)
        key = f"networks.{file.removesuffix('.onnx')}.{problem.role}"
        part.rows.append(
            Row(key, what, error.normalised, "1", label, article.NORMALISED_ERROR, "Table 3", limits[0], limits[1])
        )
        if own_form:
            _parameter_row(part, network, file)
        worst = max(error.over_deviation)
        rms = ", ".join(number(one) for one in error.rms)
        said = _sheet_error(models.sheet(file), problem.role)
        row = (file, problem.role, network.parameter_count, points, error.normalised, said, error.constant, worst, rms)
        table.append(row)
    return table


def _sheet_error(sheet: dict, role: str) -> float | None:
    """The normalised test error a data sheet tells of a network."""
    facts = [one for one in sheet.get("networks", []) if one.get("role") == role]
    return facts[0].get("test", {}).get("normalised_mean_square") if facts else None


def _parameter_row(part: Part, network: Mlp, file: str) -> None:
    sizes = "-".join(map(str, network.layer_sizes))
    what = "parameters of the article's network"
    label = f"{file}, {sizes}, counted"
    count = float(network.parameter_count)
    part.rows.append(
        Row("networks.parameters", what, count, "1", label, float(article.PARAMETERS_PRINTED), "Section 4.2.1")
    )


def _training_row(part: Part, models: Models, file: str) -> None:
    """Training time of a file from its data sheet: networks of a file are trained two at a time, one core each."""
    facts = models.sheet(file).get("networks", [])
    times = [one["training_s"] for one in facts if one.get("training_s") is not None]
    cpu = [one["training_cpu_s"] for one in facts if one.get("training_cpu_s") is not None]
    wall_s = max(times) if times else None
    spent = f"processor time {sum(cpu):.0f} s" if cpu else "processor time not in the sheet"
    label = (
        f"data sheet of {file} (wall clock of the training that made it, {len(facts)} networks side by side; {spent})"
    )
    what = f"training of {file}, 2 cores"
    key = f"networks.{file.removesuffix('.onnx')}.training"
    part.rows.append(
        Row(key, what, wall_s, "s", label, article.TRAINING_S, "Table 3", TRAINING_MUST_S, TRAINING_AIM_S, timing=True)
    )
    for one in facts:
        if curve := one.get("curve"):
            part.charts.append(charts.training_chart(f"Training of {file}, network {one['role']}", curve))


def literal_constant(points: int) -> TestError:
    """The best constant on the article's pressure rates with Table 1 as printed."""
    from hilrunner.base import status
    from hilrunner.training.recipes import make_recipe
    from hilrunner.training.sampling import unit_points

    problem = make_recipe(status.CIRCUIT_PAPER, "paper", make_parameters("paper-table1")).problems[0]
    _, targets, solved = problem.answer(unit_points(0, points, points, problem.dimensions, FRESH_SEED))
    targets = targets[solved]
    return _normalised(targets.mean(axis=0) - targets, targets)
