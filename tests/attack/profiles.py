"""Drawn profiles and spoilt networks: every key of the format, most within its range, some far beyond, some of the wrong kind."""

import re
from pathlib import Path

import numpy as np

from hilrunner.setup import resources
from hilrunner.setup.profile import load_profile
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
        profile.write_text(_drawn(rng, wrong), encoding="utf-8")
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


def _drawn(rng: np.random.Generator, wrong: float) -> str:
    while True:
        try:
            return Drawing(rng, wrong).text()
        except TypeError:  # a table was spoilt that the drawing itself writes into: draw again
            continue


def prepare_networks(folder: Path) -> Attempt:
    """`check` of a bench whose network is a shipped one with bytes changed, left out or doubled."""
    warm_up(folder)
    models = sorted((resources.profiles_folder() / "models").glob("lift-*.onnx"))  # what the profile's circuit takes
    texts = [load_profile(name).text for name in ("amc-lift",)]

    def attempt(rng: np.random.Generator, own: Path) -> Tried:
        model = models[rng.integers(len(models))]
        data = bytearray(model.read_bytes())
        kind = ("bytes", "bytes", "cut", "doubled", "noise")[rng.integers(5)]
        if kind == "bytes":
            for place in rng.integers(len(data), size=int(rng.integers(1, 4))):
                data[place] = int(rng.integers(256))
        elif kind == "cut":
            del data[int(rng.integers(len(data))) :]
        elif kind == "doubled":
            start = int(rng.integers(len(data)))
            data[start:start] = data[max(0, start - int(rng.integers(1, 5000))) : start] * int(rng.integers(1, 4))
        else:
            data[: int(rng.integers(1, 2000))] = rng.bytes(int(rng.integers(1, 2000)))
        (own / "spoilt.onnx").write_bytes(data)
        profile = own / "spoilt.toml"
        profile.write_text(re.sub(r'^model = ".*"$', 'model = "spoilt.onnx"', texts[0], flags=re.MULTILINE))
        outcome = call(["check", str(profile), "--engine", str(rng.choice(["surrogate", "onnx"]))])
        faults = outcome.faults()
        if outcome.code not in (0, 2):
            faults.append("an exit code that `check` does not have")
        what = f"check of {model.name}, {kind}"
        return Tried(what, kind, outcome.code, faults, outcome.wall_s, outcome.memory_bytes, outcome.err[-4000:])

    return attempt


NETWORKS = Campaign("networks", "shipped networks with bytes changed, left out, doubled", 500, prepare_networks)
PROFILES = Campaign("profiles", "profiles drawn over every key of the format", 1000, prepare)
