"""Profiles drawn at random over every key of the format: most values within their ranges and often at the ends, some beyond, some of a wrong kind."""

import json
import math
import string
from typing import Any, Literal, get_args, get_origin

import msgspec
import numpy as np
from msgspec import Struct

from hilrunner.plant.parameters import PRESETS, SPEC
from hilrunner.realtime.encode import QUANTITY_NAMES
from hilrunner.setup.limits import SPEC as LIMITS
from hilrunner.setup.profile import Profile
from hilrunner.setup.profile_errors import metas

WRONG = (
    "x",
    -1,
    0,
    1e300,
    -1e300,
    True,
    [],
    {},
    [[1]],
    10**30,
    1e-300,
    float("nan"),
    float("inf"),
    "\n\x1b[31m",
    "a" * 5000,
)
FILE_THAT_SHIPS = {"dbc": "actuator.dbc", "schedule": "steps"}
LEFT_OUT = (
    "axis",
    "fault",
    "requirement",
    "firmware",
    "mapping",
    "network",
    "load",
    "when",
    "position_range_mm",
    "stale_after_ms",
)
FORMULAS = (
    "always {axis}.chamber_1_pressure < 25 MPa",
    "always[0 s, 0.01 s] abs({axis}.valve_command) <= 1 %",
    "always ({axis}.mode == fail-safe implies eventually[0 s, 200 ms] abs({axis}.valve_command) <= 1 %)",
)
NEAR_THE_END_RATIO = 1e-9
FILES = ("none.onnx", "/dev/zero", "../../etc/passwd", "lift-flow.onnx", "a" * 900)


def _order(limits: dict) -> None:
    """A lowest value that is not below its highest one is refused; both were drawn, so one of them goes."""
    for low in [key for key in limits if key.endswith("_min")]:
        high = low.removesuffix("_min") + "_max"
        numbers = (limits[low], limits.get(high))
        if all(isinstance(one, float) for one in numbers) and numbers[0] >= numbers[1]:
            del limits[low]


class Drawing:
    """One profile after the other from one generator; `wrong` is the share of values that are spoilt."""

    def __init__(self, drawn: np.random.Generator, wrong: float = 0.02) -> None:
        self.drawn, self.wrong = drawn, wrong

    def text(self) -> str:
        """The TOML of one profile."""
        raw = self._struct(Profile, "")
        raw["axis"] = [self._axis(index) for index in range(int(self.drawn.choice([1, 1, 1, 2])))]
        raw["fault"] = [self._fault(raw["axis"]) for _ in range(int(self.drawn.choice([0, 0, 1, 3])))]
        raw["requirement"] = self._requirements(raw["axis"])
        raw["firmware"] = self._firmware()
        if isinstance(raw.get("limits"), dict):  # it may be spoilt
            _order(raw["limits"])
        raw.setdefault("bench", {})["engine"] = "reference"
        return "\n".join(f"{json.dumps(key)} = {toml(value)}" for key, value in raw.items()) + "\n"

    def _axis(self, index: int) -> dict:
        from hilrunner.setup.profile import Axis

        raw = self._struct(Axis, "axis")
        raw["name"] = f"axis{index}" if self._sound() else "Axis One"
        raw["preset"] = str(self.drawn.choice(list(PRESETS))) if self._sound() else "none"
        raw["initial_position_mm"] = float(self.drawn.uniform(0, 2000))
        raw["load"] = self._load()
        raw["parameters"] = {}
        for row in self.drawn.choice(np.array(SPEC, dtype=object), int(self.drawn.integers(0, 6)), replace=False):
            raw["parameters"][row.key] = self._spoilt(self._number(row.minimum, row.maximum))
        return raw

    def _fault(self, axes: list[dict]) -> dict:
        from hilrunner.setup.fault_values import strength_key, threshold_key
        from hilrunner.setup.profile import Fault, FaultCondition

        kinds = get_args(get_args(next(one.type for one in msgspec.structs.fields(Fault) if one.name == "kind"))[0])
        fault = {"kind": str(self.drawn.choice(kinds)), "axis": axes[0]["name"]}
        if fault["kind"].startswith("sensor"):
            fault["quantity"] = str(self.drawn.choice(QUANTITY_NAMES))
        key = strength_key(Fault(**fault))
        if key:
            fault[key] = self._spoilt(self._of(Fault, key))
        if self.drawn.random() < 0.5:
            return fault | {"at_s": self._spoilt(float(self.drawn.choice([0.0, 0.003, 1e6])))}
        watched = str(self.drawn.choice(QUANTITY_NAMES))
        threshold = threshold_key(watched)
        return fault | {"when": {"quantity": watched, threshold: self._spoilt(self._of(FaultCondition, threshold))}}

    def _requirements(self, axes: list[dict]) -> list[dict]:
        made = []
        for number in range(int(self.drawn.choice([0, 0, 1, 3]))):
            formula = str(self.drawn.choice(FORMULAS)).format(axis=axes[0]["name"])
            made.append({"id": self._spoilt(f"R{number}"), "formula": self._spoilt(formula)})
        return made

    def _firmware(self) -> list[dict]:
        """Programs that a run in virtual time would start; nothing here starts one."""
        count = int(self.drawn.choice([0, 0, 1, 3]))
        return [{"command": ["./firmware", self._spoilt("-i")], "environment": {"LEVEL": "2"}} for _ in range(count)]

    def _load(self) -> dict:
        from hilrunner.setup.profile import Load

        kind = str(self.drawn.choice(["knuckle-boom", "constant", "table"]))
        load = {"kind": kind, "perturbation_std_ratio": self._of(Load, "perturbation_std_ratio")}
        if kind == "constant":
            load["force_kn"] = self._spoilt(self._near(1000.0))
        if kind == "table":
            count = int(self.drawn.integers(2, 129))
            load["position_mm"] = self._spoilt(
                np.linspace(-(self._near(100.0) ** 2), 2000.0 + self._near(100.0), count).tolist()
            )
            load["table_force_kn"] = self._spoilt([self._near(1000.0) for _ in range(count)])
        return load

    def _near(self, size: float) -> float:
        return float(self.drawn.normal(0.0, size))

    def _of(self, kind: type[Struct], key: str) -> Any:
        return self._value(next(one.type for one in msgspec.structs.fields(kind) if one.name == key), key)

    def _struct(self, kind: type[Struct], path: str, share: float = 0.4) -> dict:
        raw = {}
        for one in msgspec.structs.fields(kind):
            if one.encode_name in LEFT_OUT and self._sound():
                continue  # drawn with what belongs to it
            if one.required or self.drawn.random() < share:
                raw[one.encode_name] = self._spoilt(self._value(one.type, one.encode_name))
        if not self._sound():
            raw["surprise"] = 1
        return raw

    def _value(self, hint: Any, key: str) -> Any:
        inner, bounds = hint, metas(hint)
        while get_origin(inner) is not None and get_origin(inner).__name__ == "Annotated":
            inner = get_args(inner)[0]
        options = [one for one in get_args(inner) if one is not type(None)]
        if get_origin(inner) is Literal:
            return str(self.drawn.choice(options))
        if key in ("dbc", "schedule"):
            return FILE_THAT_SHIPS[key] if self._sound() else str(self.drawn.choice(FILES))
        if key == "model":
            return str(self.drawn.choice(FILES))
        if key == "quantity":
            return str(self.drawn.choice(QUANTITY_NAMES))
        if key == "limits":
            rows = self.drawn.choice(np.array(LIMITS, dtype=object), 2, replace=False)
            return {row.key: self._number(row.lowest, row.highest) for row in rows}
        if type(None) in get_args(inner):
            return self._value(options[0], key)
        if isinstance(inner, type) and issubclass(inner, Struct):
            return self._struct(inner, key)
        low = next((b for m in bounds for b in (m.ge, m.gt) if b is not None), -1e6)
        above = any(m.gt is not None for m in bounds)  # the end itself is not allowed
        high = next((b for m in bounds for b in (m.le, m.lt) if b is not None), 1e6)
        if inner is bool:
            return bool(self.drawn.integers(2))
        if inner is int:
            return int(self._number(low, min(high, 2**62)))
        if inner is float:
            return self._number(low + above * NEAR_THE_END_RATIO * (high - low), high)
        if get_origin(inner) is tuple:
            return sorted(self._number(0.0, 2000.0) for _ in range(2 if Ellipsis not in get_args(inner) else 5))
        if inner is str:
            return "".join(self.drawn.choice(list(string.ascii_lowercase), 8))
        return {}

    def _number(self, low: float, high: float) -> float:
        """Often an end, else from the middle of the range in its logarithm or itself."""
        kind = self.drawn.random()
        if kind < 0.15:
            return float(low)
        if kind < 0.3:
            return float(high)
        if low > 0 and kind < 0.8:
            return float(np.exp(self.drawn.uniform(math.log(low), math.log(high))))
        return float(self.drawn.uniform(low, high))

    def _sound(self) -> bool:
        return self.drawn.random() >= self.wrong

    def _spoilt(self, value: Any) -> Any:
        return value if self._sound() else WRONG[int(self.drawn.integers(len(WRONG)))]


def toml(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return "nan" if math.isnan(value) else "inf" if value == math.inf else repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=True)
    if isinstance(value, list):
        return "[" + ", ".join(toml(one) for one in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml(one)}" for key, one in value.items()) + "}"
    return str(value)
