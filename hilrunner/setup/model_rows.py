"""How a network wants its rows: of which shape, how many at once. The loop has one row a period; a file may say otherwise."""

import math
from dataclasses import dataclass

import numpy as np

from hilrunner.base.errors import ModelError

_FREE_BATCH = (
    "export it with a free first dimension, in torch dynamic_axes={'input': {0: 'rows'}} or dynamic_shapes, or with an "
    "example of one row"
)


@dataclass(frozen=True)
class Rows:
    """The input of one network.

    Args:
        name: of the graph input. row: the shape of one row, `(5,)` or `(5, 1, 1)`.
        batch: rows that must come at once; 0: any number; -1: there is no dimension of rows.
        kind: np.float32 or np.float64.
    """

    name: str
    row: tuple[int, ...]
    batch: int
    kind: type

    def shape(self, count: int) -> tuple[int, ...]:
        """The shape of a feed of `count` rows."""
        return self.row if self.batch < 0 else (count, *self.row)


def rows_of(place: str, name: str, element: str, shape: list, width: int) -> Rows:
    """What a graph input asks for.

    Args:
        element: "float" or "double". shape: sizes, anything but a positive integer where one is free.
        width: numbers in a row, as the description names them.

    Raises ModelError where rows of that width do not fit, or the type is another.
    """
    where = f"{place}: input '{name}'"
    if element not in ("float", "double"):
        raise ModelError(where, f"has elements of type {element}", "float or double", "export it in float32 or float64")
    sizes = [size if isinstance(size, int) and size > 0 else 0 for size in shape]
    rest = sizes[1:] if len(sizes) > 1 else sizes
    if not rest or rest.count(0) > 1:
        raise ModelError(where, f"has shape {shape}", "rows of known width", _FREE_BATCH)
    if 0 in rest:
        known = math.prod(size for size in rest if size)
        rest[rest.index(0)] = max(1, width // known)
    if math.prod(rest) != width:
        raise ModelError(
            where, f"takes rows of {math.prod(rest)} numbers, its metadata names {width}", f"{width}",
            "name every input column in hil.networks, in the order of the file",
        )  # fmt: skip
    batch = -1 if len(sizes) == 1 else sizes[0]
    return Rows(name, tuple(rest), batch, np.float32 if element == "float" else np.float64)


def one_row(place: str, rows: Rows) -> None:
    """ModelError for a network that cannot be asked one row at a time, which is all a period has."""
    if rows.batch > 1:
        raise ModelError(
            f"{place}: input '{rows.name}'",
            f"must have {rows.batch} rows at once",
            "one row, or any number",
            _FREE_BATCH,
        )


def ask(session, rows: Rows, output: str, points: np.ndarray) -> np.ndarray:
    """onnxruntime's answers, float64[n, outputs], to points float64[n, inputs], in as many calls as the file needs.

    Raises what onnxruntime raises, ValueError where an answer has no row for a point.
    """
    if rows.batch == 0:
        try:
            return _answers(session, rows, output, points)
        except Exception:  # a free first dimension is only a name: a Reshape inside may be fixed to one row
            return np.concatenate([_answers(session, rows, output, point[None]) for point in points])
    size = max(rows.batch, 1)
    count = -(-len(points) // size) * size
    padded = np.concatenate([points, np.repeat(points[-1:], count - len(points), axis=0)])
    parts = [_answers(session, rows, output, padded[start : start + size]) for start in range(0, count, size)]
    return np.concatenate(parts)[: len(points)]


def _answers(session, rows: Rows, output: str, points: np.ndarray) -> np.ndarray:
    (answer,) = session.run([output], {rows.name: points.astype(rows.kind).reshape(rows.shape(len(points)))})
    answer = np.asarray(answer, float)
    if answer.size % len(points) or not answer.size:
        raise ValueError(f"answers {answer.size} numbers to {len(points)} rows")
    return answer.reshape(len(points), -1)
