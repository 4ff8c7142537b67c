"""Does a load know every position the rod can take? Beyond its ends it goes on as a straight line, which nobody measured.

A warning, no refusal: a table measured short of the ends is common, and logs of such benches must stay replayable.
"""

import numpy as np

from hilrunner.base.units import M_PER_MM, N_PER_KN
from hilrunner.plant.load import LoadTable
from hilrunner.plant.step import AxisPlant
from hilrunner.setup.profile import LoadedProfile

_CLOSE_M = 1e-9


def load_warnings(loaded: LoadedProfile, plants: list[AxisPlant]) -> list[str]:
    """One sentence for every axis whose load ends short of where its rod may be: place, value, limit, remedy."""
    found = []
    for index, (axis, plant) in enumerate(zip(loaded.profile.axis, plants, strict=True)):
        if axis.load.kind == "constant":
            continue
        whole_stroke = plant.position_range_m is None
        low_m, high_m = (0.0, float(plant.parameters["stroke_m"][0])) if whole_stroke else plant.position_range_m
        invented = _invented(plant.load, low_m, high_m)
        if not invented:
            continue
        knots = plant.load.knots_m / M_PER_MM
        remedy = "give the load up to both ends" + (
            ", or say with position_range_mm where the rod is meant to be" if whole_stroke else ""
        )
        found.append(
            f"{loaded.path}: axis[{index}].load: {knots[0]:g} to {knots[-1]:g} mm do not span "
            f"{'the stroke' if whole_stroke else 'position_range_mm'}, {low_m / M_PER_MM:g} to {high_m / M_PER_MM:g} mm; "
            f"beyond, it goes on as a straight line to {' and '.join(invented)}; remedy: {remedy}"
        )
    return found


def _invented(load: LoadTable, low_m: float, high_m: float) -> list[str]:
    """The forces at the ends that the load does not reach."""
    ends = []
    for position_m, knot, row in ((low_m, 0, 0), (high_m, -1, -1)):
        beyond_m = position_m - load.knots_m[knot]
        if np.sign(beyond_m) == (1 if knot else -1) and abs(beyond_m) > _CLOSE_M:
            force_n = load.coefficients[row, 0] + beyond_m * load.coefficients[row, 1]
            ends.append(f"{force_n / N_PER_KN:.1f} kN at {position_m / M_PER_MM:g} mm")
    return ends
