"""Values of a mapping as numbers on the wire: given as numbers, or by the names of the database's value table."""

import numpy as np

from hilrunner.base.errors import DbcError


def numbers_of(where: str, signal, values) -> list[float]:
    """The raw numbers that a value, a name or a list of them stand for; DbcError for a name nobody knows or a value beyond the bits."""
    return [_number_of(where, signal, value) for value in (values if isinstance(values, list) else [values])]


def _number_of(where: str, signal, value) -> float:
    if isinstance(value, str):
        choices = {str(name).casefold(): number for number, name in (signal.choices or {}).items()}
        if value.casefold() not in choices:
            known = ", ".join(f"{name} ({number})" for number, name in (signal.choices or {}).items())
            raise DbcError(where, f"its value table has no '{value}'", known or "it has none", "give the number")
        return float(choices[value.casefold()])
    if signal.is_float:
        return float(value)
    low, high = raw_span(signal)
    if not low <= value <= high:
        raise DbcError(where, f"{value} is not a value of its {signal.length} bits", f"{low}..{high}")
    return float(value)


def raw_span(signal) -> tuple[int, int]:
    """Lowest and highest integer that the bits of a signal hold."""
    if signal.is_signed:
        return -(1 << (signal.length - 1)), (1 << (signal.length - 1)) - 1
    return 0, (1 << signal.length) - 1


def meanings(where: str, signal, table: dict[float, object]) -> tuple[list[float], list[float]]:
    """(numbers, meanings) of a table meaning -> values; DbcError where one number means two things."""
    numbers: list[float] = []
    means: list[float] = []
    for meaning, values in table.items():
        for number in numbers_of(where, signal, values):
            if number in numbers and means[numbers.index(number)] != meaning:
                raise DbcError(
                    where, f"one value twice: {number:g} would mean two things", remedy="correct the mapping"
                )
            numbers.append(number)
            means.append(float(meaning))
    return numbers, means


def sent_table(where: str, signal, mapped, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """(number of each name, value sent) of a signal that carries one of `names`, such as the bench's state."""
    unknown = [name for name in mapped.values if name not in names]
    if unknown:
        raise DbcError(where, f"no state '{unknown[0]}'", ", ".join(names), "correct the name")
    missing = [name for name in names if name not in mapped.values]
    if missing and mapped.other is None:
        raise DbcError(
            where, f"says nothing of {', '.join(missing)}", "every state of the bench", "add them, or give `other`"
        )
    values = [mapped.values.get(name, mapped.other) for name in names]
    return np.arange(len(names), dtype=np.float64), np.array([_number_of(where, signal, value) for value in values])
