"""A campaign: one kind of attack, tried many times, every case drawn from (seed, number) so that one command tries it again."""

import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np


@dataclass
class Tried:
    """One case: what was done in words, of which group, how it ended, and what must not have happened."""

    what: str
    group: str
    code: int | None
    faults: list[str]
    wall_s: float = 0.0
    memory_bytes: int = 0
    said: str = ""  # the end of what the command said on stderr


Attempt = Callable[[np.random.Generator, Path], Tried]  # the folder is the case's own and empty


@dataclass(frozen=True)
class Campaign:
    """`prepare` makes what all cases share, in a folder of its own, and returns how one case is tried.

    `count` is how many cases `make test-long` tries.
    """

    name: str
    doc: str
    count: int
    prepare: Callable[[Path], Attempt]


@dataclass
class Result:
    """Sums of one campaign."""

    campaign: str
    seed: int
    codes: dict[str, Counter] = field(default_factory=dict)  # group -> exit code -> cases
    failed: list[tuple[int, Tried]] = field(default_factory=list)
    count: int = 0
    wall_s: float = 0.0
    slowest_s: float = 0.0
    memory_bytes: int = 0

    def add(self, number: int, tried: Tried) -> None:
        """Count one case."""
        self.count += 1
        self.codes.setdefault(tried.group, Counter())[tried.code] += 1
        self.slowest_s = max(self.slowest_s, tried.wall_s)
        self.memory_bytes = max(self.memory_bytes, tried.memory_bytes)
        if tried.faults:
            self.failed.append((number, tried))

    def text(self) -> str:
        """A line a group, the failed cases with the command that tries them again, and one line for all."""
        lines = [f"  {group:<28} {_codes(codes)}" for group, codes in sorted(self.codes.items())]
        for number, tried in self.failed:
            lines.append(f"  FAILED {'; '.join(tried.faults)}: {tried.what} (exit code {tried.code})")
            lines.append(f"    again: tools/attack {self.campaign} --seed {self.seed} --case {number}")
        total = sum(self.codes.values(), Counter())
        lines.append(
            f"{self.campaign}: seed {self.seed}, {self.count} cases in {self.wall_s:.0f} s, {len(self.failed)} failed; "
            f"exit codes {_codes(total)}; slowest {self.slowest_s:.1f} s, at most {self.memory_bytes / 1e6:.0f} MB"
        )
        return "\n".join(lines)


def _codes(codes: Counter) -> str:
    return ", ".join(f"{'hang' if code is None else code}: {count}" for code, count in sorted(codes.items(), key=str))


def try_cases(campaign: Campaign, seed: int, numbers: range, told: bool = False) -> Result:
    """Try the cases of these numbers; `told`: say each on stderr."""
    result = Result(campaign.name, seed)
    begin_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="hilrunner-attack-") as folder:
        shared = Path(folder) / "shared"
        shared.mkdir()
        attempt = campaign.prepare(shared)
        for number in numbers:
            with tempfile.TemporaryDirectory(dir=folder, prefix=f"{number}-") as own:
                tried = attempt(np.random.default_rng([seed, number]), Path(own))
            result.add(number, tried)
            if told:
                print(tried.said, file=sys.stderr)
            if told or tried.faults:
                mark = "FAILED " + "; ".join(tried.faults) if tried.faults else "ok"
                print(
                    f"  {number:5d} {mark}: {tried.what}: exit code {tried.code}, {tried.wall_s:.2f} s", file=sys.stderr
                )
    result.wall_s = time.monotonic() - begin_s
    return result
