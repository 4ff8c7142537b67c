"""The rod: its load, its end stops, and the chambers it opens and closes."""

from hilrunner.base.compiled import inlined
from hilrunner.plant.hydraulics import (
    ABSOLUTE_VACUUM_PA,
    VOID_FLOOR_PA,
    bulk_modulus_of_void,
    softened_bulk_modulus,
    two_sided_stop_force,
)
from hilrunner.plant.load import load_force_and_mass

_VOLUME_FLOOR = 0.05  # of the dead volume: an end stop pressed in further must not turn a volume negative
VOID_ONSET_FLOOR_PA = (
    -0.06e6
)  # gauge; the lowest pressure at which a void begins, so that it has room to grow above vacuum


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
    """Bulk modulus at a pressure, softened where the oil cavitates, and with a void below that; Pa."""
    soft = softened_bulk_modulus(
        pressure_pa,
        prm["bulk_modulus_pa"],
        prm["cavitation_pressure_pa"],
        prm["cavitation_width_pa"],
        prm["cavitation_ratio"],
    )
    onset = max(prm["cavitation_pressure_pa"], VOID_ONSET_FLOOR_PA)
    if pressure_pa < onset and prm["void_pa"] > 0.0:
        return bulk_modulus_of_void(pressure_pa, soft, onset, prm["void_pa"])
    return soft


@inlined
def pressure_rate(prm, pressure_pa, volume_m3, net_flow_m3ps):
    """p' = beta/V times what flows in beyond what the volume grows by; Pa/s.

    A step of an integrator that overshot absolute vacuum is drawn back by the oil's full stiffness once flow comes in: the void's
    own would keep it there.
    """
    rate = stiffness_of_oil(prm, pressure_pa) / volume_m3 * net_flow_m3ps
    if pressure_pa < ABSOLUTE_VACUUM_PA + VOID_FLOOR_PA and prm["void_pa"] > 0.0:
        rate = max(0.0, prm["bulk_modulus_pa"] / volume_m3 * net_flow_m3ps)
    return rate


@inlined
def pressure_rates(prm, position_m, velocity_mps, pressure_1_pa, pressure_2_pa, flow_1_m3ps, flow_2_m3ps):
    """p' = beta/V (q - V') of both chambers, flows positive into the chamber; Pa/s."""
    volume_1, volume_2 = chamber_volumes(prm, position_m)
    rate_1 = pressure_rate(prm, pressure_1_pa, volume_1, flow_1_m3ps - prm["bore_area_m2"] * velocity_mps)
    rate_2 = pressure_rate(prm, pressure_2_pa, volume_2, flow_2_m3ps + prm["rod_side_area_m2"] * velocity_mps)
    return rate_1, rate_2


@inlined
def above_vacuum(prm, pressure_pa):
    """A pressure after an integrator's step: one that overshot absolute vacuum is taken back to it (nothing is, without a void)."""
    if pressure_pa < ABSOLUTE_VACUUM_PA + VOID_FLOOR_PA and prm["void_pa"] > 0.0:
        return ABSOLUTE_VACUUM_PA + VOID_FLOOR_PA
    return pressure_pa


@inlined
def chambers_above_vacuum(context, y):
    """States x, v, p1, p2, ... after a step, chambers not below absolute vacuum; `context` begins with the parameters."""
    prm = context[0]
    return (y[0], y[1], above_vacuum(prm, y[2]), above_vacuum(prm, y[3]), *y[4:])
