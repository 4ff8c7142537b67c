"""The stability limit of a plant, kept on disk: some 500 Jacobians take a tenth of a start and never change for the same plant.

Key: hash of everything the limit depends on, the compiled plant's own sources included. A file that cannot be read or
written costs the computation and nothing else.
"""

import contextlib
import hashlib
import math
import os
import tempfile
from pathlib import Path

from hilrunner.base.compiled import cache_folder
from hilrunner.plant.stability import SAFETY, spools_have_no_mass
from hilrunner.plant.step import AxisPlant, stability_limit_s


def stored_stability_limit_s(plant: AxisPlant) -> float:
    """`plant.stability.stability_limit_s`, from the store if it is there; s."""
    path = _place(plant)
    with contextlib.suppress(OSError, ValueError):
        limit_s = float.fromhex(path.read_text())
        if limit_s > 0.0:
            return limit_s
    limit_s = stability_limit_s(plant)
    _keep(path, limit_s)
    return limit_s


def stored_substep_count(plant: AxisPlant, period_s: float) -> int:
    """Fewest RK4 steps a period that keep SAFETY below the stability limit."""
    return max(1, math.ceil(period_s / (SAFETY * stored_stability_limit_s(plant))))


def _place(plant: AxisPlant) -> Path:
    digest = hashlib.sha256()
    words = (plant.circuit, bool(spools_have_no_mass(plant)), *plant.position_limits_m)
    digest.update(repr(words).encode())
    digest.update(plant.parameters.tobytes())
    digest.update(plant.load.record().tobytes())
    return cache_folder("plant") / "stability" / digest.hexdigest()[:32]


def _keep(path: Path, limit_s: float) -> None:
    """Whole or not at all: two runs may start at once."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "w") as file:
            file.write(limit_s.hex())
        os.replace(name, path)
