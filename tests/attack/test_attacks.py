"""A few cases of every campaign that needs no process of its own; `make test-long` tries them by the thousand."""

import re
from pathlib import Path

import pytest

from tests.attack.campaign import try_cases
from tests.attack.command import campaigns
from tests.attack.outcome import Outcome

SMALL = {"cut": 12, "flip": 24, "logs": 32, "databases": 16}


@pytest.mark.parametrize("name", sorted(SMALL))
def test_a_few_cases_hold(name):
    result = try_cases(campaigns()[name], seed=11, numbers=range(SMALL[name]))
    assert result.failed == [], result.text()
    assert result.count == SMALL[name]


def test_what_must_not_happen_is_noticed():
    fine = Outcome(2, "", "hilrunner check: x: bad\n", 0.1, 10)
    assert fine.faults() == []
    assert Outcome(None, "", "", 60.0, 10).faults() == ["hang of more than 60 s"]
    assert Outcome(-11, "", "", 0.1, 10).faults() == ["killed by SIGSEGV"]
    assert Outcome(1, "", "Traceback (most recent call last)", 0.1, 10).faults() == ["traceback"]
    assert "memory" in Outcome(0, "", "", 0.1, 2_000_000_000).faults()[0]
    assert "control" in Outcome(0, "\x1b[2J", "", 0.1, 10).faults()[0]
    assert Outcome(2, "", "one\ntwo\n", 0.1, 10).faults() == ["a refusal that is not one line"]


def test_make_test_long_tries_every_campaign():
    from tools.campaigns import CAMPAIGNS

    assert {words[2] for words in CAMPAIGNS.values() if words[1] == "tools/attack"} == set(campaigns())


def test_the_fault_table_names_campaigns_and_tests_that_exist():
    root = Path(__file__).resolve().parents[2]
    rows = [line for line in (root / "docs/reliability.md").read_text().splitlines() if line.startswith("| ")]
    table = [row.split(" | ") for row in rows if "`tools/attack" in row or "`tests/" in row]
    assert len(table) >= 20
    known = campaigns()
    named = set()
    for fault, tried_by, *_ in table:
        found = re.findall(r"`(tools/attack (\w+)|tests/[\w/]+\.py)`", tried_by)
        assert found, fault
        for whole, campaign in found:
            assert campaign in known if campaign else (root / whole).is_file(), f"{fault}: {whole}"
            named.add(campaign)
    assert named >= set(known), "a campaign that no row names"
