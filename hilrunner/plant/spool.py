"""The spool of a counterbalance valve: spring against pilot, friction smoothed around standstill, elastic stops."""

from hilrunner.base.compiled import inlined
from hilrunner.plant.hydraulics import opening_ratio, smooth_sign, two_sided_stop_force

# of the ratio speed / friction speed; the step is taken, so what is left is at most about twice its cube: below 1e-11
_BALANCE_TOLERANCE = 5e-5
_CURVATURE_LIMIT = 0.5  # beyond it the parabola of a step means nothing, and the tangent serves
_SATURATED = 20.0  # friction is constant to the last bit above
_BALANCE_LIMIT = 60


@inlined
def cbv_conductance(prm, position_m):
    """k_qc a_c(x_c): conductance of the spool's port; m^3/(s sqrt(Pa))."""
    return prm["cbv_si"] * opening_ratio(position_m, prm["spool_stroke_m"])


@inlined
def opening_force(prm, pilot_pa, load_pa, back_pa, setting_pa):
    """What opens the spool against its preload: A_c (gamma p_pilot + p_load - setting - back pressure); N."""
    back = prm["back_pressure_share"] * (1.0 + prm["pilot_ratio"]) * back_pa
    return prm["spool_area_m2"] * (prm["pilot_ratio"] * pilot_pa + load_pa - setting_pa - back)


@inlined
def spool_acceleration(prm, opening_force_n, position_m, velocity_mps):
    """Second-order spool: m_c w' = opening force - k_c x - c_c w - f_c tanh(w / v_s) + stops; m/s^2."""
    force = (
        opening_force_n
        - prm["spool_spring_npm"] * position_m
        - prm["spool_damping_nspm"] * velocity_mps
        - prm["spool_friction_n"] * smooth_sign(velocity_mps / prm["friction_speed_mps"])
        + two_sided_stop_force(
            position_m,
            velocity_mps,
            prm["spool_stroke_m"],
            prm["spool_stop_stiffness_npm"],
            prm["spool_stop_damping_spm"],
        )
    )
    return force / prm["spool_mass_kg"]


@inlined
def mass_free_spool_speed(prm, opening_force_n, position_m):
    """Speed of a spool without mass: the root of the same force balance with m_c = 0; m/s."""
    return prm["friction_speed_mps"] * mass_free_spool_ratio(prm, opening_force_n, position_m, 0.0)


@inlined
def mass_free_spool_ratio(prm, opening_force_n, position_m, guess):
    """mass_free_spool_speed over the friction speed v_s, from a guess of it (any number)."""
    elastic = two_sided_stop_force(position_m, 0.0, prm["spool_stroke_m"], prm["spool_stop_stiffness_npm"], 0.0)
    driving = opening_force_n - prm["spool_spring_npm"] * position_m + elastic
    viscous = prm["spool_damping_nspm"] * prm["friction_speed_mps"]
    friction = prm["spool_friction_n"]
    if elastic == 0.0:
        return _speed_ratio(driving, viscous, friction, guess)
    # the stop damps while it pushes, and never pulls: a spool that leaves faster than the stop follows is free of it
    damping = prm["spool_stop_damping_spm"] * abs(elastic) * prm["friction_speed_mps"]
    ratio = _speed_ratio(driving, viscous + damping, friction, guess)
    push = elastic - damping * ratio
    if push * elastic < 0.0:
        ratio = _speed_ratio(driving - elastic, viscous, friction, ratio)
    return ratio


@inlined
def _speed_ratio(driving_n, viscous_n, friction_n, guess):
    """The z with viscous z + f_c tanh z = driving force: Halley's method, from the guess where it helps."""
    size = abs(driving_n)
    # a bound from below because tanh z <= min(z, 1): the larger of size / (viscous + f_c) and (size - f_c) / viscous
    steep = viscous_n + friction_n
    bound = size / steep if size <= steep else (size - friction_n) / viscous_n
    ratio = bound
    if bound < _SATURATED:
        ratio = max(bound, guess if driving_n >= 0.0 else -guess)
        for _ in range(_BALANCE_LIMIT):
            sign = smooth_sign(ratio)
            fall = friction_n * (1.0 - sign * sign)
            slope = viscous_n + fall
            excess = size - viscous_n * ratio - friction_n * sign
            square = slope * slope
            bend = excess * sign * fall  # the curvature's part of Halley's step, times slope^2
            step = excess * slope / (square - bend) if bend < _CURVATURE_LIMIT * square else excess / slope
            ratio = max(ratio + step, bound)
            if abs(step) <= _BALANCE_TOLERANCE * (1.0 + ratio):
                break
    return ratio if driving_n >= 0.0 else -ratio
