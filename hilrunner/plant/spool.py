"""The spool of a counterbalance valve: spring against pilot, friction smoothed around standstill, elastic stops."""

from hilrunner.base.compiled import hot
from hilrunner.plant.hydraulics import opening_ratio, smooth_sign, two_sided_stop_force

_BALANCE_TOLERANCE = 1e-12  # of the ratio speed / friction speed
_BALANCE_LIMIT = 60


@hot
def cbv_conductance(prm, position_m):
    """k_qc a_c(x_c): conductance of the spool's port; m^3/(s sqrt(Pa))."""
    return prm["cbv_si"] * opening_ratio(position_m, prm["spool_stroke_m"])


@hot
def opening_force(prm, pilot_pa, load_pa, back_pa, setting_pa):
    """What opens the spool against its preload: A_c (gamma p_pilot + p_load - setting - back pressure); N."""
    back = prm["back_pressure_share"] * (1.0 + prm["pilot_ratio"]) * back_pa
    return prm["spool_area_m2"] * (prm["pilot_ratio"] * pilot_pa + load_pa - setting_pa - back)


@hot
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


@hot
def mass_free_spool_speed(prm, opening_force_n, position_m):
    """Speed of a spool without mass: the root of the same force balance with m_c = 0; m/s."""
    elastic = two_sided_stop_force(position_m, 0.0, prm["spool_stroke_m"], prm["spool_stop_stiffness_npm"], 0.0)
    driving = opening_force_n - prm["spool_spring_npm"] * position_m + elastic
    damping = prm["spool_damping_nspm"]
    pushed = damping + prm["spool_stop_damping_spm"] * abs(elastic)
    # the stop damps only while it pushes: not when the spool leaves faster than the stop can follow
    speed = _speed_against_friction(prm, driving, pushed)
    if elastic != 0.0 and elastic - (pushed - damping) * speed < 0.0 < elastic:
        speed = _speed_against_friction(prm, driving - elastic, damping)
    elif elastic != 0.0 and elastic - (pushed - damping) * speed > 0.0 > elastic:
        speed = _speed_against_friction(prm, driving - elastic, damping)
    return speed


@hot
def _speed_against_friction(prm, driving_n, damping_nspm):
    """The speed w with damping * w + f_c tanh(w / v_s) = driving force: Newton from below, monotone."""
    scale = prm["friction_speed_mps"]
    friction = prm["spool_friction_n"]
    viscous = damping_nspm * scale
    size = abs(driving_n)
    # both bounds hold because tanh z <= min(z, 1); the left side is concave, so Newton never overshoots the root
    ratio = max(size / (viscous + friction), (size - friction) / viscous)
    if ratio < 20.0:
        for _ in range(_BALANCE_LIMIT):
            sign = smooth_sign(ratio)
            step = (size - viscous * ratio - friction * sign) / (viscous + friction * (1.0 - sign * sign))
            ratio += step
            if not step > _BALANCE_TOLERANCE * (1.0 + ratio):
                break
    return scale * ratio if driving_n >= 0.0 else -scale * ratio
