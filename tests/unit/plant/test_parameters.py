"""The parameter table: units, limits, relations."""

import math

import numpy as np
import pytest

from hilrunner.base.errors import ProfileError
from hilrunner.plant import parameters


@pytest.mark.parametrize("preset", parameters.PRESETS)
def test_presets_convert_to_si_and_back(preset):
    record = parameters.make_parameters(preset)
    assert record.shape == (1,) and record.dtype == parameters.PARAMETERS
    back = parameters.engineering_values(record)
    assert back.keys() == parameters.PRESETS[preset].keys()
    for key, value in parameters.PRESETS[preset].items():
        assert back[key] == pytest.approx(value, rel=1e-14), key


def test_si_values_of_the_article():
    prm = parameters.make_parameters("paper")[0]
    assert prm["bore_area_m2"] == pytest.approx(math.pi * 0.320**2 / 4, rel=1e-6)
    assert prm["bore_area_m2"] - prm["rod_side_area_m2"] == pytest.approx(math.pi * 0.200**2 / 4, rel=1e-5)
    assert prm["viscous_friction_nspm"] == 1000.0
    # 4.057e5 mm^3/(s sqrt MPa): 23.7 mm/s and 115 L/min from 30 MPa into 7.5 MPa
    flow = prm["valve_pa_si"] * math.sqrt(30e6 - 7.81e6)
    assert flow * 6e4 == pytest.approx(115, abs=1)
    assert flow / prm["bore_area_m2"] == pytest.approx(0.0238, abs=1e-4)
    # k_qc is a 1 cm^2 port with Cd 0.75 in oil of 900 kg/m^3
    assert prm["cbv_si"] == pytest.approx(0.75 * math.sqrt(2 / 900) * 1e-4, rel=1e-5)
    assert prm["relief_m3pspa"] == pytest.approx(1e-9)
    assert prm["spool_spring_npm"] == pytest.approx(23940)


def test_overrides_win():
    record = parameters.make_parameters("lift", {"pilot_ratio": 1.5, "mass_kg": 5e5})
    assert record["pilot_ratio"][0] == 1.5 and record["mass_kg"][0] == 5e5
    assert parameters.PRESETS["lift"]["pilot_ratio"] == 4.5


def test_every_key_ends_in_its_unit_or_is_a_ratio():
    units = ("mm2", "mm", "mm3", "kg", "nspmm", "npmm", "spmm", "mpa", "sqrtmpa", "mmps", "n", "mm3ps_mpa")
    plain = {"cavitation_ratio", "pilot_ratio", "bleed_range", "back_pressure_share"}
    for row in parameters.SPEC:
        assert row.key in plain or row.key.endswith(tuple("_" + unit for unit in units)), row.key
        assert row.minimum < row.maximum and row.source and row.doc


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        ({"pilot_rato": 4.5}, "did you mean pilot_ratio"),
        ({"mass_kg": -1.0}, r"-1 is out of range; allowed: 0.1 to 1e\+07"),
        ({"mass_kg": math.nan}, "out of range"),
        ({"mass_kg": "heavy"}, "is not a number"),
        ({"mass_kg": True}, "is not a number"),
        ({"rod_side_area_mm2": 9e4}, "larger than the bore area"),
        ({"tank_pressure_mpa": 5.0, "supply_pressure_mpa": 4.0}, "not below the supply pressure"),
        ({"relief_pressure_mpa": 20.0}, "would relieve the supply"),
    ],
)
def test_bad_values_are_refused_with_key_value_and_limit(overrides, named):
    with pytest.raises(ProfileError, match=named) as refused:
        parameters.make_parameters("lift", overrides)
    assert refused.value.exit_code == 2


def test_unknown_preset_is_refused():
    with pytest.raises(ProfileError, match="lift-heavy"):
        parameters.make_parameters("crane")


def test_limits_hold_for_every_preset_and_refuse_just_outside():
    for row in parameters.SPEC:
        for bad in (row.minimum - abs(row.minimum) * 0.01 - 1e-9, row.maximum + abs(row.maximum) * 0.01 + 1e-9):
            with pytest.raises(ProfileError):
                parameters.make_parameters("lift", {row.key: float(np.float64(bad))})
