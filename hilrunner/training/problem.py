"""What is learned: for each network of a recipe its inputs, its targets, its ranges, and the plant that answers.

A problem is a function from points of the unit cube to inputs, targets and a mask of solved points. The problems here
take their answers from the plant's exact functions; a measured valve or a black box needs the same function and no
equations.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Answer = tuple[np.ndarray, np.ndarray, np.ndarray]  # inputs (n, i), targets (n, o), solved (n,) bool


@dataclass(frozen=True)
class Quantity:
    """One input or output: name with its unit last, and its range (inputs: of training; outputs: of the targets)."""

    name: str
    unit: str
    low: float = 0.0
    high: float = 0.0


@dataclass(frozen=True)
class Problem:
    """One network to be trained.

    Args:
        role: key of plant.network.ROLES.
        inputs, outputs: quantities, in the network's order; input ranges are the training range.
        dimensions: coordinates of the unit cube that `answer` maps.
        answer: unit points float64[n, dimensions] -> (inputs, targets, solved).
        parameters: profile keys and values the answers depend on; a profile that differs must not use the network.
        layers: hidden layer sizes.
    """

    role: str
    inputs: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    dimensions: int
    answer: Callable[[np.ndarray], Answer]
    parameters: dict[str, float]
    layers: tuple[int, ...] = (25, 10, 20)


@dataclass(frozen=True)
class Recipe:
    """The networks one model file holds."""

    circuit: str  # status.CIRCUIT_NAMES
    name: str  # network.RECIPE_NAMES
    problems: tuple[Problem, ...]
