"""The mapped messages of a profile as a DBC: for those who have none, or have their network in another format.

Scale, unit and range are those of the mapping; each signal's comment says what it carries.
"""

import cantools
from cantools.database.can.formats.dbc.dbc_specifics import DbcSpecifics
from cantools.database.conversion import BaseConversion

from hilrunner.setup.contract import wiring
from hilrunner.setup.profile import LoadedProfile
from hilrunner.setup.wire_facts import FrameFacts


def dbc_text(loaded: LoadedProfile) -> str:
    """The DBC; DbcError or ProfileError where the mapping cannot be understood."""
    understood = wiring(loaded)
    messages = [_message(understood.described[facts.name], facts, False) for facts in understood.received_facts]
    messages += [_message(understood.described[facts.name], facts, True) for facts in understood.sent_facts]
    nodes = [cantools.database.can.Node(name, comment) for name, comment in (
        ("FIRMWARE", "The controller under test."), ("BENCH", "hilrunner: the simulated actuator."),
    )]  # fmt: skip
    database = cantools.database.Database(messages=messages, nodes=nodes, version="1.0", dbc_specifics=DbcSpecifics())
    return database.as_dbc_string().replace("\r\n", "\n")


def _message(message, facts: FrameFacts, is_sent: bool):
    sender, receiver = ("BENCH", "FIRMWARE") if is_sent else ("FIRMWARE", "BENCH")
    told: dict[str, list] = {}
    for one in facts.signals:
        told.setdefault(one.name, []).append(one)
    return cantools.database.can.Message(
        frame_id=message.frame_id,
        name=message.name,
        length=message.length,
        signals=[_signal(signal, told.get(signal.name, []), receiver) for signal in message.signals],
        comment=f"{'Sent' if is_sent else 'Received'} by the bench; protection: {facts.protection}",
        senders=[sender],
        is_extended_frame=message.is_extended_frame,
        is_fd=message.is_fd,
        cycle_time=None if not facts.cycle_ms else round(facts.cycle_ms),
        dbc_specifics=message.dbc,
        strict=False,
    )


def _signal(signal, told: list, receiver: str):
    scale, offset, unit, ends = signal.scale, signal.offset, signal.unit, (signal.minimum, signal.maximum)
    use = signal.comment
    if told:
        first = told[0].effective
        scale, offset, unit, ends = first.scale, first.offset, first.unit, (first.minimum, first.maximum)
        use = "; ".join(one.use for one in told)
    return cantools.database.can.Signal(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        byte_order=signal.byte_order,
        is_signed=signal.is_signed,
        raw_initial=signal.raw_initial,
        conversion=BaseConversion.factory(scale=scale, offset=offset, choices=signal.choices, is_float=signal.is_float),
        minimum=ends[0],
        maximum=ends[1],
        unit=unit or None,
        comment=use,
        receivers=[receiver],
        is_multiplexer=signal.is_multiplexer,
        multiplexer_ids=signal.multiplexer_ids,
        multiplexer_signal=signal.multiplexer_signal,
    )
