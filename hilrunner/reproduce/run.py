"""All parts in order, and the whole reproduction as one thing to print."""

import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hilrunner import __version__
from hilrunner.reproduce.heldout import heldout_part
from hilrunner.reproduce.holding import creep_part
from hilrunner.reproduce.memory import memory_part
from hilrunner.reproduce.models import LIFT_FLOW, PAPER_FLOW, PAPER_RATES, Models
from hilrunner.reproduce.networks import networks_part
from hilrunner.reproduce.rows import Part, Row
from hilrunner.reproduce.timing import time_part
from hilrunner.reproduce.trajectories import lift_part, overrun_part, paper_part

PARTS: dict[str, Callable[[Models, bool], Part]] = {
    "paper": paper_part,
    "lift": lift_part,
    "overrun": overrun_part,
    "creep": creep_part,
    "networks": networks_part,
    "time": time_part,
    "memory": memory_part,
    "heldout": heldout_part,
}
Say = Callable[[str], None]


@dataclass(frozen=True)
class Reproduction:
    """Everything one call measured."""

    parts: list[Part]
    quick: bool
    models: Models
    wall_s: float

    @property
    def rows(self) -> list[Row]:
        """The rows of all parts."""
        return [row for part in self.parts for row in part.rows]

    def with_must(self, held: bool) -> list[Row]:
        """Rows whose must holds, or does not."""
        return [row for row in self.rows if row.meets(row.must) is held]

    def musts(self) -> str:
        """How many musts hold, in words."""
        held, broken = len(self.with_must(True)), len(self.with_must(False))
        return f"{held} of {held + broken} musts hold" if held + broken else "no row of these parts has a must"

    def facts(self) -> dict[str, str]:
        """What made the numbers."""
        import numba

        return {
            "hilrunner": __version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "numba": numba.__version__,
            "machine": platform.machine(),
            **{f"model {name}": f"sha256 {self.models.sha256(name)}" for name in (PAPER_FLOW, LIFT_FLOW, PAPER_RATES)},
            "size": "quick: shorter cases" if self.quick else "full",
            "taken": f"{self.wall_s:.0f} s",
        }

    def as_dict(self) -> dict:
        """For JSON."""
        return {
            "facts": self.facts(),
            "quick": self.quick,
            "parts": [part.as_dict() for part in self.parts],
            "musts_met": [row.key for row in self.with_must(True)],
            "musts_not_met": [row.key for row in self.with_must(False)],
            "wall_s": self.wall_s,
        }


def reproduce(
    models: Models,
    names: Sequence[str],
    quick: bool,
    train: Callable[[Models, bool], Part] | None = None,
    say: Say = lambda text: None,
) -> Reproduction:
    """Run parts by name; `train` comes last where it is wanted. `say` is told what begins."""
    begin_s = time.monotonic()
    chosen = [(name, PARTS[name]) for name in PARTS if name in names]
    if train is not None:
        chosen.append(("training", train))
    parts = []
    for count, (name, part_of) in enumerate(chosen, start=1):
        say(f"{name} ({count} of {len(chosen)})")
        part_begin_s = time.monotonic()
        part = part_of(models, quick)
        part.wall_s = time.monotonic() - part_begin_s
        parts.append(part)
    return Reproduction(parts, quick, models, time.monotonic() - begin_s)
