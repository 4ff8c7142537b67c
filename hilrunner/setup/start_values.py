"""What a message carries before anybody fills it: every signal at its start value.

GenSigStartValue is a raw value: the integer on the wire, for a float signal the float itself. Of multiplexed signals only those
are there that the multiplexer's own start value selects.
"""

import struct

import numpy as np

from hilrunner.realtime import encode
from hilrunner.setup.signal_layout import bit_places

_FLOAT_FORMATS = {16: "<e", 32: "<f", 64: "<d"}
_ATTRIBUTE = "GenSigStartValue"


def start_image(message, selected: dict[str, int] | None = None) -> np.ndarray:
    """u1[64]: the data bytes of a message with every signal at its start value (0 without one).

    Args:
        selected: values of multiplexer signals in place of their start values.
    """
    image = np.zeros(encode.DATA_SIZE_MAX, np.uint8)
    for signal in present_signals(message, selected or {}):
        raw = (selected or {}).get(signal.name, start_bits(signal))
        put_bits(image, signal, raw)
    return image


def put_bits(image: np.ndarray, signal, raw: int) -> None:
    """Write the raw bits of a signal into the data bytes, over what stands there."""
    for index, place in enumerate(bit_places(signal.start, signal.length, signal.byte_order)):
        if not 0 <= place // 8 < len(image):
            continue
        mask = 1 << place % 8
        image[place // 8] = int(image[place // 8]) & ~mask & 0xFF | (mask if raw >> index & 1 else 0)


def present_signals(message, selected: dict[str, int]) -> list:
    """The signals a frame carries when its multiplexers stand at their start values, or at `selected`."""
    values = {signal.name: selected.get(signal.name, start_bits(signal)) for signal in message.signals}
    chosen = {signal.name: signal for signal in message.signals}

    def is_there(signal, depth: int = 0) -> bool:
        if signal.multiplexer_ids is None or signal.multiplexer_signal not in chosen or depth > len(chosen):
            return True
        parent = chosen[signal.multiplexer_signal]
        return values[parent.name] in signal.multiplexer_ids and is_there(parent, depth + 1)

    return [signal for signal in message.signals if is_there(signal)]


def start_number(signal) -> float:
    """The raw start value as the database gives it, or its default for all signals; 0 without either."""
    if signal.raw_initial is not None:
        return signal.raw_initial
    definitions = signal.dbc.attribute_definitions if signal.dbc else None
    default = definitions[_ATTRIBUTE].default_value if definitions and _ATTRIBUTE in definitions else None
    return default if isinstance(default, int | float) else 0


def start_bits(signal) -> int:
    """The raw start value as bits; an integer signal takes the nearest whole number."""
    number = start_number(signal)
    if signal.is_float and signal.length in _FLOAT_FORMATS:
        return int.from_bytes(struct.pack(_FLOAT_FORMATS[signal.length], float(number)), "little")
    return round(number) & ((1 << signal.length) - 1)


def start_value_notes(message) -> list[str]:
    """Start values that an integer signal cannot carry as they stand, in words."""
    notes = []
    for signal in message.signals:
        number = start_number(signal)
        if signal.is_float:
            continue
        low, high = (
            (-(1 << signal.length - 1), (1 << signal.length - 1) - 1)
            if signal.is_signed
            else (0, (1 << signal.length) - 1)
        )
        if number != round(number) or not low <= number <= high:
            notes.append(
                f"{message.name}.{signal.name}: its start value {number:g} is a raw value (GenSigStartValue) and does not fit "
                f"{signal.length} {'signed' if signal.is_signed else 'unsigned'} bits; {start_bits(signal)} is sent"
            )
    return notes
