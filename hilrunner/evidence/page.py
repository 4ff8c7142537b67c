"""The frame of every HTML report: one file, no network, light and dark, on screen and on paper."""

import html
from collections.abc import Iterable, Sequence
from pathlib import Path

from hilrunner.base.plain_text import plain_text

STYLE = (Path(__file__).parent / "page.css").read_text(encoding="utf-8")


def page(title: str, lead: str, sections: Iterable[str]) -> str:
    """A whole document.

    Args:
        title: of the document, plain text. lead: HTML below it. sections: HTML, in order.
    """
    return plain_text(
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head>\n"
        f"<body><main><header><h1>{html.escape(title)}</h1>{lead}</header>\n"
        + "\n".join(sections)
        + "\n</main></body></html>\n"
    )


def section(title: str, *content: str) -> str:
    """A titled part of the page; content is HTML."""
    anchor = "".join(c if c.isalnum() else "-" for c in title.lower())
    return f'<section id="{anchor}"><h2>{html.escape(title)}</h2>{"".join(content)}</section>'


def paragraph(text: str, kind: str = "") -> str:
    """Plain text as a paragraph."""
    mark = f' class="{kind}"' if kind else ""
    return f"<p{mark}>{html.escape(text)}</p>"


def chip(text: str, kind: str) -> str:
    """A short coloured word: kind good, bad, warn or plain."""
    return f'<span class="chip {kind}">{html.escape(text)}</span>'


def tiles(pairs: Sequence[tuple[str, str, str]]) -> str:
    """Big figures: (label, figure, note)."""
    cells = "".join(
        f'<div class="tile"><b>{html.escape(figure)}</b><span>{html.escape(name)}</span><small>{html.escape(note)}</small></div>'
        for name, figure, note in pairs
    )
    return f'<div class="tiles">{cells}</div>'


def table(
    head: Sequence[str], rows: Iterable[Sequence[str]], numbers_from: int = 1, raw: frozenset[int] = frozenset()
) -> str:
    """A table; cells from column `numbers_from` on are set as numbers, columns in `raw` are HTML already."""
    body = []
    for row in rows:
        cells = []
        for column, cell in enumerate(row):
            content = cell if column in raw else html.escape(str(cell))
            cells.append(f"<td{' class=n' if column >= numbers_from else ''}>{content}</td>")
        body.append(f"<tr>{''.join(cells)}</tr>")
    top = "".join(
        f"<th{' class=n' if k >= numbers_from else ''}>{html.escape(name)}</th>" for k, name in enumerate(head)
    )
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{"".join(body)}</tbody></table></div>'


def facts(pairs: Iterable[tuple[str, str]]) -> str:
    """Names and values, one a line."""
    rows = "".join(f"<dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd>" for name, value in pairs)
    return f"<dl>{rows}</dl>"


def figures(*charts: str) -> str:
    """Charts side by side where there is room."""
    return f'<div class="figures">{"".join(charts)}</div>'


def bullets(texts: Iterable[str], kind: str = "") -> str:
    """A list of sentences."""
    mark = f' class="{kind}"' if kind else ""
    return f"<ul{mark}>{''.join(f'<li>{html.escape(text)}</li>' for text in texts)}</ul>"
