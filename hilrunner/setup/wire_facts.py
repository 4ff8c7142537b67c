"""What a person wants to know of a mapped message, gathered while its tables are made; `hilrunner check` prints it."""

from dataclasses import dataclass, field

ID_FLAGS = 0x80000000  # CAN_EFF_FLAG of linux/can.h


@dataclass
class SignalFacts:
    """One mapped signal."""

    name: str
    use: str  # what it carries or asks for
    bits: str
    values: str  # scale, unit, range
    effective: object = None  # setup.signal_layout.Signal


@dataclass
class FrameFacts:
    """One message of the mapping."""

    name: str
    can_id: int
    is_extended: bool
    length: int
    is_fd: bool
    cycle_ms: float | None  # as the database or the mapping says; None: it does not say
    protection: str
    signals: list[SignalFacts] = field(default_factory=list)
    constants: list[str] = field(default_factory=list)  # signals nobody fills, with the value they keep
    notes: list[str] = field(default_factory=list)


def can_id(message) -> int:
    """The identifier with CAN_EFF_FLAG for 29 bits."""
    return message.frame_id | (ID_FLAGS if message.is_extended_frame else 0)


def is_fd(message) -> bool:
    """Whether the message goes out as a CAN FD frame."""
    return bool(message.is_fd) or message.length > 8


def has_fast_data(message) -> bool:
    """Whether the database asks for the bit-rate switch of CAN FD (Vector's attribute CANFD_BRS)."""
    attributes = message.dbc.attributes if message.dbc and message.dbc.attributes else {}
    value = attributes["CANFD_BRS"].value if "CANFD_BRS" in attributes else 0
    return is_fd(message) and str(value) in ("1", "1.0", "Yes", "yes", "On", "on", "true", "True")


def frame_facts(message, cycle_ms: float | None, protection: str) -> FrameFacts:
    """The facts of a message before its signals are known."""
    return FrameFacts(
        message.name,
        message.frame_id,
        bool(message.is_extended_frame),
        message.length,
        is_fd(message),
        cycle_ms,
        protection,
    )


def signal_facts(signal, use: str, row=None) -> SignalFacts:
    """The facts of one signal (setup.signal_layout.Signal); `row` tells the range that holds on the wire."""
    order = "Motorola" if signal.byte_order == "big_endian" else "Intel"
    kind = "float" if signal.is_float else "signed" if signal.is_signed else "unsigned"
    scale = f"{signal.scale:g} x + {signal.offset:g}" if signal.offset else f"{signal.scale:g} x"
    text = f"{scale} {signal.unit}".rstrip()
    if row is not None:
        ends = sorted(
            float(row[end]) * float(signal.scale) + float(signal.offset) for end in ("number_min", "number_max")
        )
        text += f", {ends[0]:g} to {ends[1]:g}"
    page = ""
    if signal.multiplexer_ids is not None:
        page = f", page {signal.multiplexer_signal} = {'/'.join(str(number) for number in signal.multiplexer_ids[:6])}"
    return SignalFacts(signal.name, use, f"{signal.start}|{signal.length} {order} {kind}{page}", text, signal)
