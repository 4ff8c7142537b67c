"""Every requirement against one run: passed or failed, by how much, when, and which comparison decides."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hilrunner.requirements import dimension
from hilrunner.requirements.requirement import Requirement
from hilrunner.requirements.robustness import evaluate, worst
from hilrunner.requirements.tree import Predicate

PASSED, FAILED, NOT_JUDGED = "passed", "failed", "not judged"


@dataclass(frozen=True)
class Judged:
    """One requirement of one run.

    `margin` is in `unit`: positive by how much it holds, negative by how much it is broken; infinite where nothing was compared.
    """

    id: str
    text: str
    source: str
    formula: str
    outcome: str
    margin: float
    unit: str
    time_s: float  # of the moment that decides, on the run's grid
    decided_by: str  # the comparison that decides
    detail: str

    @property
    def margin_words(self) -> str:
        """The margin as a person reads it."""
        if np.isinf(self.margin):
            return "nothing was compared"
        return f"{self.margin:+.4g} {self.unit}".rstrip()


def judge_requirement(requirement: Requirement, signals: Mapping[str, np.ndarray], period_s: float) -> Judged:
    """Judge one requirement.

    Args:
        signals: float64[n] each, SI, one value a period from the run's first on; NaN where the log holds none.
    """
    margins = evaluate(requirement.formula, signals, period_s)
    value = float(margins.values[0]) if len(margins.values) else np.nan
    node, at = worst(margins, period_s) if len(margins.values) else (requirement.formula, 0)
    unit, factor = dimension.readable(node.dimension) if isinstance(node, Predicate) else ("", 1.0)
    if np.isnan(value):
        outcome, detail = NOT_JUDGED, "a signal that it needs holds no number at that moment"
    elif np.isinf(value):
        outcome, detail = NOT_JUDGED, "the run is too short: no moment lies in the interval that it speaks of"
    else:
        outcome, detail = (PASSED if value >= 0.0 else FAILED), ""
    return Judged(
        id=requirement.id,
        text=requirement.text,
        source=requirement.source,
        formula=requirement.written,
        outcome=outcome,
        margin=value / factor,
        unit=unit,
        time_s=at * period_s,
        decided_by=getattr(node, "text", ""),
        detail=detail,
    )


def judge_all(requirements: Sequence[Requirement], signals: Mapping[str, np.ndarray], period_s: float) -> list[Judged]:
    """Judge every requirement, in order."""
    return [judge_requirement(one, signals, period_s) for one in requirements]
