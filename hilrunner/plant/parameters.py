"""Constants of one actuator: a declared table from profile keys in engineering units to SI fields, and the presets."""

from dataclasses import dataclass

import numpy as np

from hilrunner.base import units
from hilrunner.base.errors import ProfileError

_TABLE_1 = "article, Table 1"
_TABLE_2 = "article, Table 2"
_PROPOSED = "proposed, docs/paper.md"
_ORIFICE = units.ORIFICE_SI_PER_MM3_SQRT_MPA


@dataclass(frozen=True)
class ParameterSpec:
    """One constant: its SI field, its profile key, the factor from the key's unit to SI, and what is allowed."""

    field: str  # SI name in PARAMETERS
    key: str  # name in a profile; the unit is its end
    factor: float  # SI value = factor * profile value
    minimum: float  # in the key's unit, allowed
    maximum: float
    source: str
    doc: str


def _row(field: str, key: str, factor: float, minimum: float, maximum: float, source: str, doc: str) -> ParameterSpec:
    return ParameterSpec(field, key, factor, minimum, maximum, source, doc)


SPEC: tuple[ParameterSpec, ...] = (
    # cylinder
    _row("bore_area_m2", "bore_area_mm2", 1e-6, 10.0, 1e7, _TABLE_1, "piston area of chamber 1, A1"),
    _row("rod_side_area_m2", "rod_side_area_mm2", 1e-6, 10.0, 1e7, _TABLE_1, "annulus area of chamber 2, A2"),
    _row("stroke_m", "stroke_mm", 1e-3, 1.0, 2e4, _TABLE_2, "rod travel, L"),
    _row("mass_kg", "mass_kg", 1.0, 0.1, 1e7, _TABLE_1, "moving parts, M; the load's own inertia comes on top"),
    _row("viscous_friction_nspm", "viscous_friction_nspmm", 1e3, 0.0, 1e6, _TABLE_1, "C"),
    _row("dead_volume_1_m3", "dead_volume_1_mm3", 1e-9, 1.0, 1e10, _PROPOSED, "chamber 1 at x = 0, V1d"),
    _row("dead_volume_2_m3", "dead_volume_2_mm3", 1e-9, 1.0, 1e10, _PROPOSED, "chamber 2 at x = L, V2d"),
    _row("end_stop_stiffness_npm", "end_stop_stiffness_npmm", 1e3, 1e3, 1e9, _PROPOSED, "k_end"),
    _row("end_stop_damping_spm", "end_stop_damping_spmm", 1e3, 0.0, 1.0, _PROPOSED, "d_end, Hunt-Crossley"),
    _row("rest_pressure_2_pa", "rest_pressure_2_mpa", 1e6, 0.0, 50.0, _PROPOSED, "chamber 2 in the state of rest"),
    # oil
    _row("bulk_modulus_pa", "bulk_modulus_mpa", 1e6, 10.0, 5e3, _TABLE_1, "effective, beta"),
    _row("cavitation_pressure_pa", "cavitation_pressure_mpa", 1e6, -0.1, 0.0, _PROPOSED, "oil half softened"),
    _row("cavitation_width_pa", "cavitation_width_mpa", 1e6, 1e-3, 0.1, _PROPOSED, "width of the softening"),
    _row("cavitation_ratio", "cavitation_ratio", 1.0, 1e-6, 1.0, _PROPOSED, "beta left below the vapour pressure"),
    _row(
        "void_pa",
        "void_mpa",
        1e6,
        0.0,
        0.01,
        _PROPOSED,
        "share of gas in the oil times its absolute pressure; 0: no void",
    ),
    _row("transition_pressure_pa", "transition_pressure_mpa", 1e6, 1e-5, 1.0, _PROPOSED, "laminar-turbulent, p_tr"),
    _row("supply_pressure_pa", "supply_pressure_mpa", 1e6, 0.1, 100.0, _TABLE_1, "p_s"),
    _row("tank_pressure_pa", "tank_pressure_mpa", 1e6, 0.0, 10.0, _PROPOSED, "p_t"),
    # directional valve: supply edges P->A, P->B, return edges A->T, B->T, centre bleed
    _row("valve_pa_si", "valve_pa_mm3ps_sqrtmpa", _ORIFICE, 1.0, 1e9, _TABLE_1, "full opening, k_q"),
    _row("valve_bt_si", "valve_bt_mm3ps_sqrtmpa", _ORIFICE, 1.0, 1e9, _PROPOSED, "4.5 k_q restores Table 2"),
    _row(
        "valve_pb_si", "valve_pb_mm3ps_sqrtmpa", _ORIFICE, 1.0, 1e9, _PROPOSED, "0.5 k_q: lowering as fast as lifting"
    ),
    _row("valve_at_si", "valve_at_mm3ps_sqrtmpa", _ORIFICE, 1.0, 1e9, _PROPOSED, "4.5 k_q"),
    _row("bleed_si", "bleed_mm3ps_sqrtmpa", _ORIFICE, 1.0, 1e9, _PROPOSED, "centre position vents A and B to tank"),
    _row("bleed_range", "bleed_range", 1.0, 1e-3, 0.5, _PROPOSED, "command at which the bleed has closed"),
    _row("series_floor_si", "series_floor_mm3ps_sqrtmpa", _ORIFICE, 1e-6, 1e3, _PROPOSED, "eps of orifices in series"),
    # counterbalance valves; 1: bore side (A), 2: rod side (B)
    _row("cbv_si", "cbv_mm3ps_sqrtmpa", _ORIFICE, 1.0, 1e9, _TABLE_1, "full opening, k_qc"),
    _row("pilot_ratio", "pilot_ratio", 1.0, 0.0, 20.0, _TABLE_1, "gamma"),
    _row("setting_1_pa", "setting_1_mpa", 1e6, 0.1, 100.0, _PROPOSED, ">= 1.3 x the holding pressure"),
    _row("setting_2_pa", "setting_2_mpa", 1e6, 0.1, 100.0, _PROPOSED, "gamma x the minimum opening pressure 1.7 MPa"),
    _row("spool_area_m2", "spool_area_mm2", 1e-6, 0.1, 1e4, _PROPOSED, "A_c"),
    _row("spool_stroke_m", "spool_stroke_mm", 1e-3, 0.1, 100.0, _PROPOSED, "x_cmax"),
    _row("spool_mass_kg", "spool_mass_kg", 1.0, 1e-4, 10.0, _TABLE_1, "m_c"),
    _row("spool_damping_nspm", "spool_damping_nspmm", 1e3, 1e-6, 1e3, _TABLE_1, "c_c"),
    _row("spool_spring_npm", "spool_spring_npmm", 1e3, 1e-3, 1e5, _TABLE_1, "k_c"),
    _row("spool_friction_n", "spool_friction_n", 1.0, 0.0, 1e4, _TABLE_1, "f_c"),
    _row("friction_speed_mps", "friction_speed_mmps", 1e-3, 1e-3, 1e3, _PROPOSED, "v_s; part of the model"),
    _row("spool_stop_stiffness_npm", "spool_stop_stiffness_npmm", 1e3, 1.0, 1e7, _PROPOSED, "k_st"),
    _row("spool_stop_damping_spm", "spool_stop_damping_spmm", 1e3, 0.0, 10.0, _PROPOSED, "d_st, Hunt-Crossley"),
    _row("back_pressure_share", "back_pressure_share", 1.0, 0.0, 1.0, _PROPOSED, "0 vented, 1 not vented"),
    # check, anti-cavitation and relief valves, lines
    _row("check_si", "check_mm3ps_sqrtmpa", _ORIFICE, 1.0, 1e9, _PROPOSED, "free flow into the chamber, K_ck"),
    _row("check_crack_pa", "check_crack_mpa", 1e6, 0.0, 5.0, _PROPOSED, "p_ck"),
    _row("check_range_pa", "check_range_mpa", 1e6, 1e-3, 5.0, _PROPOSED, "from closed to open, dp_ck"),
    _row("anticavitation_si", "anticavitation_mm3ps_sqrtmpa", _ORIFICE, 0.0, 1e9, _PROPOSED, "K_ac"),
    _row("anticavitation_crack_pa", "anticavitation_crack_mpa", 1e6, 0.0, 1.0, _PROPOSED, "below tank"),
    _row("anticavitation_range_pa", "anticavitation_range_mpa", 1e6, 1e-3, 1.0, _PROPOSED, "closed to open"),
    _row("relief_pressure_pa", "relief_pressure_mpa", 1e6, 0.1, 200.0, _PROPOSED, "p_rv"),
    _row("relief_m3pspa", "relief_mm3ps_mpa", 1e-15, 0.0, 1e9, _PROPOSED, "G_rv"),
    _row("line_volume_a_m3", "line_volume_a_mm3", 1e-9, 1.0, 1e10, _PROPOSED, "V_A of lift-lines"),
    _row("line_volume_b_m3", "line_volume_b_mm3", 1e-9, 1.0, 1e10, _PROPOSED, "V_B of lift-lines"),
)

SPEC_BY_KEY = {row.key: row for row in SPEC}
PARAMETERS = np.dtype([(row.field, "f8") for row in SPEC])

_K_Q = 4.057e5  # Table 1

_PAPER: dict[str, float] = {
    "bore_area_mm2": 80424.8,
    "rod_side_area_mm2": 49008.8,
    "stroke_mm": 2000.0,
    "mass_kg": 200.0,
    "viscous_friction_nspmm": 1.0,
    "dead_volume_1_mm3": 1e6,
    "dead_volume_2_mm3": 1e6,
    "end_stop_stiffness_npmm": 2e6,
    "end_stop_damping_spmm": 1e-3,
    "rest_pressure_2_mpa": 0.5,
    "bulk_modulus_mpa": 690.0,
    "cavitation_pressure_mpa": -0.05,
    "cavitation_width_mpa": 0.02,
    "cavitation_ratio": 1e-3,
    "void_mpa": 1e-4,
    "transition_pressure_mpa": 0.01,
    "supply_pressure_mpa": 30.0,
    "tank_pressure_mpa": 0.0,
    "valve_pa_mm3ps_sqrtmpa": _K_Q,
    "valve_bt_mm3ps_sqrtmpa": 4.5 * _K_Q,
    "valve_pb_mm3ps_sqrtmpa": 0.5 * _K_Q,
    "valve_at_mm3ps_sqrtmpa": 4.5 * _K_Q,
    "bleed_mm3ps_sqrtmpa": 0.2 * _K_Q,
    "bleed_range": 0.05,
    "series_floor_mm3ps_sqrtmpa": 1.0,
    "cbv_mm3ps_sqrtmpa": 35.355e5,
    "pilot_ratio": 4.5,
    "setting_1_mpa": 12.5,
    "setting_2_mpa": 7.65,
    "spool_area_mm2": 20.0,
    "spool_stroke_mm": 4.0,
    "spool_mass_kg": 0.025,
    "spool_damping_nspmm": 0.1,
    "spool_spring_npmm": 23.94,
    "spool_friction_n": 5.0,
    "friction_speed_mmps": 10.0,
    "spool_stop_stiffness_npmm": 1000.0,
    "spool_stop_damping_spmm": 5e-4,
    "back_pressure_share": 0.0,
    "check_mm3ps_sqrtmpa": 2e6,
    "check_crack_mpa": 0.03,
    "check_range_mpa": 0.3,
    "anticavitation_mm3ps_sqrtmpa": 1e6,
    "anticavitation_crack_mpa": 0.02,
    "anticavitation_range_mpa": 0.05,
    "relief_pressure_mpa": 32.0,
    "relief_mm3ps_mpa": 1e6,
    "line_volume_a_mm3": 2e6,
    "line_volume_b_mm3": 2e6,
}

PRESETS: dict[str, dict[str, float]] = {
    "paper": _PAPER,
    # Table 1 as printed: one coefficient for both edges, 20 mm^3 of dead volume; regularised, nothing repaired
    "paper-table1": _PAPER | {"valve_bt_mm3ps_sqrtmpa": _K_Q, "dead_volume_1_mm3": 20.0, "dead_volume_2_mm3": 20.0},
    "lift": _PAPER | {"tank_pressure_mpa": 0.2},
    # with the crane's own inertia a pilot ratio of 4.5 limit-cycles when lowering; 1.5 is stable
    "lift-heavy": _PAPER | {"tank_pressure_mpa": 0.2, "pilot_ratio": 1.5},
}


def make_parameters(preset: str, overrides: dict[str, float] | None = None) -> np.ndarray:
    """The constants of one actuator in SI.

    Args:
        preset: a name in PRESETS.
        overrides: profile key -> value in the key's unit, laid over the preset.

    Returns:
        Record array of shape (1,) and dtype PARAMETERS.

    Raises:
        ProfileError: unknown preset or key, a value out of its range, or a relation between values that cannot hold.
    """
    if preset not in PRESETS:
        raise ProfileError(f"preset '{preset}'", "unknown preset", ", ".join(PRESETS))
    values = dict(PRESETS[preset])
    for key, value in (overrides or {}).items():
        if key not in SPEC_BY_KEY:
            raise ProfileError(f"parameter '{key}'", "unknown parameter", remedy=_nearest_key(key))
        values[key] = value
    for key, value in values.items():
        _check_value(SPEC_BY_KEY[key], value)
    _check_relations(values)
    parameters = np.zeros(1, PARAMETERS)
    for row in SPEC:
        parameters[row.field] = float(values[row.key]) * row.factor
    return parameters


def engineering_values(parameters: np.ndarray) -> dict[str, float]:
    """The inverse of make_parameters: profile keys and values in the keys' units."""
    return {row.key: float(parameters[row.field][0]) / row.factor for row in SPEC}


def _nearest_key(key: str) -> str:
    import difflib

    near = difflib.get_close_matches(key, SPEC_BY_KEY, n=3, cutoff=0.5)
    return f"did you mean {', '.join(near)}?" if near else "see docs/profiles.md for the list"


def _check_value(row: ParameterSpec, value: float) -> None:
    place = f"parameter '{row.key}'"
    allowed = f"{row.minimum:g} to {row.maximum:g} (unit as in the name)"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ProfileError(place, f"{value!r} is not a number", allowed)
    if not row.minimum <= value <= row.maximum:  # also refuses NaN
        raise ProfileError(place, f"{value:g} is out of range", allowed)


def _check_relations(values: dict[str, float]) -> None:
    if values["rod_side_area_mm2"] > values["bore_area_mm2"]:
        raise ProfileError(
            "parameter 'rod_side_area_mm2'",
            f"{values['rod_side_area_mm2']:g} mm2 is larger than the bore area",
            f"at most bore_area_mm2 = {values['bore_area_mm2']:g} mm2",
        )
    if values["tank_pressure_mpa"] >= values["supply_pressure_mpa"]:
        raise ProfileError(
            "parameter 'tank_pressure_mpa'",
            f"{values['tank_pressure_mpa']:g} MPa is not below the supply pressure",
            f"below supply_pressure_mpa = {values['supply_pressure_mpa']:g} MPa",
        )
    if values["relief_pressure_mpa"] <= values["supply_pressure_mpa"]:
        raise ProfileError(
            "parameter 'relief_pressure_mpa'",
            f"{values['relief_pressure_mpa']:g} MPa would relieve the supply itself",
            f"above supply_pressure_mpa = {values['supply_pressure_mpa']:g} MPa",
        )
