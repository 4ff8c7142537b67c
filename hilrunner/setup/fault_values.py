"""How strong an injected fault is: the key of its kind and unit, and its value in SI."""

from typing import TYPE_CHECKING

from hilrunner.base.errors import ProfileError
from hilrunner.base.units import M_PER_MM, N_PER_KN, PA_PER_MPA
from hilrunner.realtime import encode
from hilrunner.setup.signals import QUANTITY_KINDS

if TYPE_CHECKING:
    from hilrunner.setup.profile import Fault, FaultCondition

# kind of a quantity -> ending of its keys, factor to SI; every other quantity is a number without unit
_UNITS = {
    "pressure": ("_mpa", PA_PER_MPA),
    "length": ("_mm", M_PER_MM),
    "velocity": ("_mmps", M_PER_MM),
    "force": ("_kn", N_PER_KN),
}
_STRENGTH = {"valve-stuck": "valve_command", "valve-gain": "gain", "sensor-gain": "gain", "load-factor": "load_factor"}
_OFFSETS = ("offset_mpa", "offset_mm", "offset_mmps", "offset_kn", "offset")
_THRESHOLDS = ("threshold_mpa", "threshold_mm", "threshold_mmps", "threshold_kn", "threshold")
_STRENGTHS = ("valve_command", "gain", "load_factor", *_OFFSETS, "value")


def check_fault(fault: "Fault", place: str) -> None:
    """Refuse a fault whose quantity, strength or condition is missing, foreign to its kind, or given twice."""
    if fault.kind.startswith("sensor"):
        if fault.quantity is None:
            raise ProfileError(f"{place}.quantity", "missing", remedy="name the measured quantity the fault acts on")
        _check_quantity(fault.quantity, f"{place}.quantity")
    elif fault.quantity is not None:
        raise ProfileError(
            f"{place}.quantity", f"has no effect on kind '{fault.kind}'", "the sensor faults", "remove the key"
        )
    if fault.when is not None:
        _check_condition(fault.when, f"{place}.when")
    wanted = strength_key(fault)
    given = [key for key in _STRENGTHS if getattr(fault, key) is not None]
    for key in given:
        if key not in (wanted, "value"):
            on = f" on '{fault.quantity}'" if fault.quantity else ""
            raise ProfileError(
                f"{place}.{key}", f"has no effect on kind '{fault.kind}'{on}",
                remedy=f"write '{wanted}'" if wanted else "remove the key",
            )  # fmt: skip
    if len(given) > 1:
        raise ProfileError(f"{place}.value", f"says again what '{wanted}' says", remedy="remove 'value'")


def strength_key(fault: "Fault") -> str | None:
    """The key that holds a fault's strength; None for kinds that have none."""
    if fault.kind == "sensor-offset":
        return "offset" + _unit_of(fault.quantity or "")[0]
    return _STRENGTH.get(fault.kind)


def threshold_key(quantity: str) -> str:
    """The key that holds a threshold on a quantity."""
    return "threshold" + _unit_of(quantity)[0]


def fault_value_si(fault: "Fault") -> float:
    """The strength of a fault: SI unit of its quantity, a factor, or a valve command -1..1; 0 where the profile gives none."""
    if fault.value is not None:  # SI, as profiles had it before
        return fault.value
    key = strength_key(fault)
    given = getattr(fault, key) if key else None
    if given is None:
        return 0.0
    return given * _unit_of(fault.quantity or "")[1] if fault.kind == "sensor-offset" else given


def threshold_si(condition: "FaultCondition") -> float:
    """The threshold of a condition in the SI unit of its quantity."""
    if condition.threshold is not None:  # SI where the quantity has a unit, as profiles had it before
        return condition.threshold
    ending, factor = _unit_of(condition.quantity)
    return getattr(condition, "threshold" + ending) * factor


def old_keys(faults: "tuple[Fault, ...]", place: str) -> list[str]:
    """One sentence for every strength or threshold that is written without its unit."""
    told = []
    for index, fault in enumerate(faults):
        wanted = strength_key(fault)
        if fault.value is not None and wanted:
            told.append(f"{place}: fault[{index}].value is in SI units; remedy: write '{wanted}'")
        if fault.when is not None and fault.when.threshold is not None and _unit_of(fault.when.quantity)[0]:
            wanted = threshold_key(fault.when.quantity)
            told.append(f"{place}: fault[{index}].when.threshold is in SI units; remedy: write '{wanted}'")
    return told


def _check_condition(condition: "FaultCondition", place: str) -> None:
    _check_quantity(condition.quantity, f"{place}.quantity")
    wanted = threshold_key(condition.quantity)
    given = [key for key in _THRESHOLDS if getattr(condition, key) is not None]
    if not given:
        raise ProfileError(place, f"'{wanted}' is missing", remedy="add it")
    for key in given:
        if key not in (wanted, "threshold"):
            raise ProfileError(
                f"{place}.{key}", f"is not the unit of '{condition.quantity}'", remedy=f"write '{wanted}'"
            )
    if len(given) > 1:
        raise ProfileError(f"{place}.threshold", f"says again what '{wanted}' says", remedy="remove 'threshold'")


def _check_quantity(name: str, place: str) -> None:
    if name not in encode.QUANTITY_NAMES:
        raise ProfileError(place, f"no measured quantity '{name}'", limit=", ".join(encode.QUANTITY_NAMES))


def _unit_of(quantity: str) -> tuple[str, float]:
    return _UNITS.get(QUANTITY_KINDS.get(quantity, ""), ("", 1.0))
