"""The reproduction as one self-contained HTML page: every row with its label, further tables, the article's figures."""

import html

from hilrunner.evidence import page
from hilrunner.reproduce.rows import MUST_FAILS, MUST_HOLDS, Part, number
from hilrunner.reproduce.run import Reproduction
from hilrunner.reproduce.text import cells

HEAD = ("figure, and what it is", "measured", "unit", "article", "must", "aim", "must met", "aim reached")
_HTML_COLUMNS = frozenset({0, 6, 7})
_CHIPS = {MUST_HOLDS: "good", MUST_FAILS: "bad", "reached": "good", "not reached": "warn"}


def reproduction_html(found: Reproduction) -> str:
    """The whole document."""
    sections = [page.section(part.title, _part(part)) for part in found.parts]
    sections.append(page.section("Provenance", page.facts(found.facts().items())))
    return page.page("The article's figures, reproduced", _lead(found), sections)


def _lead(found: Reproduction) -> str:
    broken = found.with_must(False)
    chips = [page.chip(found.musts(), "bad" if broken else "good")]
    if found.quick:
        chips.append(page.chip("quick: shorter cases", "warn"))
    told = page.paragraph(
        "Article: Xu et al., Surrogate Model of Hydraulic Actuator for Active Motion Compensation Hydraulic Crane, Electronics 2025, "
        "14(13), 2678. Its figures are printed ones, of other runs on another machine; ours were measured by the run that wrote this page.",
        "quiet",
    )
    broken_list = page.bullets([f"not met: {row.what}: {number(row.measured)} {row.unit}" for row in broken], "warn")
    return f"<p>{' '.join(chips)}</p>{told}" + (broken_list if broken else "")


def _part(part: Part) -> str:
    rows = []
    for row in part.rows:
        words = list(cells(row))
        words[3] += f" ({row.source})" if row.source and row.article is not None else ""
        words[6], words[7] = _chip(words[6]), _chip(words[7])
        what = f'<div style="min-width:17rem">{html.escape(words[0])}<br><small class="quiet">{html.escape(row.label)}</small></div>'
        rows.append([what, *words[1:]])
    parts = [page.table(HEAD, rows, raw=_HTML_COLUMNS)]
    for detail in part.details:
        parts.append(f"<h3>{html.escape(detail.title)}</h3>")
        parts.append(page.table(detail.head, [[number(cell) for cell in row] for row in detail.rows]))
    if part.charts:
        parts.append(page.figures(*part.charts))
    return "".join(parts) + (page.bullets(part.notes) if part.notes else "")


def _chip(word: str) -> str:
    return page.chip(word, _CHIPS[word]) if word in _CHIPS else html.escape(word)
