"""What a formula is made of: nodes of the syntax tree, all immutable; times in seconds, numbers in SI."""

import math
from dataclasses import dataclass, field

from hilrunner.requirements.dimension import Dimension


@dataclass(frozen=True)
class Interval:
    """When a temporal operator looks, relative to now; s. `end_s` may be infinite."""

    begin_s: float = 0.0
    end_s: float = math.inf

    @property
    def is_everything(self) -> bool:
        """No bounds were written."""
        return self.begin_s == 0.0 and math.isinf(self.end_s)


@dataclass(frozen=True)
class Number:
    """A constant."""

    value: float
    dimension: Dimension


@dataclass(frozen=True)
class Signal:
    """A logged signal."""

    name: str
    dimension: Dimension


@dataclass(frozen=True)
class Arithmetic:
    """`operator` is one of + - * / abs min max neg rate."""

    operator: str
    operands: tuple
    dimension: Dimension


@dataclass(frozen=True)
class Predicate:
    """left `operator` right, with operator one of < <= > >= == !=; `text` as it was written."""

    operator: str
    left: object
    right: object
    dimension: Dimension
    text: str


@dataclass(frozen=True)
class Condition:
    """A signal that is true or false, or a word compared with a word: its margin is 1 or -1."""

    signal: str
    value: float | None  # None: the signal itself is the truth value (not 0)
    negated: bool
    text: str


@dataclass(frozen=True)
class Constant:
    """true or false."""

    value: bool


@dataclass(frozen=True)
class Logic:
    """`operator` is one of not and or implies iff."""

    operator: str
    operands: tuple


@dataclass(frozen=True)
class Temporal:
    """`operator` is one of always eventually historically once (one operand), until since (two)."""

    operator: str
    operands: tuple
    interval: Interval = field(default_factory=Interval)


Expression = Number | Signal | Arithmetic
Formula = Predicate | Condition | Constant | Logic | Temporal
