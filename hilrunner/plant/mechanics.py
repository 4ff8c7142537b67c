"""The rod: its load, its end stops, and the chambers it opens and closes."""

from hilrunner.base.compiled import inlined
from hilrunner.plant.hydraulics import softened_bulk_modulus, two_sided_stop_force
from hilrunner.plant.load import load_force_and_mass

_VOLUME_FLOOR = 0.05  # of the dead volume: an end stop pressed in further must not turn a volume negative


@inlined
def rod_acceleration(prm, load, load_scale, position_m, velocity_mps, pressure_1_pa, pressure_2_pa):
    """M(x) v' = A1 p1 - A2 p2 - C v - s F_L(x) - M'(x) v^2 / 2 + stops; m/s^2.

    `load` is a plant.load.LOAD record; `load_scale` is s.
    The M' term is Lagrange's for an equivalent mass that depends on x.
    """
    load_n, load_mass, mass_slope = load_force_and_mass(load, position_m)
    force = (
        prm["bore_area_m2"] * pressure_1_pa
        - prm["rod_side_area_m2"] * pressure_2_pa
        - prm["viscous_friction_nspm"] * velocity_mps
        - load_scale * load_n
        + two_sided_stop_force(
            position_m,
            velocity_mps,
            prm["stroke_m"],
            prm["end_stop_stiffness_npm"],
            prm["end_stop_damping_spm"],
        )
    )
    force -= 0.5 * mass_slope * velocity_mps * velocity_mps
    return force / (prm["mass_kg"] + load_mass)


@inlined
def chamber_volumes(prm, position_m):
    """Volumes of chamber 1 and 2 with their dead volumes; m^3."""
    volume_1 = prm["dead_volume_1_m3"] + prm["bore_area_m2"] * position_m
    volume_2 = prm["dead_volume_2_m3"] + prm["rod_side_area_m2"] * (prm["stroke_m"] - position_m)
    floor_1 = _VOLUME_FLOOR * prm["dead_volume_1_m3"]
    floor_2 = _VOLUME_FLOOR * prm["dead_volume_2_m3"]
    return max(volume_1, floor_1), max(volume_2, floor_2)


@inlined
def stiffness_of_oil(prm, pressure_pa):
    """Bulk modulus at a pressure, softened where the oil cavitates; Pa."""
    return softened_bulk_modulus(
        pressure_pa,
        prm["bulk_modulus_pa"],
        prm["cavitation_pressure_pa"],
        prm["cavitation_width_pa"],
        prm["cavitation_ratio"],
    )


@inlined
def pressure_rates(prm, position_m, velocity_mps, pressure_1_pa, pressure_2_pa, flow_1_m3ps, flow_2_m3ps):
    """p' = beta/V (q - V') of both chambers, flows positive into the chamber; Pa/s."""
    volume_1, volume_2 = chamber_volumes(prm, position_m)
    rate_1 = stiffness_of_oil(prm, pressure_1_pa) / volume_1 * (flow_1_m3ps - prm["bore_area_m2"] * velocity_mps)
    rate_2 = stiffness_of_oil(prm, pressure_2_pa) / volume_2 * (flow_2_m3ps + prm["rod_side_area_m2"] * velocity_mps)
    return rate_1, rate_2
