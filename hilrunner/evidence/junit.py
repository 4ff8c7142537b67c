"""A verdict as JUnit XML: one test case a limit, so that any CI server shows which one failed and by how much."""

import math
import xml.etree.ElementTree as ElementTree

from hilrunner.base.plain_text import plain_text
from hilrunner.evidence.verdict import FAILED, NO_LIMITS, NOT_JUDGED, Judgement, Verdict


def junit_xml(verdict: Verdict, suite_name: str, duration_s: float, properties: dict[str, str]) -> str:
    """The XML text.

    Args:
        suite_name: name of the test suite (profile and log). duration_s: of the run, s.
        properties: facts of the run, kept as properties of the suite.
    """
    outcomes = [judgement.outcome for judgement in verdict.judgements]
    no_limits = verdict.outcome == NO_LIMITS
    suite = ElementTree.Element(
        "testsuite",
        name=suite_name,
        tests=str(len(outcomes) + no_limits),
        failures=str(outcomes.count(FAILED)),
        errors=str(outcomes.count(NOT_JUDGED)),
        skipped=str(int(no_limits)),
        time=f"{duration_s:.3f}",
    )
    table = ElementTree.SubElement(suite, "properties")
    for key, value in properties.items():
        ElementTree.SubElement(table, "property", name=key, value=_clean(value))
    for judgement in verdict.judgements:
        _add_case(suite, suite_name, judgement)
    if no_limits:
        case = ElementTree.SubElement(suite, "testcase", classname=_clean(suite_name), name="limits", time="0")
        ElementTree.SubElement(case, "skipped", message="no limits set: the profile names nothing that could pass")
    root = ElementTree.Element("testsuites")
    root.append(suite)
    ElementTree.indent(root)
    text = plain_text(ElementTree.tostring(root, encoding="unicode"))  # names of suites and properties too
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'


def _add_case(suite: ElementTree.Element, suite_name: str, judgement: Judgement) -> None:
    case = ElementTree.SubElement(suite, "testcase", classname=_clean(suite_name), name=judgement.key, time="0")
    text = f"{judgement.doc}: {judgement.sentence()}"
    if judgement.outcome == FAILED:
        ElementTree.SubElement(case, "failure", message=_clean(text), type="limit")
    elif judgement.outcome == NOT_JUDGED:
        ElementTree.SubElement(case, "error", message=_clean(text), type="not judged")
    else:
        ElementTree.SubElement(case, "system-out").text = _clean(text)


def number(value: float) -> str:
    """A figure as people write it; `not known` for NaN."""
    if math.isnan(value):
        return "not known"
    return f"{value:.6g}"


def _clean(text: str) -> str:
    """Text with the characters XML 1.0 forbids as escapes."""
    return plain_text(str(text))
