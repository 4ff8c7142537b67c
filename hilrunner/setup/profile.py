"""A profile: one TOML file that says what a bench is. Engineering units with the unit in every key; checked when loaded.

The structs below *are* the format: an unknown key, a wrong type or a value out of range is refused with the place, the value,
the limit and the remedy. Conversion to SI happens in `setup.arm`.
"""

import difflib
import math
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct, field

from hilrunner.base.errors import ProfileError
from hilrunner.setup import resources
from hilrunner.setup.limits import read_limits
from hilrunner.setup.signals import AxisMapping

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
_HOUR_MS, _LONGEST_S = 3_600_000.0, 1e7
AxisName = Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]*$", max_length=32)]


class Bench(Struct, forbid_unknown_fields=True, frozen=True):
    """The loop."""

    period_us: Annotated[int, Meta(ge=50, le=1_000_000)] = 1000
    warm_up_ticks: Annotated[int, Meta(ge=0, le=1_000_000)] = 100  # run and logged, but kept out of the statistics
    overrun: Literal["skip", "catch-up", "stop"] = "skip"
    spin_us: Annotated[int, Meta(ge=0, le=10_000)] = 0
    rehearse: bool = True
    engine: Literal["surrogate", "reference", "onnx"] = "surrogate"  # where the command names none


class Load(Struct, forbid_unknown_fields=True, frozen=True):
    """Static load over rod position."""

    kind: Literal["knuckle-boom", "constant", "table"] = "knuckle-boom"
    force_kn: float | None = None  # constant
    position_mm: tuple[float, ...] = ()  # table
    table_force_kn: tuple[float, ...] = ()  # table
    perturbation_std_ratio: Annotated[float, Meta(ge=0, le=0.5)] = 0.0
    perturbation_seed: Annotated[int, Meta(ge=0)] = 0
    equivalent_mass: bool = False  # moving mass from the geometry, M_eq(x), instead of mass_kg


class Wave(Struct, forbid_unknown_fields=True, frozen=True):
    """Vessel heave under a JONSWAP sea (DNV-RP-C205), reflected to the load."""

    significant_height_m: Annotated[float, Meta(gt=0, le=20)]
    peak_period_s: Annotated[float, Meta(ge=2, le=30)]
    seed: Annotated[int, Meta(ge=0)] = 1


class CommandRules(Struct, forbid_unknown_fields=True, frozen=True):
    """Ageing of commands: stale, hold, ramp to neutral, latched fail-safe."""

    stale_after_ms: Annotated[float, Meta(gt=0, le=_HOUR_MS)] = 50.0
    hold_for_ms: Annotated[float, Meta(ge=0, le=_HOUR_MS)] = 50.0
    ramp_for_ms: Annotated[float, Meta(ge=0, le=_HOUR_MS)] = 100.0


class Axis(Struct, forbid_unknown_fields=True, frozen=True):
    """One actuator."""

    name: AxisName
    circuit: Literal["paper", "lift", "lift-lines"] = "lift"
    preset: str = "lift"
    initial_position_mm: Annotated[float, Meta(ge=0, le=100_000)] = 600.0
    # where the rod is meant to be, stability is judged there; None: the whole stroke
    position_range_mm: tuple[NotNegative, NotNegative] | None = None
    model: str | None = None  # file under profiles/models, or a path relative to the profile
    network: dict[str, Any] = field(default_factory=dict)  # hil.* keys for a model without metadata (docs/surrogate.md)
    reference: Literal["exact", "fast"] = "exact"
    reference_substeps: Annotated[int, Meta(ge=0, le=10_000)] = 0  # 0: chosen from the stability limit
    surrogate_substeps: Annotated[int, Meta(ge=0, le=10_000)] = 0
    parameters: dict[str, float] = field(default_factory=dict)  # overrides of the preset, keys of plant.parameters
    load: Load = Load()
    wave: Wave | None = None
    command: CommandRules = CommandRules()


class Can(Struct, forbid_unknown_fields=True, frozen=True):
    """The bus and the contract with the firmware."""

    dbc: str = "actuator.dbc"  # file under firmware_iface, or a path relative to the profile
    bitrate: Annotated[int, Meta(ge=10_000, le=8_000_000)] = 1_000_000  # for the bus load; vcan has none
    fd: bool = False
    mapping: tuple[AxisMapping, ...] = ()  # own DBC: one [[can.mapping]] an axis; empty: the shipped DBC


class DeadlineLimit(Struct, forbid_unknown_fields=True, frozen=True):
    """One limit on late ticks with its action."""

    max: Annotated[int, Meta(ge=0)]
    action: Literal["warn", "fail-safe", "stop"] = "stop"


class Deadline(Struct, forbid_unknown_fields=True, frozen=True):
    """Limits on late ticks; an absent one is not watched."""

    consecutive_misses: DeadlineLimit | None = None
    total_misses: DeadlineLimit | None = None
    lateness_us: DeadlineLimit | None = None


class CrossCheck(Struct, forbid_unknown_fields=True, frozen=True):
    """Online comparison with the compiled first-principle model."""

    enabled: bool = True
    every_n_ticks: Annotated[int, Meta(ge=1, le=100_000)] = 1
    pressure_tolerance_mpa: Positive = 0.02
    position_tolerance_mm: Positive = 0.1
    one_step_pressure_tolerance_mpa: Positive = 0.01
    sustained_pressure_tolerance_mpa: Positive = 0.01  # of the error's mean over the last second of an open valve


class FaultCondition(Struct, forbid_unknown_fields=True, frozen=True):
    """Start a fault when a measured quantity crosses a threshold (SI unit of the quantity)."""

    quantity: str
    threshold: float
    above: bool = True


class Fault(Struct, forbid_unknown_fields=True, frozen=True):
    """One injected fault; `at_s` or `when` starts it."""

    kind: Literal[
        "valve-stuck",
        "valve-gain",
        "load-factor",
        "sensor-offset",
        "sensor-gain",
        "sensor-stuck",
        "measurement-lost",
        "measurement-bad-crc",
        "command-lost",
    ]
    axis: AxisName
    value: float = 0.0
    quantity: str | None = None
    at_s: Annotated[float, Meta(ge=0, le=_LONGEST_S)] | None = None
    when: FaultCondition | None = None
    duration_s: Annotated[float, Meta(ge=0, le=_LONGEST_S)] = 0.0  # 0: until the end


class Stimulus(Struct, forbid_unknown_fields=True, frozen=True):
    """What `hilrunner simulate` feeds when no schedule is given."""

    schedule: str = "lift-hold-lower-hold"


class Profile(Struct, forbid_unknown_fields=True, frozen=True):
    """One bench."""

    name: Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=64)]
    axis: Annotated[tuple[Axis, ...], Meta(min_length=1, max_length=32)]
    description: str = ""
    bench: Bench = Bench()
    can: Can = Can()
    deadline: Deadline = Deadline()
    crosscheck: CrossCheck = CrossCheck()
    limits: dict[str, Any] = field(default_factory=dict)  # setup.limits names them
    stimulus: Stimulus = Stimulus()
    fault: tuple[Fault, ...] = ()


class LoadedProfile(Struct, frozen=True):
    """A checked profile with where it came from."""

    profile: Profile
    path: Path
    text: str


def available_profiles() -> list[str]:
    """Names of the profiles that ship."""
    return sorted(path.stem for path in resources.profiles_folder().glob("*.toml"))


def load_profile(name_or_path: str) -> LoadedProfile:
    """Find, read and check a profile.

    Args:
        name_or_path: the name of a shipped profile, or a path to a TOML file.

    Raises:
        ProfileError: not found, not TOML, unknown key, wrong type, out of range, or an impossible relation.
    """
    path = _find(name_or_path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ProfileError(str(path), f"cannot be read: {error}", remedy="name a readable UTF-8 TOML file") from error
    return LoadedProfile(profile=parse_profile(text, str(path)), path=path, text=text)


def parse_profile(text: str, place: str) -> Profile:
    """Check the text of a profile; `place` is named in errors."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ProfileError(place, f"not TOML: {error}", remedy="mend the syntax at that line") from error
    try:
        profile = msgspec.convert(raw, Profile, strict=True)
    except msgspec.ValidationError as error:
        raise _explain(place, raw, str(error)) from error
    _check_numbers(raw, place, "")
    _check_relations(profile, place)
    return profile


def _find(name_or_path: str) -> Path:
    direct = Path(name_or_path)
    if direct.suffix == ".toml" or direct.exists():
        if not direct.is_file():
            raise ProfileError(
                name_or_path, "no such file", remedy="name a TOML file, or a profile of `hilrunner profiles`"
            )
        return direct
    shipped = resources.profiles_folder() / f"{name_or_path}.toml"
    if not shipped.is_file():
        near = difflib.get_close_matches(name_or_path, available_profiles(), n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise ProfileError(
            f"--profile {name_or_path}",
            "no such profile",
            limit=", ".join(available_profiles()),
            remedy=f"{hint}name one of these or a path to a TOML file",
        )
    return shipped


def _explain(place: str, raw: dict, message: str) -> ProfileError:
    """Turn msgspec's message into place, value, limit and remedy."""
    match = re.search(r" - at `\$(?P<path>.*)`$", message)
    path = (match["path"] if match else "").lstrip(".")
    problem = message[: match.start()] if match else message
    unknown = re.search(r"unknown field `(?P<key>[^`]+)`", problem)
    if unknown:
        key = unknown["key"]
        known = _known_keys(path)
        near = difflib.get_close_matches(key, known, n=1)
        remedy = f"did you mean '{near[0]}'?" if near else "remove it or use one of the allowed keys"
        unit_remedy = _unit_remedy(key, known)
        return ProfileError(
            f"{place}: {path or 'top level'}", f"unknown key '{key}'", ", ".join(known), unit_remedy or remedy
        )
    missing = re.search(r"missing required field `(?P<key>[^`]+)`", problem)
    if missing:
        return ProfileError(f"{place}: {path or 'top level'}", f"'{missing['key']}' is missing", remedy="add it")
    value = _value_at(raw, path)
    found = f" but found {value!r}" if value is not None and repr(value) not in problem else ""
    allowed = ", ".join(_choices(path)) if problem.startswith("Invalid enum value") else ""
    return ProfileError(f"{place}: {path or 'top level'}", f"{problem}{found}", allowed, remedy="correct the value")


def _unit_remedy(key: str, known: list[str]) -> str:
    """A key with the right quantity and a wrong unit deserves to be told so."""
    stem = key.rsplit("_", 1)[0]
    for candidate in known:
        if candidate.rsplit("_", 1)[0] == stem and candidate != key:
            return f"the unit of '{stem}' is fixed: write '{candidate}'"
    return ""


def _choices(path: str) -> tuple[str, ...]:
    """The words a key of the format may hold; empty where it is no choice."""
    parent, _, key = re.sub(r"\[[^\]]*\]", "", path).rpartition(".")
    hint = next((f.type for f in msgspec.structs.fields(_struct_at(parent) or Profile) if f.encode_name == key), None)
    return getattr(hint, "__args__", ()) if getattr(hint, "__origin__", None) is Literal else ()


def _known_keys(path: str) -> list[str]:
    struct = _struct_at(path)
    return [f.encode_name for f in msgspec.structs.fields(struct)] if struct is not None else []


def _struct_at(path: str) -> Any:
    names = [part for part in re.sub(r"\[[^\]]*\]", "", path).split(".") if part]
    struct: Any = Profile
    for name in names:
        hint = next((f.type for f in msgspec.structs.fields(struct) if f.encode_name == name), None)
        struct = _struct_in(hint)
        if struct is None:
            return None
    return struct


def _struct_in(hint: Any) -> Any:
    if isinstance(hint, type) and issubclass(hint, Struct):
        return hint
    for inner in getattr(hint, "__args__", ()) or ():
        found = _struct_in(inner)
        if found is not None:
            return found
    return None


def _value_at(raw: Any, path: str) -> Any:
    # msgspec writes list positions as [...]; the first offending element is not told, so stop there
    for part in re.findall(r"[^.\[\]]+|\[[^\]]*\]", path):
        if part.startswith("["):
            return None
        if not isinstance(raw, dict) or part not in raw:
            return None
        raw = raw[part]
    return raw if not isinstance(raw, (dict, list)) else None


def _check_numbers(value: Any, place: str, path: str) -> None:
    """TOML knows nan and inf; a bench has no use for either."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ProfileError(f"{place}: {path}", f"{value} is not a finite number", remedy="correct the value")
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        step = f"[{key}]" if isinstance(key, int) else f".{key}" if path else key
        _check_numbers(inner, place, f"{path}{step}")


def _check_relations(profile: Profile, place: str) -> None:
    read_limits(profile.limits, f"{place}: limits")
    names = [axis.name for axis in profile.axis]
    if len(set(names)) != len(names):
        raise ProfileError(f"{place}: axis", f"two axes share a name in {names}", remedy="give each axis its own name")
    for index, axis in enumerate(profile.axis):
        _check_load(axis.load, f"{place}: axis[{index}].load")
        _check_range(axis, f"{place}: axis[{index}].position_range_mm")
    for index, fault in enumerate(profile.fault):
        _check_fault(fault, names, f"{place}: fault[{index}]")
    period_ms = profile.bench.period_us / 1000
    for index, axis in enumerate(profile.axis):
        if axis.command.stale_after_ms < period_ms:
            raise ProfileError(
                f"{place}: axis[{index}].command.stale_after_ms",
                f"{axis.command.stale_after_ms} ms is shorter than one period",
                limit=f">= {period_ms} ms",
                remedy="raise it to the firmware's cycle time times the frames it may lose",
            )


def _check_range(axis: Axis, place: str) -> None:
    if axis.position_range_mm is None:
        return
    low, high = axis.position_range_mm
    if not low <= axis.initial_position_mm <= high or low == high:
        raise ProfileError(
            place,
            f"{low:g} to {high:g} mm does not hold the initial position {axis.initial_position_mm:g} mm",
            remedy="widen the range or move the start",
        )


def _check_load(load: Load, place: str) -> None:
    if load.kind == "constant" and load.force_kn is None:
        raise ProfileError(f"{place}.force_kn", "missing", remedy="a constant load needs force_kn")
    for key, kind, given in (
        ("force_kn", "constant", load.force_kn is not None),
        ("position_mm", "table", bool(load.position_mm)),
        ("table_force_kn", "table", bool(load.table_force_kn)),
    ):
        if given and load.kind != kind:
            raise ProfileError(
                f"{place}.{key}", f"has no effect on kind '{load.kind}'", remedy=f'remove it, or say kind = "{kind}"'
            )
    if load.kind != "table":
        return
    position, force = load.position_mm, load.table_force_kn
    if len(position) < 2 or len(position) != len(force):
        raise ProfileError(
            f"{place}.position_mm",
            f"{len(position)} positions and {len(force)} forces",
            limit="two or more of each, equally many",
            remedy="give position_mm and table_force_kn of equal length",
        )
    if any(b <= a for a, b in zip(position, position[1:], strict=False)):
        raise ProfileError(f"{place}.position_mm", "not increasing", remedy="sort the table by position")


def _check_fault(fault: Fault, names: list[str], place: str) -> None:
    if fault.axis not in names:
        raise ProfileError(f"{place}.axis", f"no axis '{fault.axis}'", limit=", ".join(names))
    if (fault.at_s is None) == (fault.when is None):
        raise ProfileError(place, "needs exactly one of at_s and when", remedy="say when the fault begins")
    if fault.kind.startswith("sensor") and fault.quantity is None:
        raise ProfileError(f"{place}.quantity", "missing", remedy="name the measured quantity the fault acts on")
