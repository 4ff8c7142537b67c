"""Margins of random formulas over random signals equal those of RTAMT, an independent monitor of signal temporal logic.

RTAMT: Nickovic and Yamaguchi, "RTAMT: Online Robustness Monitors from STL", ATVA 2020; its discrete-time semantics with a period of 1 s.
"""

import random
import re

import numpy as np
import pytest
import rtamt

from hilrunner.requirements.dimension import NONE
from hilrunner.requirements.parse import SignalKind, parse_formula
from hilrunner.requirements.robustness import evaluate

FORMULAS = 1_000
SIGNALS = {name: SignalKind(NONE) for name in ("x", "y", "z")}
_UNARY = ("always", "eventually", "historically", "once")


def _interval(rng: random.Random) -> str:
    begin = rng.randrange(4)
    return rng.choice(("", f"[{begin},{begin + rng.randrange(6)}]"))


def _expression(rng: random.Random, depth: int) -> str:
    kind = rng.randrange(5 if depth > 0 else 2)
    if kind == 0:
        return rng.choice(("x", "y", "z"))
    if kind == 1:
        return f"{rng.uniform(0, 3):.3f}"
    if kind == 2:
        return f"abs({_expression(rng, depth - 1)})"
    return f"({_expression(rng, depth - 1)} {rng.choice('+-*')} {_expression(rng, depth - 1)})"


def draw_formula(rng: random.Random, depth: int) -> str:
    """A formula in the words that both read."""
    kind = rng.randrange(10) if depth > 0 else 0
    if kind <= 1:
        return f"({_expression(rng, 2)} {rng.choice(('<', '<=', '>', '>=', '=='))} {_expression(rng, 2)})"
    if kind <= 4:
        return f"({rng.choice(_UNARY)}{_interval(rng)} ({draw_formula(rng, depth - 1)}))"
    if kind == 5:
        return f"(not ({draw_formula(rng, depth - 1)}))"
    one, other = draw_formula(rng, depth - 1), draw_formula(rng, depth - 1)
    if kind == 6:
        return f"({one} {rng.choice(('until', 'since'))}{_interval(rng)} {other})"
    if kind == 7:  # RTAMT's own iff is -|a - b|, negative also where both hold: there it is written out
        return f"(({one} implies {other}) and ({other} implies {one}))"
    return f"({one} {rng.choice(('and', 'or', 'implies'))} {other})"


def draw_case(seed: int) -> tuple[str, dict[str, np.ndarray]]:
    """A formula and signals; the same seed gives the same."""
    rng = random.Random(seed)
    formula = draw_formula(rng, 4)
    count = rng.randrange(2, 25)  # RTAMT cannot read a signal of one sample
    return formula, {name: np.array([rng.uniform(-3, 3) for _ in range(count)]) for name in SIGNALS}


def rtamt_margins(formula: str, signals: dict[str, np.ndarray]) -> np.ndarray:
    """What RTAMT says."""
    monitor = rtamt.StlDiscreteTimeSpecification()
    for name in signals:
        monitor.declare_var(name, "float")
    monitor.spec = formula
    monitor.parse()
    count = len(next(iter(signals.values())))
    data = {"time": list(range(count))} | {name: list(map(float, values)) for name, values in signals.items()}
    return np.array([value for _, value in monitor.evaluate(data)])


def _with_units(formula: str) -> str:
    """Our bounds carry their unit."""
    return re.sub(r"\[(\d+),(\d+)\]", r"[\1 s, \2 s]", formula)


@pytest.mark.parametrize("block", range(10))
def test_margins_are_those_of_rtamt(block):
    different = []
    for seed in range(block * FORMULAS // 10, (block + 1) * FORMULAS // 10):
        formula, signals = draw_case(seed)
        ours = evaluate(parse_formula(_with_units(formula), SIGNALS, "test"), signals, 1.0).values
        theirs = rtamt_margins(formula, signals)
        if not np.allclose(ours, theirs, rtol=1e-12, atol=1e-12):
            different.append((seed, formula, ours, theirs))
    assert different == []
