"""A profile proposed for a database nobody has mapped yet: by names, units and ranges, with the reason beside each line.

A proposal is a beginning: what could not be found is named in it, and what was found is checked by the same code that reads a profile.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

from hilrunner.base.errors import DbcError
from hilrunner.setup import map_scores
from hilrunner.setup.database import database_notes, load_database
from hilrunner.setup.map_scores import COMMANDS, LEAST_POINTS, MEASUREMENTS, index_words, points, words

_LINES = ("enable", "dump", "safety", "reset")
_DEADBAND_RATIO = 0.3  # of full current, where nothing better is known
AXES_MAX = 8


@dataclass(frozen=True)
class Found:
    """A signal proposed for a use."""

    use: str
    message: object
    signal: object
    score: int
    why: str

    @property
    def key(self) -> tuple[str, str]:
        """Which signal it is."""
        return self.message.name, self.signal.name


@dataclass
class AxisProposal:
    """What is proposed for one axis."""

    name: str
    command: dict[str, Found] = field(default_factory=dict)
    measurements: dict[str, Found] = field(default_factory=dict)


@dataclass
class Proposal:
    """The axes, and what was noticed on the way."""

    database: str
    axes: list[AxisProposal]
    notes: list[str]


def propose(path: Path, node: str | None = None) -> Proposal:
    """Look for commands and measurements in a database.

    Args:
        node: the ECU under test: what it sends are commands, what others send are measurements. None: told by the names.

    Raises:
        DbcError: the file cannot be read, knows no such node, or holds nothing that looks like a valve command.
    """
    database = load_database(path)
    notes = [f"{path.name} {note}" for note in database_notes(path)]
    commands, measurements = _sides(path, database, node)
    found = _all_found(COMMANDS, commands)
    setpoints = _setpoints(found)
    if not setpoints:
        names = ", ".join(message.name for message in commands[:12])
        raise DbcError(
            str(path), "holds no signal that looks like a valve command", f"messages looked at: {names or 'none'}",
            "name the ECU under test with --node, or write the mapping by hand (docs/mapping.md)",
        )  # fmt: skip
    if len(setpoints) > AXES_MAX:
        notes.append(f"{len(setpoints)} signals look like valve commands; the best {AXES_MAX} are proposed")
    axes = [_axis(setpoint, found, number) for number, setpoint in enumerate(setpoints[:AXES_MAX], 1)]
    used = {one.message.name for axis in axes for one in axis.command.values()}
    sensed = _all_found(MEASUREMENTS, [message for message in measurements if message.name not in used])
    _share_out(axes, sensed)
    for axis in axes:
        if not axis.measurements:
            notes.append(f"axis {axis.name}: no signal looks like a measurement of it")
    if node is None and any(message.senders for message in database.messages):
        senders = sorted({sender for message in database.messages for sender in message.senders})
        notes.append(
            f"the database names senders ({', '.join(senders[:8])}); --node NAME says which of them is the firmware under test"
        )
    return Proposal(path.name, axes, notes)


def _sides(path: Path, database, node: str | None) -> tuple[list, list]:
    """(messages that may carry commands, messages that may carry measurements)."""
    messages = [message for message in database.messages if 1 <= message.length <= 64]
    if node is None:
        return messages, messages
    senders = {sender for message in messages for sender in message.senders}
    if node not in senders:
        raise DbcError(
            str(path),
            f"no node '{node}' sends anything",
            ", ".join(sorted(senders)) or "no senders are named",
            "correct --node",
        )
    sent = [message for message in messages if node in message.senders]
    return sent, [message for message in messages if node not in message.senders]


def _all_found(uses, messages: list) -> list[Found]:
    """Every signal with every use it may have, the likeliest first."""
    found = []
    for message in messages:
        for signal in message.signals:
            for use in uses:
                score, why = points(use, message, signal)
                if score >= LEAST_POINTS:
                    found.append(Found(use.key, message, signal, score, why))
    return sorted(found, key=lambda one: -one.score)  # stable: in the order of the database


def _setpoints(found: list[Found]) -> list[Found]:
    """One a signal that commands a valve; currents of edge A stand for their pair."""
    chosen: dict[tuple[str, str], Found] = {}
    for one in found:
        if one.use in ("valve_command", "magnitude", "current_a"):
            chosen.setdefault(one.key, one)
    directed = {one.message.name for one in found if one.use == "direction"}
    kept = [
        replace(one, use="magnitude", why=f"{one.why}, one way only, with a direction beside it")
        if one.use == "valve_command" and one.message.name in directed and _goes_one_way(one.signal)
        else one
        for one in chosen.values()
    ]
    return sorted(kept, key=lambda one: -one.score)


def _goes_one_way(signal) -> bool:
    """Whether a signal can carry nothing below zero."""
    low = signal.minimum if signal.minimum is not None else None
    if low is None or (low == 0 and signal.maximum == 0):
        return not signal.is_signed and not signal.is_float and signal.offset >= 0
    return low >= 0


def _axis(setpoint: Found, found: list[Found], number: int) -> AxisProposal:
    """A command with what goes with it in the same message, or by the words that name its actuator."""
    marks = index_words(setpoint.signal.name) or index_words(setpoint.message.name)
    name = "_".join(sorted(word for word in marks if not word.isdigit())) or f"axis{number}"
    axis = AxisProposal(name, {setpoint.use: setpoint})
    wanted = {"magnitude": ("direction",), "current_a": ("current_b",)}.get(setpoint.use, ())
    for use in (*wanted, "control", "timestamp", *_LINES):
        near = [
            one
            for one in found
            if one.use == use and one.key != setpoint.key and one.key not in [f.key for f in axis.command.values()]
        ]
        near = [one for one in near if one.message.name == setpoint.message.name or use in _LINES]
        near.sort(key=lambda one: -len(marks & index_words(one.signal.name)))
        if near:
            axis.command[use] = near[0]
    return axis


def _share_out(axes: list[AxisProposal], sensed: list[Found]) -> None:
    """Give each measurement to the axis whose words it shares; each signal to one axis, each quantity of an axis once."""
    taken: set[tuple[str, str]] = set()
    names = {axis.name for axis in axes}
    if len(names) < len(axes):
        for number, axis in enumerate(axes, 1):
            axis.name = f"axis{number}"
    for axis in axes:
        setpoint = next(iter(axis.command.values()))
        marks = index_words(setpoint.signal.name) or index_words(setpoint.message.name)
        others = frozenset().union(*(index_words(next(iter(one.command.values())).signal.name) for one in axes)) - marks
        for one in sensed:
            mine = index_words(one.message.name) | index_words(one.signal.name)
            if (
                one.use in axis.measurements
                or one.key in taken
                or (len(axes) > 1 and mine & others and not mine & marks)
            ):
                continue
            axis.measurements[one.use] = one
            taken.add(one.key)


def profile_text(proposal: Proposal, database_name: str, profile_name: str) -> str:
    """The proposal as a profile with a comment on every line."""
    lines = [
        f"# Proposed by `hilrunner map {proposal.database}` from names, units and ranges: read every line before you trust it.",
        "# `hilrunner check` prints the mapping as it is understood; docs/mapping.md explains each key.",
        *(f"# note: {note}" for note in proposal.notes),
        f'name = "{profile_name}"',
        "",
    ]
    for axis in proposal.axes:
        lines += [
            "[[axis]]",
            f'name = "{axis.name}"',
            'model = "lift-flow.onnx"  # the plant: see docs/profiles.md',
            "",
        ]
    lines += [
        "[can]",
        f'dbc = "{database_name}"',
        "bitrate = 500000  # of the real bus, for its load; the file does not tell",
        "",
    ]
    for axis in proposal.axes:
        lines += ["[[can.mapping]]", *_command_lines(axis), *_measurement_lines(axis)]
    return "\n".join(lines).rstrip() + "\n"


def _command_lines(axis: AxisProposal) -> list[str]:
    first = next(iter(axis.command.values()))
    lines = ["[can.mapping.command]", f'message = "{first.message.name}"']
    for use, one in axis.command.items():
        elsewhere = "" if one.message is first.message else f'message = "{one.message.name}", '
        lines.append(f"{use} = {_command_value(use, one, elsewhere)}  # {one.why}")
        if use == "control":
            lines += _control_lines(one)
    protection = _protection(first.message)
    lines += [protection] if protection else []
    if not any(use in axis.command for use in ("control", "reset")):
        lines.append(
            "# no control word was found: every valid frame counts as Active, a latched fail-safe lasts to the end of the run"
        )
    return [*lines, ""]


def _command_value(use: str, one: Found, elsewhere: str) -> str:
    signal, name = one.signal, f'"{one.signal.name}"'
    if use == "direction":
        return f"{{ {elsewhere}signal = {name}, {_direction_values(signal)} }}"
    if use in ("current_a", "current_b"):
        full = signal.maximum if signal.maximum else 700.0
        return f"{{ {elsewhere}signal = {name}, deadband = {_DEADBAND_RATIO * full:g}, full = {full:g} }}"
    return f"{{ {elsewhere}signal = {name} }}" if elsewhere else name


def _direction_values(signal) -> str:
    """Which values extend and retract: by the value table, else the usual 1 and 2."""
    told = {}
    for number, text in (signal.choices or {}).items():
        said = words(str(text))
        for key, known in (
            ("extend", "extend out raise up lift"),
            ("retract", "retract in lower down"),
            ("float", "float"),
            ("block", "block neutral hold stop"),
        ):
            if key not in told and set(said.split()) & set(known.split()):
                told[key] = int(number)
    told = told if {"extend", "retract"} <= told.keys() else {"extend": 1, "retract": 2, "block": 0}
    return ", ".join(f"{key} = {value}" for key, value in told.items())


def _control_lines(one: Found) -> list[str]:
    told = {}
    for number, text in (one.signal.choices or {}).items():
        said = set(words(str(text)).split())
        for key, known in (
            ("disabled", "disabled disable off init"),
            ("hold", "hold standby ready stop"),
            ("active", "active run on auto enabled"),
            ("reset", "reset clear"),
        ):
            if key not in told and said & set(known.split()):
                told[key] = int(number)
    if told:
        return [
            f"control_values = {{ {', '.join(f'{key} = {value}' for key, value in told.items())} }}  # by the value table"
        ]
    return [
        "# control_values = { disabled = 0, hold = 1, active = 2, reset = 3 }  # the default; the file has no value table"
    ]


def _protection(message) -> str:
    """Counter and checksum of a message, where signals are called so and the database declares no profile."""
    attributes = message.dbc.attributes if message.dbc and message.dbc.attributes else {}
    if "E2EProfile" in attributes and attributes["E2EProfile"].value:
        return ""
    plain = [signal for signal in message.signals if not signal.is_float and signal.multiplexer_ids is None]
    counter = next(
        (one.name for one in plain if map_scores.COUNTER_NAMES.search(words(one.name)) and one.length <= 16), None
    )
    checksum = next(
        (one for one in plain if map_scores.CHECKSUM_NAMES.search(words(one.name)) and one.length <= 64), None
    )
    parts = [f'counter = "{counter}"'] if counter else []
    remark = "counts frames"
    if checksum is not None:
        algorithm = "CRC-8/SAE-J1850" if "crc" in words(checksum.name) and checksum.length == 8 else "sum"
        parts += [f'checksum = "{checksum.name}"', f'algorithm = "{algorithm}"']
        remark = "the algorithm is a guess: ask the firmware's protocol document"
    return f"protection = {{ {', '.join(parts)} }}  # {remark}" if parts else ""


def _measurement_lines(axis: AxisProposal) -> list[str]:
    by_message: dict[str, list[Found]] = {}
    for one in axis.measurements.values():
        by_message.setdefault(one.message.name, []).append(one)
    if not by_message:
        return [
            "measurements = []  # nothing looks like a measurement: the firmware would see nothing of the plant",
            "",
        ]
    lines = []
    for name, found in by_message.items():
        lines += ["[[can.mapping.measurements]]", f'message = "{name}"']
        if not found[0].message.cycle_time:
            lines.append("cycle_ms = 10  # the database names no cycle time")
        protection = _protection(found[0].message)
        lines += [protection] if protection else []
        lines.append("[can.mapping.measurements.signals]")
        lines += [f"{one.use} = {_measured(one)}  # {one.why}" for one in found]
        lines.append("")
    return lines


def _measured(one: Found) -> str:
    unit = map_scores.unit_of(one.signal)
    if one.use != "bench_state" and unit != (one.signal.unit or "").strip():
        return f'{{ signal = "{one.signal.name}", unit = "{unit}" }}'
    return f'"{one.signal.name}"'
