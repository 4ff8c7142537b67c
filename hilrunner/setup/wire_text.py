"""A mapping as it was understood, as lines for a person: what arrives, what is sent, what stays constant, what the bus carries."""

from hilrunner.realtime import decode
from hilrunner.setup.axes import period_ns
from hilrunner.setup.contract import dbc_path
from hilrunner.setup.database import database_notes, load_database
from hilrunner.setup.host_can import FrameTraffic, bus_load_ratio
from hilrunner.setup.profile import LoadedProfile
from hilrunner.setup.signals import Wiring
from hilrunner.setup.wire_facts import FrameFacts, is_fd

_LOOKS_FILLED = ("crc", "checksum", "chksum", "cksum", "counter", "cntr", "alive", "rolling", "sequence")


def wiring_lines(loaded: LoadedProfile, understood: Wiring) -> list[str]:
    """The messages of a mapping, one line a message and a signal."""
    lines = []
    for title, facts in (("received", understood.received_facts), ("sent", understood.sent_facts)):
        for one in facts:
            lines.append(f"{title} {_frame(one, period_ns(loaded))}")
            lines += [f"  {signal.name}: {signal.use}; {signal.bits}; {signal.values}" for signal in one.signals]
            if one.constants:
                lines.append(f"  stays constant: {', '.join(one.constants)}")
            lines += [f"  {note}" for note in one.notes]
    return lines


def _frame(one: FrameFacts, period: int) -> str:
    digits = 8 if one.is_extended else 3
    kind = f"{one.length} bytes{', CAN FD' if one.is_fd else ''}"
    cycle = (
        f"every {one.cycle_ms:g} ms" if one.cycle_ms else f"no cycle time: taken as every period, {period / 1e6:g} ms"
    )
    return f"{one.name} 0x{one.can_id:0{digits}X}, {kind}, {cycle}, protection: {one.protection}"


def wiring_dict(understood: Wiring) -> dict:
    """The same for scripts."""

    def frame(one: FrameFacts) -> dict:
        return {
            "name": one.name,
            "id": one.can_id,
            "extended": one.is_extended,
            "length": one.length,
            "fd": one.is_fd,
            "cycle_ms": one.cycle_ms,
            "protection": one.protection,
            "signals": [{"name": s.name, "use": s.use, "bits": s.bits, "values": s.values} for s in one.signals],
            "constants": one.constants,
            "notes": one.notes,
        }

    return {
        "received": [frame(one) for one in understood.received_facts],
        "sent": [frame(one) for one in understood.sent_facts],
    }


def wiring_notes(loaded: LoadedProfile, understood: Wiring) -> list[str]:
    """What is odd about a mapping and was lived with: one sentence each, with the remedy."""
    path = dbc_path(loaded)
    notes = [f"{path.name}: {note}" for note in database_notes(path)]
    notes += _one_way_commands(path.name, understood)
    for one in understood.sent_facts:
        left = [
            text for text in one.constants if any(word in text.casefold().replace("_", "") for word in _LOOKS_FILLED)
        ]
        if left:
            notes.append(
                f"{path.name}: {one.name}: {', '.join(left)} looks like a counter or checksum that nobody fills; remedy: give "
                '`protection = { counter = "…", checksum = "…" }` to the message'
            )
    for index, sent in enumerate(understood.sent):
        message = next(
            at for at in range(understood.measurements.message_count)
            if 0 <= index - understood.measurements.signal_first[at] < understood.measurements.signal_count[at]
        )  # fmt: skip
        ticks = int(understood.measurements.period_ticks[message])
        if sent.quantity == "tick" and ticks > 1 and sent.signal.length <= 8:
            notes.append(
                f"{path.name}: {sent.name} carries the bench's tick, which moves by {ticks} from frame to frame; remedy: a counter of "
                f'frames is `protection = {{ counter = "{sent.signal.name}" }}`'
            )
    return notes


def _one_way_commands(place: str, understood: Wiring) -> list[str]:
    """Axes whose command can only extend or only retract."""
    notes = []
    table = understood.commands
    for axis in range(max((int(group["axis"]) for group in table.groups), default=-1) + 1):
        fields = [
            at
            for group in table.groups
            if group["axis"] == axis
            for at in range(int(group["field_first"]), int(group["field_first"]) + int(group["field_count"]))
        ]
        roles = {int(table.fields[at]["role"]): at for at in fields}
        if decode.INPUT_DIRECTION in roles or decode.INPUT_OPPOSED in roles or decode.INPUT_SETPOINT not in roles:
            continue
        low, high = _reach(table, roles[decode.INPUT_SETPOINT])
        if low >= 0 or high <= 0:
            way = "extend" if low >= 0 else "retract"
            names = [
                signal.name
                for one in understood.received_facts
                for signal in one.signals
                if signal.use.endswith(f"axis {axis + 1}")
            ]
            notes.append(
                f"{place}: the valve command of axis {axis + 1} ({names[0]}) goes from {low:g} to {high:g} and can only {way}; remedy: map "
                "`magnitude` and `direction`, or `current_a` and `current_b`, or correct the signal's range and offset"
            )
    return notes


def _reach(table: decode.CommandTable, at: int) -> tuple[float, float]:
    """Smallest and largest valve command that a set point can ask for."""
    field, row = table.fields[at], table.signals[at]
    if field["curve_count"]:
        first = int(field["curve_first"])
        values = table.curve_y[first : first + int(field["curve_count"])]
        return float(values.min()), float(values.max())
    ends = sorted(float(row[end]) * float(row["scale"]) + float(row["offset"]) for end in ("number_min", "number_max"))
    return ends[0], ends[1]


def whole_bus_load(loaded: LoadedProfile) -> float | None:
    """Share of the bus that all messages of the database with a cycle time would take; None where none has one."""
    if not loaded.profile.can.mapping:
        return None  # the shipped contract holds axes that the profile has not
    traffic = []
    for message in load_database(dbc_path(loaded)).messages:
        if message.cycle_time and message.cycle_time > 0 and message.length <= 64:
            traffic.append(
                FrameTraffic(1000 / message.cycle_time, message.length, bool(message.is_extended_frame), is_fd(message))
            )
    return bus_load_ratio(traffic, loaded.profile.can.bitrate) if traffic else None
