"""Drawn profiles: every key of the format, most within its range, some far beyond, some of the wrong kind."""

from pathlib import Path

import numpy as np

from tests.attack.bench import warm_up
from tests.attack.campaign import Attempt, Campaign, Tried
from tests.attack.outcome import call
from tests.tools.drawn_profiles import Drawing


def prepare(folder: Path) -> Attempt:
    """`check` of each."""
    warm_up(folder)

    def attempt(rng: np.random.Generator, own: Path) -> Tried:
        wrong = (0.002, 0.02, 0.2)[rng.integers(3)]
        profile = own / "drawn.toml"
        profile.write_text(Drawing(rng, wrong).text(), encoding="utf-8")
        outcome = call(["check", str(profile)])
        faults = outcome.faults()
        if outcome.code not in (0, 2):
            faults.append("an exit code that `check` does not have")
        group = f"{wrong:.1%} of values spoilt"
        return Tried(
            "check of a drawn profile",
            group,
            outcome.code,
            faults,
            outcome.wall_s,
            outcome.memory_bytes,
            outcome.err[-4000:],
        )

    return attempt


PROFILES = Campaign("profiles", "profiles drawn over every key of the format", 1000, prepare)
