"""A profile: one TOML file that says what a bench is. Engineering units with the unit in every key; checked when loaded.

The structs below *are* the format: an unknown key, a wrong type or a value out of range is refused with the place, the value,
the limit and the remedy. Every number has a range, because every number scales either work or state: the ranges are generous, and a
value outside them is a slip of the pen. The sentence beside a key is what docs/profiles.md prints. Conversion to SI happens in
`setup.arm`, `setup.axes` and `setup.fault_values`.
"""

import difflib
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct, field

from hilrunner.base import status
from hilrunner.base.errors import ProfileError
from hilrunner.requirements.requirement import Written as Requirement
from hilrunner.setup import resources
from hilrunner.setup.mapping import AxisMapping
from hilrunner.setup.profile_check import check_numbers, check_relations
from hilrunner.setup.profile_errors import explain
from hilrunner.setup.text import read_text

TEXT_SIZE_MAX_BYTES = 4 * 1024 * 1024  # a profile is written by hand
_HOUR_MS, _LONGEST_S, _LONGEST_MM, _COUNT_MAX, _SEED_MAX = 3_600_000.0, 1e7, 100_000.0, 10**12, 2**63 - 1
_FORCE_KN = 100_000.0  # 100 MN: ten times the largest cylinders of cranes
_TABLE_ROWS_MAX = 129  # plant.load.KNOT_LIMIT
_FILE_NAME = r"^[^\x00-\x1f\x7f]+$"
AxisName = Annotated[str, Meta(pattern=r"^[a-z][a-z0-9_]*$", max_length=32)]
FileName = Annotated[str, Meta(pattern=_FILE_NAME, max_length=1024)]
Millimetres = Annotated[float, Meta(ge=-_LONGEST_MM, le=_LONGEST_MM)]
Kilonewtons = Annotated[float, Meta(ge=-_FORCE_KN, le=_FORCE_KN)]


class Bench(Struct, forbid_unknown_fields=True, frozen=True):
    """The loop."""

    period_us: Annotated[int, Meta(ge=50, le=1_000_000, description="the fixed period of the loop")] = 1000
    warm_up_ticks: Annotated[
        int, Meta(ge=0, le=1_000_000, description="first ticks: run and logged, but kept out of the statistics")
    ] = 100
    overrun: Annotated[
        Literal["skip", "catch-up", "stop"],
        Meta(description="what happens to periods that a late tick has cost (docs/realtime.md)"),
    ] = "skip"
    spin_us: Annotated[
        int, Meta(ge=0, le=10_000, description="sleep this much short of the deadline and spin the rest")
    ] = 0
    rehearse: Annotated[
        bool,
        Meta(description="run the tick once for practice while waiting, so that its code is warm (docs/realtime.md)"),
    ] = True
    require_firmware: Annotated[
        bool, Meta(description="a run on a bus in which an axis never gets a valid command fails")
    ] = True
    engine: Annotated[
        Literal["surrogate", "reference", "onnx"], Meta(description="the plant, where the command names none")
    ] = "surrogate"


class Load(Struct, forbid_unknown_fields=True, frozen=True):
    """Static load over rod position."""

    kind: Annotated[
        Literal["knuckle-boom", "constant", "table"], Meta(description="geometry of a crane, one force, or a table")
    ] = "knuckle-boom"
    force_kn: Annotated[
        Kilonewtons | None,
        Meta(description="of kind `constant`: the force that pushes the rod in; negative pulls it out"),
    ] = None
    position_mm: Annotated[
        tuple[Millimetres, ...], Meta(max_length=_TABLE_ROWS_MAX, description="of kind `table`: increasing positions")
    ] = ()
    table_force_kn: Annotated[
        tuple[Kilonewtons, ...], Meta(max_length=_TABLE_ROWS_MAX, description="of kind `table`: the force at each")
    ] = ()
    perturbation_std_ratio: Annotated[
        float, Meta(ge=0, le=0.5, description="standard deviation of a random factor on every knot of the load")
    ] = 0.0
    perturbation_seed: Annotated[int, Meta(ge=0, le=_SEED_MAX, description="seed of that factor")] = 0
    equivalent_mass: Annotated[
        bool,
        Meta(
            description="of kind `knuckle-boom`: the moving mass follows from the geometry and comes on top of mass_kg"
        ),
    ] = False


class Wave(Struct, forbid_unknown_fields=True, frozen=True):
    """Vessel heave under a JONSWAP sea (DNV-RP-C205), reflected to the load."""

    significant_height_m: Annotated[float, Meta(gt=0, le=20, description="Hs of the sea")]
    peak_period_s: Annotated[float, Meta(ge=2, le=30, description="Tp of the sea")]
    seed: Annotated[int, Meta(ge=0, le=_SEED_MAX, description="seed of frequencies and phases")] = 1


class CommandRules(Struct, forbid_unknown_fields=True, frozen=True):
    """Ageing of commands: stale, hold, ramp to neutral, latched fail-safe."""

    stale_after_ms: Annotated[
        float, Meta(gt=0, le=_HOUR_MS, description="age at which a command is stale; at least one period")
    ] = 50.0
    hold_for_ms: Annotated[float, Meta(ge=0, le=_HOUR_MS, description="how long a stale command is still held")] = 50.0
    ramp_for_ms: Annotated[
        float, Meta(ge=0, le=_HOUR_MS, description="then the valve goes to neutral in this time, and fail-safe latches")
    ] = 100.0


class Axis(Struct, forbid_unknown_fields=True, frozen=True):
    """One actuator."""

    name: Annotated[AxisName, Meta(description="small letters, digits and underscores; names its topics in the log")]
    circuit: Annotated[
        Literal["paper", "lift", "lift-lines"],
        Meta(
            description="the article's circuit, both directions, or both directions with line volumes (docs/plant.md)"
        ),
    ] = "lift"
    preset: Annotated[str, Meta(max_length=64, description="set of constants the parameters start from")] = "lift"
    initial_position_mm: Annotated[
        float, Meta(ge=0, le=_LONGEST_MM, description="rod position before the first tick, within the stroke")
    ] = 600.0
    position_range_mm: Annotated[
        tuple[Annotated[float, Meta(ge=0, le=_LONGEST_MM)], Annotated[float, Meta(ge=0, le=_LONGEST_MM)]] | None,
        Meta(description="where the rod is meant to be: stability is judged there; without it, over the whole stroke"),
    ] = None
    model: Annotated[
        FileName | None,
        Meta(description="trained network: a path relative to the profile, or a file that ships in profiles/models"),
    ] = None
    network: Annotated[
        dict[str, Any],
        Meta(max_length=64, description="`hil.*` keys that describe a network without metadata (docs/surrogate.md)"),
    ] = field(default_factory=dict)
    reference: Annotated[
        Literal["exact", "fast"], Meta(description="first-principle model: with the masses of the spools, or without")
    ] = "exact"
    reference_substeps: Annotated[
        int,
        Meta(ge=0, le=10_000, description="steps of RK4 a period of the first-principle model; 0: chosen by stability"),
    ] = 0
    surrogate_substeps: Annotated[
        int, Meta(ge=0, le=10_000, description="steps of RK4 a period of the surrogate; 0: chosen by stability")
    ] = 0
    parameters: Annotated[
        dict[str, float], Meta(max_length=256, description="constants in place of the preset's, see the table below")
    ] = field(default_factory=dict)
    load: Annotated[Load, Meta(description="static load over rod position")] = Load()
    wave: Annotated[Wave | None, Meta(description="heave of the vessel; without it the vessel lies still")] = None
    command: Annotated[CommandRules, Meta(description="ageing of valve commands")] = CommandRules()


class Can(Struct, forbid_unknown_fields=True, frozen=True):
    """The bus and the contract with the firmware."""

    dbc: Annotated[
        FileName, Meta(description="a path relative to the profile, or a file that ships in firmware_iface")
    ] = "actuator.dbc"
    bitrate: Annotated[
        int, Meta(ge=10_000, le=8_000_000, description="bit/s, where the interface sets it, and for the bus load")
    ] = 1_000_000
    fd: Annotated[bool, Meta(description="CAN FD frames")] = False
    options: Annotated[
        dict[str, str | int | float | bool],
        Meta(max_length=64, description="further arguments of the python-can interface: host, port, data_bitrate, ..."),
    ] = field(default_factory=dict)
    mapping: Annotated[
        tuple[AxisMapping, ...],
        Meta(max_length=32, description="own DBC: one `[[can.mapping]]` an axis; without it, that of the shipped DBC"),
    ] = ()


class DeadlineLimit(Struct, forbid_unknown_fields=True, frozen=True):
    """One limit on late ticks with its action."""

    max: Annotated[int, Meta(ge=0, le=_COUNT_MAX, description="most that is still good; lateness in microseconds")]
    action: Annotated[Literal["warn", "fail-safe", "stop"], Meta(description="what happens beyond it")] = "stop"


class StallLimit(Struct, forbid_unknown_fields=True, frozen=True):
    """How long the bench may serve no period; a longer silence is a fault of the bench, not of the firmware."""

    max: Annotated[int, Meta(ge=0, le=3_600_000, description="longest time without a served period, ms")] = 100
    action: Annotated[
        Literal["warn", "fail", "stop"],
        Meta(description="fail: the run goes on, its verdict names the bench; stop: it ends at once; warn: told only"),
    ] = "fail"


class Deadline(Struct, forbid_unknown_fields=True, frozen=True):
    """Limits on late ticks; an absent one is not watched, but for stalls."""

    consecutive_misses: Annotated[DeadlineLimit | None, Meta(description="late ticks one behind the other")] = None
    total_misses: Annotated[DeadlineLimit | None, Meta(description="late ticks of the whole run")] = None
    lateness_us: Annotated[DeadlineLimit | None, Meta(description="how long after its period a tick may end")] = None
    stall_ms: Annotated[StallLimit, Meta(description="how long the bench may serve no period")] = StallLimit()


Tolerance = Annotated[float, Meta(gt=0, le=1000)]


class CrossCheck(Struct, forbid_unknown_fields=True, frozen=True):
    """Online comparison with the compiled first-principle model."""

    enabled: Annotated[bool, Meta(description="whether the run is checked")] = True
    every_n_ticks: Annotated[int, Meta(ge=1, le=100_000, description="one tick in so many is checked by itself")] = 1
    pressure_tolerance_mpa: Annotated[Tolerance, Meta(description="of the free-running model beside the run")] = 0.02
    position_tolerance_mm: Annotated[
        float, Meta(gt=0, le=_LONGEST_MM, description="of the free-running model beside the run")
    ] = 0.1
    one_step_pressure_tolerance_mpa: Annotated[
        Tolerance, Meta(description="of one period from the run's own state")
    ] = 0.01
    sustained_pressure_tolerance_mpa: Annotated[
        Tolerance, Meta(description="of the error's mean over the last second of an open valve")
    ] = 0.01


Ratio = Annotated[float, Meta(ge=-1000, le=1000)]
Pressure = Annotated[float, Meta(ge=-1000, le=1000)]


class FaultCondition(Struct, forbid_unknown_fields=True, frozen=True):
    """Start a fault when a measured quantity crosses a threshold; exactly one threshold, in the unit of the quantity."""

    quantity: Annotated[str, Meta(max_length=64, description="the measured quantity that is watched")]
    above: Annotated[bool, Meta(description="begin above the threshold; false: below it")] = True
    threshold_mpa: Annotated[Pressure | None, Meta(description="of a pressure")] = None
    threshold_mm: Annotated[Millimetres | None, Meta(description="of a position")] = None
    threshold_mmps: Annotated[Millimetres | None, Meta(description="of a velocity")] = None
    threshold_kn: Annotated[Kilonewtons | None, Meta(description="of a force")] = None
    threshold: Annotated[
        Annotated[float, Meta(ge=-1e12, le=1e12)] | None,
        Meta(
            description="of a quantity without unit; for others the SI value, as profiles had it before: write the unit"
        ),
    ] = None


class Fault(Struct, forbid_unknown_fields=True, frozen=True):
    """One injected fault; `at_s` or `when` starts it. Its strength stands in the key of its kind and unit."""

    kind: Annotated[
        Literal[
            "valve-stuck",
            "valve-gain",
            "load-factor",
            "sensor-offset",
            "sensor-gain",
            "sensor-stuck",
            "measurement-lost",
            "measurement-bad-crc",
            "command-lost",
        ],
        Meta(description="what goes wrong"),
    ]
    axis: Annotated[AxisName, Meta(description="the axis it happens to")]
    valve_command: Annotated[
        Annotated[float, Meta(ge=-1, le=1)] | None, Meta(description="of `valve-stuck`: what the plant sees instead")
    ] = None
    gain: Annotated[Ratio | None, Meta(description="of `valve-gain` and `sensor-gain`: the factor")] = None
    load_factor: Annotated[
        Annotated[float, Meta(ge=-100, le=100)] | None, Meta(description="of `load-factor`: the static load times this")
    ] = None
    offset_mpa: Annotated[Pressure | None, Meta(description="of `sensor-offset` on a pressure")] = None
    offset_mm: Annotated[Millimetres | None, Meta(description="of `sensor-offset` on a position")] = None
    offset_mmps: Annotated[Millimetres | None, Meta(description="of `sensor-offset` on a velocity")] = None
    offset_kn: Annotated[Kilonewtons | None, Meta(description="of `sensor-offset` on a force")] = None
    offset: Annotated[
        Annotated[float, Meta(ge=-1e12, le=1e12)] | None,
        Meta(description="of `sensor-offset` on a quantity without unit"),
    ] = None
    value: Annotated[
        Annotated[float, Meta(ge=-1e12, le=1e12)] | None,
        Meta(description="as profiles had it before, in SI units: write the key of the kind and unit instead"),
    ] = None
    quantity: Annotated[
        Annotated[str, Meta(max_length=64)] | None,
        Meta(description="of the sensor faults: the measured quantity"),
    ] = None
    at_s: Annotated[
        Annotated[float, Meta(ge=0, le=_LONGEST_S)] | None, Meta(description="begins at this time from tick 0")
    ] = None
    when: Annotated[FaultCondition | None, Meta(description="begins by a condition")] = None
    duration_s: Annotated[float, Meta(ge=0, le=_LONGEST_S, description="how long it lasts; 0: until the end")] = 0.0


class Stimulus(Struct, forbid_unknown_fields=True, frozen=True):
    """What `hilrunner simulate` feeds when no schedule is given."""

    schedule: Annotated[FileName, Meta(description="name of a schedule, or a file (relative to the profile)")] = (
        "lift-hold-lower-hold"
    )
    channel: Annotated[
        FileName | None,
        Meta(description="of a CAN log: the channel with the commands; absent: the only one that has them"),
    ] = None


class FirmwareProcess(Struct, forbid_unknown_fields=True, frozen=True):
    """A firmware that `run --virtual` starts."""

    command: Annotated[
        tuple[Annotated[str, Meta(max_length=4096)], ...],
        Meta(min_length=1, max_length=256, description="the program and its words"),
    ]
    environment: Annotated[
        dict[str, str], Meta(max_length=256, description="variables added to the environment of the bench")
    ] = field(default_factory=dict)


class VirtualTime(Struct, forbid_unknown_fields=True, frozen=True):
    """What `run --virtual` puts in the place of clock and bus."""

    bus: Annotated[
        Literal["ideal", "timed"],
        Meta(description="ideal: a frame takes no time; timed: one at a time, as long as can.bitrate makes it"),
    ] = "ideal"


class Profile(Struct, forbid_unknown_fields=True, frozen=True):
    """One bench."""

    name: Annotated[
        str,
        Meta(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=64, description="small letters, digits and hyphens"),
    ]
    axis: Annotated[
        tuple[Axis, ...], Meta(min_length=1, max_length=32, description="the actuators, one `[[axis]]` each")
    ]
    description: Annotated[str, Meta(max_length=10_000, description="for people")] = ""
    bench: Annotated[Bench, Meta(description="the loop")] = Bench()
    can: Annotated[Can, Meta(description="the bus")] = Can()
    deadline: Annotated[Deadline, Meta(description="limits on late ticks that act while the bench runs")] = Deadline()
    crosscheck: Annotated[CrossCheck, Meta(description="comparison with first principles")] = CrossCheck()
    limits: Annotated[
        dict[str, Any],
        Meta(max_length=256, description="what a run must keep to pass its verdict, see the table below"),
    ] = field(default_factory=dict)
    stimulus: Annotated[Stimulus, Meta(description="commands without a bus")] = Stimulus()
    fault: Annotated[tuple[Fault, ...], Meta(max_length=256, description="injected faults, one `[[fault]]` each")] = ()
    requirement: Annotated[
        tuple[Requirement, ...],
        Meta(max_length=1000, description="what a run must show beside the limits, one `[[requirement]]` each"),
    ] = ()
    firmware: Annotated[
        tuple[FirmwareProcess, ...],
        Meta(
            max_length=16,
            description="what `run --virtual` runs where the command line names nothing, one `[[firmware]]` each",
        ),
    ] = ()
    virtual: Annotated[VirtualTime, Meta(description="virtual time")] = VirtualTime()


class SealedFile(Struct, frozen=True):
    """A file of a parcel or a log: its bytes, how errors call it, and where the same bytes lie on disk if a run read them there."""

    data: bytes
    place: str
    path: Path | None = None


class LoadedProfile(Struct, frozen=True):
    """A checked profile with where it came from.

    `sealed` holds the files a profile out of a log may name: for such a profile there is no file system, whatever path it names.
    None: names are looked up beside the profile and among what ships.
    """

    profile: Profile
    path: Path
    text: str
    sealed: Mapping[str, SealedFile] | None = None
    plant_equations: int = status.PLANT_EQUATIONS  # a log's own, where the profile came out of one

    def changed(self, **keys: Any) -> "LoadedProfile":
        """The same profile with tables of it replaced (`bench=...`), its text left as it was written."""
        return msgspec.structs.replace(self, profile=msgspec.structs.replace(self.profile, **keys))


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
    text = read_text(path, ProfileError, "name a TOML file, or a profile of `hilrunner profiles`", TEXT_SIZE_MAX_BYTES)
    return LoadedProfile(profile=parse_profile(text, str(path)), path=path, text=text)


def parse_profile(text: str, place: str) -> Profile:
    """Check the text of a profile; `place` is named in errors."""
    try:
        raw = tomllib.loads(text)
    except RecursionError as error:
        raise ProfileError(place, "is nested too deeply to be read", remedy="a profile needs five levels") from error
    except ValueError as error:  # tomllib's own error, and Python's of a number with thousands of digits
        raise ProfileError(place, f"not TOML: {error}", remedy="mend the syntax at that line") from error
    return convert_profile(raw, place)


def convert_profile(raw: dict, place: str) -> Profile:
    """Check the tables of a profile as plain values."""
    try:
        profile = msgspec.convert(raw, Profile, strict=True)
        check_numbers(raw, place, "")
    except msgspec.ValidationError as error:
        raise explain(Profile, place, raw, str(error)) from error
    except RecursionError as error:
        raise ProfileError(place, "is nested too deeply to be read", remedy="a profile needs five levels") from error
    except OverflowError as error:
        raise ProfileError(place, f"holds a number that is too large: {error}", remedy="correct the value") from error
    check_relations(profile, place)
    return profile


def checked(loaded: LoadedProfile) -> LoadedProfile:
    """A profile after a change of its tables; ProfileError where the relations between its values no longer hold."""
    check_relations(loaded.profile, str(loaded.path))
    return loaded


def _find(name_or_path: str) -> Path:
    if name_or_path in available_profiles():  # whatever lies in the working folder under that name, a folder of results
        return resources.profiles_folder() / f"{name_or_path}.toml"
    direct = Path(name_or_path)
    if direct.suffix == ".toml" or os.path.exists(direct):  # false for a name no file can have
        return direct
    near = difflib.get_close_matches(name_or_path, available_profiles(), n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    raise ProfileError(
        f"--profile {name_or_path}",
        "no such profile",
        limit=", ".join(available_profiles()),
        remedy=f"{hint}name one of these, a path to a TOML file, or the log of a run",
    )
