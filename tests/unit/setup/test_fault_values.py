"""Strengths and thresholds of injected faults: a key with its unit for each kind, and the old keys in SI."""

import pytest

from hilrunner.base.errors import ProfileError
from hilrunner.setup.fault_values import fault_value_si, old_keys, threshold_si
from hilrunner.setup.profile import parse_profile


def fault(text):
    head = 'name = "x"\n[[axis]]\nname = "a"\n[[fault]]\naxis = "a"\n'
    return parse_profile(head + text + ("" if "when" in text else "\nat_s = 1.0"), "p.toml").fault[0]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ('kind = "sensor-offset"\nquantity = "chamber_1_pressure"\noffset_mpa = 0.5', 0.5e6),
        ('kind = "sensor-offset"\nquantity = "rod_position"\noffset_mm = -2.0', -2e-3),
        ('kind = "sensor-offset"\nquantity = "rod_velocity"\noffset_mmps = 3.0', 3e-3),
        ('kind = "sensor-offset"\nquantity = "load_force"\noffset_kn = 4.0', 4e3),
        ('kind = "sensor-offset"\nquantity = "valve_command"\noffset = 0.1', 0.1),
        ('kind = "sensor-gain"\nquantity = "rod_position"\ngain = 1.1', 1.1),
        ('kind = "valve-gain"\ngain = 0.8', 0.8),
        ('kind = "valve-stuck"\nvalve_command = -0.3', -0.3),
        ('kind = "load-factor"\nload_factor = 1.4', 1.4),
        ('kind = "sensor-offset"\nquantity = "rod_position"\nvalue = 0.002', 0.002),
        ('kind = "valve-stuck"\nvalue = 0.25', 0.25),
        ('kind = "measurement-lost"', 0.0),
    ],
)
def test_a_strength_in_its_unit(text, value):
    assert fault_value_si(fault(text)) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("condition", "value"),
    [
        ('quantity = "chamber_2_pressure", threshold_mpa = 12.0', 12e6),
        ('quantity = "rod_position", threshold_mm = 650.0', 0.65),
        ('quantity = "rod_position", threshold = 0.65', 0.65),
        ('quantity = "tick", threshold = 500.0', 500.0),
    ],
)
def test_a_threshold_in_its_unit(condition, value):
    assert threshold_si(fault(f'kind = "command-lost"\nwhen = {{ {condition} }}').when) == pytest.approx(
        value, rel=1e-15
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('kind = "sensor-offset"\nquantity = "rod_position"\noffset_mpa = 1.0', ["offset_mpa", "rod_position", "write 'offset_mm'"]),
        ('kind = "valve-gain"\noffset_mm = 1.0', ["offset_mm", "no effect", "write 'gain'"]),
        ('kind = "command-lost"\ngain = 1.0', ["gain", "remove the key"]),
        ('kind = "valve-gain"\ngain = 1.0\nvalue = 1.0', ["value", "says again"]),
        ('kind = "sensor-gain"\nquantity = "colour"\ngain = 1.0', ["colour", "rod_position"]),
        ('kind = "valve-gain"\nquantity = "rod_position"\ngain = 1.0', ["quantity", "no effect"]),
        ('kind = "command-lost"\nwhen = { quantity = "rod_position", threshold_mpa = 1.0 }', ["threshold_mm"]),
        ('kind = "command-lost"\nwhen = { quantity = "rod_position" }', ["'threshold_mm' is missing"]),
        ('kind = "command-lost"\nwhen = { quantity = "rod", threshold = 1.0 }', ["no measured quantity 'rod'"]),
    ],
)  # fmt: skip
def test_a_strength_of_another_kind_or_unit_is_refused_with_the_right_key(text, words):
    with pytest.raises(ProfileError) as caught:
        fault(text)
    for word in ["p.toml: fault[0]", *words]:
        assert word in str(caught.value), caught.value


def test_old_keys_are_told_of():
    told = old_keys((fault('kind = "sensor-offset"\nquantity = "rod_position"\nvalue = 0.002'),), "p.toml")
    assert told == ["p.toml: fault[0].value is in SI units; remedy: write 'offset_mm'"]
    assert not old_keys((fault('kind = "valve-gain"\ngain = 1.0'),), "p.toml")
