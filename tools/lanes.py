"""Lanes: one command each, run in order, counted together. Shared by tools/test_all and tools/test_long."""

import os
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / ".cache" / "test_all"
PYTHON = sys.executable


class Lane(NamedTuple):
    """One command, where its JUnit file is (None: it has no tests to count), and whether it runs beside the lane after it."""

    name: str
    command: list[str]
    junit: Path | None = None
    beside: bool = False


def pytest_lane(name: str, before: list[str], *options: str, beside: bool = False) -> Lane:
    """A lane that runs pytest and leaves a JUnit file."""
    junit = RESULTS / f"{name}.xml"
    return Lane(name, [*before, PYTHON, "-m", "pytest", f"--junitxml={junit}", *options], junit, beside)


def counts(junit: Path | None) -> Counter:
    """Passed, failed and skipped tests of a lane's JUnit file."""
    if junit is None:
        return Counter()
    try:
        root = ElementTree.parse(junit).getroot()
    except (OSError, ElementTree.ParseError):
        return Counter(failed=1)  # a lane without a result is a failure
    found: Counter = Counter()
    for case in root.iter("testcase"):
        kinds = {child.tag for child in case}
        if kinds & {"failure", "error"}:
            found["failed"] += 1
        else:
            found["skipped" if "skipped" in kinds else "passed"] += 1
    return found


class Running:
    """A lane at work; one that runs beside another keeps its words until its end."""

    def __init__(self, lane: Lane) -> None:
        self.lane = lane
        self._title = f"\n--- {lane.name}: {' '.join(lane.command).replace(str(ROOT) + '/', '')}"
        self._output = RESULTS / f"{lane.name}.txt"
        if lane.junit is not None:
            lane.junit.unlink(missing_ok=True)
        self._started_s = time.monotonic()
        if lane.beside:
            with open(self._output, "wb") as output:
                self._process = subprocess.Popen(lane.command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)
        else:
            print(self._title, flush=True)
            self._process = subprocess.Popen(lane.command, cwd=ROOT)

    def end(self) -> tuple[str, Counter]:
        """Wait; the lane's line of the table, and its counts."""
        code = self._process.wait()
        took_s = time.monotonic() - self._started_s
        if self.lane.beside:
            print(self._title + "\n" + self._output.read_text(errors="replace"), flush=True)
        found = counts(self.lane.junit)
        if code and not found["failed"]:
            found["failed"] += 1
        verdict = "ok" if code == 0 else f"FAILED ({code})"
        return f"  {self.lane.name:<9} {verdict:<12} {took_s:6.1f} s  {dict(found) or ''}", found


def closing_line(total: Counter, took_s: float) -> str:
    """The total as pytest would close."""
    words = [f"{total[kind]} {kind}" for kind in ("failed", "passed", "skipped") if total[kind] or kind == "passed"]
    minutes, seconds = divmod(round(took_s), 60)
    text = f" {', '.join(words)} in {took_s:.2f}s ({minutes // 60}:{minutes % 60:02d}:{seconds:02d}) "
    return text.center(80, "=")


def run_lanes(lanes: list[Lane], wanted: list[str]) -> int:
    """Run the lanes whose names are wanted (none named: all of them); 0 if every one passed, 2 for a name that is none."""
    unknown = [name for name in wanted if name not in [lane.name for lane in lanes]]
    if unknown:
        print(f"no lane {', '.join(unknown)}; lanes: {', '.join(lane.name for lane in lanes)}", file=sys.stderr)
        return 2
    RESULTS.mkdir(parents=True, exist_ok=True)
    os.chdir(ROOT)
    chosen = [lane for lane in lanes if not wanted or lane.name in wanted]
    started_s = time.monotonic()
    total: Counter = Counter()
    rows = []
    beside: list[Running] = []
    for lane in chosen:
        running = Running(lane)
        beside.append(running)
        if lane.beside and lane is not chosen[-1]:
            continue
        for one in reversed(beside):
            row, found = one.end()
            rows.append(row)
            total += found
        beside.clear()
    print("\nlanes:\n" + "\n".join(rows))
    print(closing_line(total, time.monotonic() - started_s))
    return 1 if total["failed"] else 0
