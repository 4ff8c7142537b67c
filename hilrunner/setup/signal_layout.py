"""One DBC signal becomes one row of realtime.bits.SIGNAL: where its bits lie, scale to SI, range on the wire.

Decimal numbers of the DBC are taken as exact fractions: 16384 * 0.006103515625 % is exactly 1, not nearly.
"""

import math
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

from hilrunner.base.errors import DbcError
from hilrunner.realtime import bits, encode
from hilrunner.setup.mapping import SignalMapping, as_mapping

LARGEST_NUMBER = 1e30  # of a scale, an offset, an end of a range: no quantity comes near, and sums of them stay finite


@dataclass(frozen=True)
class Signal:
    """A signal as the tables need it: the database's, with what the mapping says in its place."""

    name: str
    start: int  # as a DBC gives it
    length: int
    byte_order: str  # little_endian, big_endian
    is_signed: bool
    is_float: bool
    scale: float
    offset: float
    minimum: float | None
    maximum: float | None
    unit: str
    choices: dict | None
    multiplexer_ids: tuple[int, ...] | None
    multiplexer_signal: str | None


def find(place: str, message, mapped: str | SignalMapping) -> Signal:
    """The signal a mapping names; DbcError with the names there are."""
    mapped = as_mapping(mapped)
    for signal in message.signals:
        if signal.name == mapped.signal:
            return _with_mapping(signal, mapped)
    known = ", ".join(signal.name for signal in message.signals)
    raise DbcError(f"{place}: {message.name}", f"no signal '{mapped.signal}'", known)


def _with_mapping(signal, mapped: SignalMapping) -> Signal:
    own_scale = mapped.scale is not None or mapped.offset is not None  # the database's range is one of its own scale
    minimum, maximum = (None, None) if own_scale else (signal.minimum, signal.maximum)
    if mapped.range is not None:
        minimum, maximum = mapped.range
    return Signal(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        byte_order=signal.byte_order,
        is_signed=bool(signal.is_signed),
        is_float=bool(signal.is_float),
        scale=signal.scale if mapped.scale is None else mapped.scale,
        offset=signal.offset if mapped.offset is None else mapped.offset,
        minimum=minimum,
        maximum=maximum,
        unit=(signal.unit or "").strip(),
        choices=signal.choices,
        multiplexer_ids=None if signal.multiplexer_ids is None else tuple(signal.multiplexer_ids),
        multiplexer_signal=signal.multiplexer_signal,
    )


def bit_places(start: int, length: int, byte_order: str) -> list[int]:
    """Place (byte * 8 + bit) of each raw bit, lowest first, from the start bit as a DBC gives it.

    DBC start bits: the lowest bit of a little-endian signal, the highest of a big-endian one (Vector DBC format).
    """
    if byte_order == "little_endian":
        return list(range(start, start + length))
    places = []
    place = start
    for _ in range(length):
        places.append(place)
        place = place - 1 if place % 8 else place + 15
    return places[::-1]


def windows(places: list[int], big_endian: bool) -> list[tuple[int, int, int, int]]:
    """(first byte, shift, width, raw place) of each window of eight data bytes that a signal is read from; one or two.

    Args:
        places: from bit_places. big_endian: the first byte of a window is its highest.
    """
    out = []
    raw = 0
    while raw < len(places):
        byte, bit = divmod(places[raw], 8)
        if big_endian:  # the lowest bit lies in the last byte
            first = max(byte - (bits.WINDOW_BYTES - 1), 0)
            shift = 8 * (first + bits.WINDOW_BYTES - 1 - byte) + bit
        else:
            first = min(byte, encode.DATA_SIZE_MAX - bits.WINDOW_BYTES)
            shift = 8 * (byte - first) + bit
        width = min(len(places) - raw, 8 * bits.WINDOW_BYTES - shift)
        out.append((first, shift, width, raw))
        raw += width
    return out


def window_bits(row: np.ndarray) -> int:
    """The data bits a signal takes, as one number: data byte b holds bits 8 b … 8 b + 7."""
    own = 0
    for index in range(int(row["window_count"])):
        word = int(row["window_mask"][index]) << int(row["window_shift"][index])
        raw = word.to_bytes(bits.WINDOW_BYTES, "big" if row["big_endian"] else "little")
        own |= int.from_bytes(raw, "little") << 8 * int(row["window_byte"][index])
    return own


def row(where: str, signal, factor: Fraction, modulus: bool) -> np.ndarray:
    """The row of a signal whose physical value times `factor` is SI; `modulus`: it wraps instead of being clamped."""
    if not 1 <= signal.length <= 64:
        raise DbcError(where, f"{signal.length} bits long", "1..64 bits")
    _check_numbers(where, signal)
    scale = Fraction(str(signal.scale))
    if scale == 0 or factor == 0:
        raise DbcError(where, "a scale of 0 carries nothing")
    out = np.zeros((), bits.SIGNAL)
    out["big_endian"] = signal.byte_order == "big_endian"
    cut = windows(bit_places(signal.start, signal.length, signal.byte_order), bool(out["big_endian"]))
    out["window_count"] = len(cut)
    for index, (first, shift, width, place) in enumerate(cut):
        out["window_byte"][index] = first
        out["window_shift"][index] = shift
        out["window_mask"][index] = (1 << width) - 1
        out["window_place"][index] = place
    out["kind"] = _kind(where, signal)
    out["bit_mask"] = (1 << signal.length) - 1
    out["sign_bit"] = 1 << (signal.length - 1) if out["kind"] == bits.KIND_SIGNED else 0
    out["scale"] = float(scale * factor)
    out["offset"] = float(Fraction(str(signal.offset)) * factor)
    out["number_min"], out["number_max"] = _number_range(where, signal, int(out["kind"]), scale)
    if modulus:
        _check_modulus(where, signal, out)
        out["modulus"] = float(1 << signal.length)
        out["number_min"], out["number_max"] = 0.0, float((1 << signal.length) - 1)
    return out


def _check_numbers(where: str, signal) -> None:
    """The parser takes 1e999 and makes infinity of it; start bits and scales have no bounds in the format."""
    for name in ("scale", "offset", "minimum", "maximum"):
        value = getattr(signal, name)
        if value is not None and not abs(value) <= LARGEST_NUMBER:
            raise DbcError(where, f"{name} {value}", f"numbers up to {LARGEST_NUMBER:g}", "correct it in the DBC")
    if signal.scale != 0 and abs(signal.scale) < 1 / LARGEST_NUMBER:
        raise DbcError(where, f"scale {signal.scale}", f"at least {1 / LARGEST_NUMBER:g}", "correct it in the DBC")
    places = bit_places(signal.start, signal.length, signal.byte_order)
    if not 0 <= min(places) <= max(places) < 8 * encode.DATA_SIZE_MAX:
        raise DbcError(
            where, f"start bit {signal.start} with {signal.length} bits reaches beyond every frame",
            f"bits 0 to {8 * encode.DATA_SIZE_MAX - 1}", "correct the start bit",
        )  # fmt: skip


def _kind(where: str, signal) -> int:
    if not signal.is_float:
        return bits.KIND_SIGNED if signal.is_signed else bits.KIND_UNSIGNED
    if signal.length == 32:
        return bits.KIND_FLOAT32
    if signal.length == 64:
        return bits.KIND_FLOAT64
    raise DbcError(where, f"a float of {signal.length} bits", "32 or 64 bits")


def _check_modulus(where: str, signal, out: np.ndarray) -> None:
    """Counters and time stamps wrap at the signal's width, so the width must be exact in a float64."""
    if out["kind"] != bits.KIND_UNSIGNED or signal.length > 52 or out["offset"] != 0 or out["scale"] < 0:
        raise DbcError(where, "a counter that wraps must be unsigned, without offset", "up to 52 bits")


def _number_range(where: str, signal, kind: int, scale: Fraction) -> tuple[float, float]:
    """Allowed numbers on the wire: the range told, cut to what the bits can hold; [0|0] means no range."""
    low, high = _full_range(signal.length, kind)
    minimum, maximum = signal.minimum, signal.maximum
    if minimum is not None and maximum is not None and not (minimum == 0 and maximum == 0):
        offset = Fraction(str(signal.offset))
        ends = sorted(((Fraction(str(end)) - offset) / scale) for end in (minimum, maximum))
        if kind <= bits.KIND_SIGNED:
            low, high = max(low, math.ceil(ends[0])), min(high, math.floor(ends[1]))
        else:
            low, high = max(low, float(ends[0])), min(high, float(ends[1]))
    if low > high:
        raise DbcError(where, f"range [{minimum}|{maximum}] holds no value its bits can carry")
    return _float_at_least(low), _float_at_most(high)


def _full_range(length: int, kind: int) -> tuple:
    if kind == bits.KIND_UNSIGNED:
        return 0, (1 << length) - 1
    if kind == bits.KIND_SIGNED:
        return -(1 << (length - 1)), (1 << (length - 1)) - 1
    largest = float(np.finfo(np.float32).max) if kind == bits.KIND_FLOAT32 else float(np.finfo(np.float64).max)
    return -largest, largest


def _float_at_most(value: int | float) -> float:
    """Largest float64 that is not above `value` (64-bit integers do not fit exactly)."""
    number = float(value)
    return math.nextafter(number, -math.inf) if number > value else number


def _float_at_least(value: int | float) -> float:
    number = float(value)
    return math.nextafter(number, math.inf) if number < value else number


@dataclass(frozen=True)
class Placed:
    """Bits of a message that somebody uses: the mapped signal of that name, on the page it belongs to."""

    name: str
    row: np.ndarray
    page: dict[str, frozenset[int]] = field(default_factory=dict)  # multiplexer -> numbers at which it is there

    def meets(self, other: "Placed") -> bool:
        """Whether one frame can carry both."""
        return all(self.page[name] & other.page[name] for name in self.page.keys() & other.page.keys())


def check_room(where: str, length: int, placed: list[Placed], reserved: int = 0, may_repeat: bool = False) -> None:
    """Every mapped signal inside the message, no two of a page on the same bits, none on those of the protection.

    Args:
        reserved: the protection's bits as one number. may_repeat: one signal may be read for several ends.
    """
    for index, one in enumerate(placed):
        own = window_bits(one.row)
        if own >> 8 * length:
            raise DbcError(where, "a mapped signal reaches beyond the message", f"{length} bytes")
        if own & reserved:
            raise DbcError(where, f"two mapped signals, or a signal and CRC or counter, share bits ({one.name})")
        for other in placed[:index]:
            if may_repeat and other.name == one.name:
                continue
            if own & window_bits(other.row) and one.meets(other):
                raise DbcError(
                    where, f"two mapped signals, or a signal and CRC or counter, share bits ({other.name}, {one.name})"
                )
