"""Elements of a hydraulic circuit: pure functions in SI, one idea each, shared by every right-hand side and residual."""

import math

from hilrunner.base.compiled import inlined
from hilrunner.plant.tanh import tanh_of_size

_SATURATED = 20.0  # tanh(20) is 1 to the last bit
_SERIES = 0.03  # below it four terms of the series are exact to rounding
ABSOLUTE_VACUUM_PA = -101325.0  # gauge
VOID_FLOOR_PA = 1.0  # absolute; below it an integrator's step has overshot, and the void is as thin as here


@inlined
def orifice_root(drop_pa, transition_pa):
    """Odd square root of a pressure drop with a laminar core: dp / (dp^2 + p_tr^2)^(1/4), in sqrt(Pa)."""
    return drop_pa / math.sqrt(math.sqrt(drop_pa * drop_pa + transition_pa * transition_pa))


@inlined
def orifice_root_and_slope(drop_pa, transition_pa):
    """orifice_root and its derivative, in sqrt(Pa) and 1/sqrt(Pa)."""
    square = drop_pa * drop_pa
    inverse = 1.0 / math.sqrt(math.sqrt(square + transition_pa * transition_pa))
    half = inverse * inverse
    return drop_pa * inverse, inverse * (1.0 - 0.5 * square * half * half)


@inlined
def inverse_orifice_root(root, transition_pa):
    """The drop whose orifice_root is `root`, in Pa (closed form: a quadratic in the square of the drop)."""
    square = root * root
    fourth = square * square
    squared_drop = 0.5 * (fourth + math.sqrt(fourth * (fourth + 4.0 * transition_pa * transition_pa)))
    return math.copysign(math.sqrt(squared_drop), root)


@inlined
def smoothstep(share):
    """3 s^2 - 2 s^3 between 0 and 1, constant outside: once continuously differentiable."""
    if share <= 0.0:
        return 0.0
    if share >= 1.0:
        return 1.0
    return share * share * (3.0 - 2.0 * share)


@inlined
def smoothstep_slope(share):
    """Derivative of smoothstep."""
    if share <= 0.0 or share >= 1.0:
        return 0.0
    return 6.0 * share * (1.0 - share)


@inlined
def smooth_sign(ratio):
    """tanh to rounding (absolute error below 3e-16; near rest relative), at the cost of one division or none."""
    size = abs(ratio)
    if size < _SERIES:
        square = ratio * ratio
        return ratio * (
            1.0 - square * (1.0 / 3.0 - square * (2.0 / 15.0 - square * (17.0 / 315.0 - square * (62.0 / 2835.0))))
        )
    if size > _SATURATED:
        return math.copysign(1.0, ratio)
    return math.copysign(tanh_of_size(size), ratio)


@inlined
def softened_bulk_modulus(pressure_pa, bulk_modulus_pa, cavitation_pa, width_pa, ratio):
    """Bulk modulus that falls to `ratio` of itself below the cavitation pressure: a function of state, conserves oil."""
    depth = (pressure_pa - cavitation_pa) / width_pa
    if depth > _SATURATED:
        return bulk_modulus_pa
    return bulk_modulus_pa * (ratio + (1.0 - ratio) * 0.5 * (1.0 + smooth_sign(depth)))


@inlined
def bulk_modulus_of_void(pressure_pa, soft_pa, onset_pa, void_pa):
    """Bulk modulus of softened oil with a void in it, below the pressure where the void begins; Pa.

    The void is gas that comes out of the oil below the onset. Far below it takes the share `void_pa` / a of the oil's volume at an absolute
    pressure a, Boyle's law for a constant amount; its compliance void_pa (1/a - 1/a_onset)^2 begins with the value and slope zero. So no
    finite growth of a chamber reaches absolute vacuum, and the void must be filled again before the pressure rises: a function of
    state, conserves oil.

    Args:
        pressure_pa: gauge, below `onset_pa`. soft_pa: bulk modulus of the oil itself there. onset_pa: gauge.
        void_pa: volume share of the gas times its absolute pressure, > 0.
    """
    above_vacuum = max(pressure_pa - ABSOLUTE_VACUUM_PA, VOID_FLOOR_PA)
    onset = onset_pa - ABSOLUTE_VACUUM_PA
    thinned = onset / above_vacuum - 1.0
    # the compliances of oil and void add
    return soft_pa / (1.0 + soft_pa * void_pa / (onset * onset) * thinned * thinned)


@inlined
def stop_force(depth_m, rate_mps, stiffness_npm, damping_spm):
    """Push of a one-sided Hunt-Crossley stop: k d (1 + c d'), never a pull, nothing when not touched; N."""
    if depth_m <= 0.0:
        return 0.0
    return max(0.0, stiffness_npm * depth_m * (1.0 + damping_spm * rate_mps))


@inlined
def two_sided_stop_force(position_m, velocity_mps, travel_m, stiffness_npm, damping_spm):
    """Force of the stops at 0 and at `travel_m`, positive in the direction of the position; N."""
    if position_m < 0.0:
        return stop_force(-position_m, -velocity_mps, stiffness_npm, damping_spm)
    if position_m > travel_m:
        return -stop_force(position_m - travel_m, velocity_mps, stiffness_npm, damping_spm)
    return 0.0


@inlined
def opening_ratio(position_m, stroke_m):
    """Share of the full port a counterbalance spool has opened: s^2 (2 - s), a V-notch start; 0..1."""
    share = min(max(position_m / stroke_m, 0.0), 1.0)
    return share * share * (2.0 - share)


@inlined
def check_opening(drop_pa, crack_pa, range_pa):
    """Opening of a check valve, 0..1, from its cracking drop over `range_pa`."""
    return smoothstep((drop_pa - crack_pa) / range_pa)
