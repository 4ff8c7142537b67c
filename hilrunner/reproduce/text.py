"""The reproduction as text: one table a part, then which musts hold and which do not."""

from collections.abc import Sequence

from hilrunner.reproduce.rows import Detail, Part, Row, number, printed
from hilrunner.reproduce.run import Reproduction

HEAD = ("figure", "measured", "unit", "article", "must", "aim", "must?", "aim?")


def cells(row: Row) -> tuple[str, ...]:
    """A row as words, columns as HEAD."""
    sign = ">= " if row.at_least else "<= "
    must = "-" if row.must is None else sign + printed(row.must)
    aim = "-" if row.aim is None else sign + printed(row.aim)
    return row.what, number(row.measured), row.unit, printed(row.article), must, aim, row.verdict, row.aim_verdict


def text(found: Reproduction) -> str:
    """Everything for a terminal."""
    blocks = [_part(part) for part in found.parts]
    return "\n".join([*blocks, summary(found)])


def summary(found: Reproduction) -> str:
    """Which musts hold."""
    broken = found.with_must(False)
    lines = [found.musts() + (" (quick: shorter cases)" if found.quick else "")]
    for row in broken:
        lines.append(f"  NOT MET: {row.what}: {number(row.measured)} {row.unit}, must {cells(row)[4]} ({row.label})")
    missed = [row for row in found.rows if row.meets(row.aim) is False and row not in broken]
    lines += [
        f"  aim not reached: {row.what}: {number(row.measured)} {row.unit}, aim {cells(row)[5]}" for row in missed
    ]
    return "\n".join(lines)


def _part(part: Part) -> str:
    lines = [f"== {part.title} ({part.wall_s:.1f} s)"]
    label = ""
    table = aligned([HEAD, *(cells(row) for row in part.rows)])
    lines.append(table[0])
    for row, line in zip(part.rows, table[1:], strict=True):
        if row.label != label:
            label = row.label
            lines.append(f"  [{label}]")
        lines.append(line)
    for detail in part.details:
        lines += ["", *_detail(detail)]
    lines += [f"  {note}" for note in part.notes]
    return "\n".join(lines) + "\n"


def _detail(detail: Detail) -> list[str]:
    rows = [tuple(number(cell) for cell in row) for row in detail.rows]
    return [f"  {detail.title}", *(f"    {line}" for line in aligned([detail.head, *rows]))]


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Columns of equal width: the first left, the others right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        )
        for row in rows
    ]
