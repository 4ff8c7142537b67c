"""How far a run is from breaking a formula: the quantitative semantics of signal temporal logic (Donzé and Maler, FORMATS 2010).

Every node becomes a signal of margins, one a sample: positive where it holds, negative where it is broken, by how much in SI units of the
comparison that decides. A formula holds for a run if its margin at the first sample is not negative.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hilrunner.requirements import window
from hilrunner.requirements.tree import (
    Arithmetic,
    Condition,
    Constant,
    Expression,
    Formula,
    Interval,
    Logic,
    Number,
    Predicate,
    Signal,
    Temporal,
)

_MIRRORED = {"historically": "always", "once": "eventually", "since": "until"}


@dataclass(frozen=True)
class Margins:
    """A node with its margins (float64[n]) and those below it."""

    node: Formula
    values: np.ndarray
    below: tuple["Margins", ...] = ()


def evaluate(node: Formula, signals: Mapping[str, np.ndarray], period_s: float) -> Margins:
    """Margins of a formula and of all that it is made of.

    Args:
        node: of parse_formula. signals: float64[n] each, SI, one value a period. period_s: the distance of two samples.
    """
    count = len(next(iter(signals.values())))
    if isinstance(node, Constant):
        return Margins(node, np.full(count, np.inf if node.value else -np.inf))
    if isinstance(node, Predicate):
        return Margins(node, _predicate(node, signals, period_s, count))
    if isinstance(node, Condition):
        value = signals[node.signal]
        holds = value != 0.0 if node.value is None else value == node.value
        return Margins(node, np.where(holds ^ node.negated, 1.0, -1.0))
    below = tuple(evaluate(operand, signals, period_s) for operand in node.operands)
    values = [one.values for one in below]
    if isinstance(node, Logic):
        return Margins(node, _logic(node.operator, values), below)
    return Margins(node, _temporal(node, values, period_s), below)


def _logic(operator: str, values: list[np.ndarray]) -> np.ndarray:
    if operator == "not":
        return -values[0]
    if operator == "and":
        return np.minimum.reduce(values)
    if operator == "or":
        return np.maximum.reduce(values)
    if operator == "implies":
        return np.maximum(-values[0], values[1])
    return np.minimum(np.maximum(-values[0], values[1]), np.maximum(values[0], -values[1]))  # iff: implied both ways


def steps(interval: Interval, period_s: float) -> tuple[int, int | None]:
    """The interval in samples, both ends included: every sample whose time lies in it (a hair of rounding allowed)."""
    slack = 1e-9
    begin = int(np.ceil(interval.begin_s / period_s - slack))
    return begin, None if np.isinf(interval.end_s) else int(np.floor(interval.end_s / period_s + slack))


def _temporal(node: Temporal, values: list[np.ndarray], period_s: float) -> np.ndarray:
    begin, end = steps(node.interval, period_s)
    operator = node.operator
    if operator in _MIRRORED:  # the past is the future of the reversed signal
        return _ahead(_MIRRORED[operator], [value[::-1] for value in values], begin, end)[::-1]
    return _ahead(operator, values, begin, end)


def _ahead(operator: str, values: list[np.ndarray], begin: int, end: int | None) -> np.ndarray:
    if end is not None and end < begin:  # an interval between two samples holds none
        return np.full(len(values[0]), np.inf if operator == "always" else -np.inf)
    if operator == "always":
        return window.least(values[0], begin, end)
    if operator == "eventually":
        return window.greatest(values[0], begin, end)
    return window.until(values[0], values[1], begin, end)


def _predicate(node: Predicate, signals: Mapping[str, np.ndarray], period_s: float, count: int) -> np.ndarray:
    left = _value(node.left, signals, period_s, count)
    right = _value(node.right, signals, period_s, count)
    if node.operator in ("<", "<="):
        return right - left
    if node.operator in (">", ">="):
        return left - right
    return -np.abs(left - right) if node.operator == "==" else np.abs(left - right)


def _value(node: Expression, signals: Mapping[str, np.ndarray], period_s: float, count: int) -> np.ndarray:
    """An expression at every sample; float64[n]."""
    if isinstance(node, Number):
        return np.full(count, node.value)
    if isinstance(node, Signal):
        return signals[node.name]
    one, *rest = (_value(operand, signals, period_s, count) for operand in node.operands)
    return _arithmetic(node, one, rest, period_s)


def _arithmetic(node: Arithmetic, one: np.ndarray, rest: list[np.ndarray], period_s: float) -> np.ndarray:
    if node.operator == "abs":
        return np.abs(one)
    if node.operator == "neg":
        return -one
    if node.operator == "rate":  # backward difference, as a controller would form it; 0 at the first sample
        return np.diff(one, prepend=one[:1]) / period_s
    other = rest[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return {"+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide, "min": np.minimum, "max": np.maximum}[
            node.operator
        ](one, other)


def worst(margins: Margins, period_s: float, at: int = 0) -> tuple[Formula, int]:
    """The comparison that decides the margin at a sample, and the sample where it does."""
    node = margins.node
    if not margins.below:
        return node, at
    value = margins.values[at]
    if isinstance(node, Logic):
        return worst(_deciding(node, margins, at, value), period_s, at)
    if len(margins.below) == 2:
        return _worst_until(margins, period_s, at, value)
    first, last = _reach(node, period_s, at, len(margins.values))
    inner = margins.below[0]
    if last < first:
        return node, at  # an empty window: nothing decides
    found = np.flatnonzero(inner.values[first : last + 1] == value)
    return worst(inner, period_s, first + int(found[0] if len(found) else 0))


def _deciding(node: Logic, margins: Margins, at: int, value: float) -> Margins:
    """The operand whose margin, with its sign turned where the operator turns it, is the node's."""
    for operand in margins.below:
        if abs(operand.values[at]) == abs(value):
            return operand
    return margins.below[0]


def _reach(node: Temporal, period_s: float, at: int, count: int) -> tuple[int, int]:
    begin, end = steps(node.interval, period_s)
    if node.operator in _MIRRORED:
        return max(0, at - end) if end is not None else 0, at - begin
    return at + begin, min(count - 1, at + end) if end is not None else count - 1


def _worst_until(margins: Margins, period_s: float, at: int, value: float) -> tuple[Formula, int]:
    first, last = _reach(margins.node, period_s, at, len(margins.values))
    for operand in reversed(margins.below):
        low, high = min(first, at), max(last, at)
        found = np.flatnonzero(operand.values[low : high + 1] == value)
        if len(found):
            return worst(operand, period_s, low + int(found[0]))
    return margins.node, at
