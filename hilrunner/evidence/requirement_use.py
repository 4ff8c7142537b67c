"""The requirements of a run, judged by its log: the signals that their formulas name, laid on the grid of periods."""

from collections.abc import Iterable

import numpy as np

from hilrunner.evidence.facts import RunFacts
from hilrunner.evidence.reader import Columns, Run, read_run
from hilrunner.requirements.requirement import Requirement
from hilrunner.requirements.tree import Arithmetic, Condition, Logic, Predicate, Signal, Temporal
from hilrunner.requirements.verdict import NOT_JUDGED, Judged, judge_all
from hilrunner.setup.requirement_signals import Source, requirements_of, sources

_GRID_TICKS_MAX = 100_000_000


def judged_requirements(run: Run, facts: RunFacts) -> tuple[Judged, ...]:
    """Every `[[requirement]]` of the profile that the run carries; none where it has none.

    The log is read a second time, for the fields that the formulas name only.
    """
    if facts.profile is None or not facts.profile.requirement:
        return ()
    names = tuple(axis.name for axis in facts.profile.axis)
    requirements = requirements_of(facts.profile.requirement, names, str(run.path))
    found = sources(names)
    wanted = {name: found[name] for one in requirements for name in _names(one.formula)}
    signals, problem = _signals(run, wanted, facts.period_ns)
    if problem:
        return tuple(_not_judged(one, problem) for one in requirements)
    return tuple(judge_all(requirements, signals, facts.period_ns * 1e-9))


def _names(node: object) -> Iterable[str]:
    """Signals of a formula."""
    if isinstance(node, Signal):
        yield node.name
    elif isinstance(node, Condition):
        yield node.signal
    elif isinstance(node, Predicate):
        yield from _names(node.left)
        yield from _names(node.right)
    elif isinstance(node, (Arithmetic, Logic, Temporal)):
        for operand in node.operands:
            yield from _names(operand)


def _signals(run: Run, wanted: dict[str, Source], period_ns: int) -> tuple[dict[str, np.ndarray], str]:
    """Each signal on the grid, float64[n] in SI, from period 0 on; or why they cannot be had.

    A period without a row of its own holds the value of the row before, as the plant held its inputs.
    """
    if not wanted:  # a formula of constants
        return {"": np.zeros(1)}, ""
    columns: Columns = {}
    for one in wanted.values():
        topic = f"/{one.axis}/{one.topic}"
        columns[topic] = (*columns.get(topic, ("tick",)), one.field)
    log = read_run(
        run.path, {topic: tuple(dict.fromkeys(fields)) for topic, fields in columns.items()} | {"/rt/tick": ("tick",)}
    )
    if not len(log.tick):
        return {}, "the log holds no tick"
    count = int(log.tick["tick"][-1]) + 1
    if count > _GRID_TICKS_MAX:
        return {}, f"{count} periods are more than {_GRID_TICKS_MAX}: judge a shorter run"
    signals = {}
    for name, one in wanted.items():
        topic = f"/{one.axis}/{one.topic}"
        rows = log.topics.get(topic)
        if rows is None or not len(rows):
            return {}, f"the log holds no {topic}"
        if one.field in log.missing_fields.get(topic, ()):
            return {}, f"{topic} of this log has no {one.field}"
        signals[name] = _on_grid(rows["tick"], _values(rows[one.field], one), count)
    return signals, ""


def _values(column: np.ndarray, source: Source) -> np.ndarray:
    if source.flag:
        return ((column.astype(np.int64) & source.flag) != 0).astype(np.float64)
    return column.astype(np.float64) * source.factor


def _on_grid(ticks: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """values[i] belongs to period ticks[i]; periods between two rows hold the earlier one, those before the first the first."""
    place = np.searchsorted(ticks, np.arange(count), side="right") - 1
    return values[np.maximum(place, 0)]


def _not_judged(one: Requirement, problem: str) -> Judged:
    return Judged(one.id, one.text, one.source, one.written, NOT_JUDGED, float("nan"), "", 0.0, "", problem)
