"""Could an injected load press the rod so deep into its stop that a chamber is emptied? Then the state would leave the finite numbers."""

import numpy as np

from hilrunner.base.errors import ProfileError
from hilrunner.base.units import M_PER_MM, N_PER_KN
from hilrunner.plant.step import AxisPlant
from hilrunner.setup.profile import LoadedProfile

_SUDDEN = 2.0  # a load that comes at once goes twice as deep as one that rests
_ROOM = 0.5  # of a dead volume, as plant.model keeps free of a stalled rod


def check_load_faults(loaded: LoadedProfile, plants: list[AxisPlant]) -> None:
    """ProfileError for a load factor that no stop of the axis could bear."""
    names = [axis.name for axis in loaded.profile.axis]
    for index, fault in enumerate(loaded.profile.fault):
        if fault.kind != "load-factor":
            continue
        factor = fault.load_factor if fault.value is None else fault.value
        plant = plants[names.index(fault.axis)]
        largest_n = float(np.abs(plant.load.force_n).max())
        force_n = abs(factor or 0.0) * largest_n
        borne_n = _borne_n(plant)
        if force_n > borne_n:
            raise ProfileError(
                f"{loaded.path}: fault[{index}].load_factor",
                f"{factor:g} times {largest_n / N_PER_KN:.0f} kN presses the rod "
                f"{_SUDDEN * force_n / float(plant.parameters['end_stop_stiffness_npm'][0]) / M_PER_MM:.2g} mm into a stop, "
                "where a chamber is empty",
                f"up to {borne_n / largest_n:.3g} either way",
                "a smaller factor, larger dead volumes, or stiffer stops",
            )


def _borne_n(plant: AxisPlant) -> float:
    prm = plant.parameters[0]
    low, high = plant.position_limits_m
    depths = [np.inf]
    if low <= 0.0:
        depths.append(_ROOM * prm["dead_volume_1_m3"] / prm["bore_area_m2"])
    if high >= prm["stroke_m"]:
        depths.append(_ROOM * prm["dead_volume_2_m3"] / prm["rod_side_area_m2"])
    return float(min(depths) * prm["end_stop_stiffness_npm"] / _SUDDEN)
