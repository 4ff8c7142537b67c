"""CAN messages by name for tests: encode with end-to-end protection as the DBC declares it, decode to signal values."""

from pathlib import Path

import cantools
import numpy as np

from hilrunner.base.errors import DbcError
from hilrunner.realtime.e2e import COUNTER_MODULUS, crc_p02
from hilrunner.setup.database import load_database

_CRC_NAMES = ("crc8", "crc")
_COUNTER_NAMES = ("alive_counter", "counter")


class Messages:
    """The messages of one DBC.

    Args:
        dbc_path: the file. Raises DbcError when it cannot be read.
    """

    def __init__(self, dbc_path: str | Path) -> None:
        self.database = load_database(dbc_path)
        self._by_id = {(one.frame_id, one.is_extended_frame): one for one in self.database.messages}
        self._counters: dict[str, int] = {}

    def find(self, name: str):
        """A message by name; DbcError with the names there are."""
        try:
            return self.database.get_message_by_name(name)
        except KeyError:
            known = ", ".join(sorted(one.name for one in self.database.messages))
            raise DbcError(name, "no such message in the DBC", known, "name one of these") from None

    def encode(self, name: str, values: dict) -> bytes:
        """The next frame of a message: signals not given have their start value, counter and CRC are filled in.

        Raises DbcError for an unknown signal or a value the signal cannot hold.
        """
        message = self.find(name)
        known = {signal.name: signal for signal in message.signals}
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise DbcError(f"{name}.{unknown[0]}", "no such signal", ", ".join(known), "name one of these")
        filled = {signal.name: _start_value(signal) for signal in message.signals} | values
        counter = self._counters.get(name, 0)
        self._counters[name] = (counter + 1) % COUNTER_MODULUS
        for signal_name in _COUNTER_NAMES:
            if signal_name in known and signal_name not in values:
                filled[signal_name] = counter
        try:
            data = message.encode(filled, strict=True)
        except (cantools.Error, ValueError, KeyError, OverflowError) as error:
            raise DbcError(name, f"cannot be encoded: {error}", remedy="keep to the signal's range") from None
        ids = data_ids(message)
        if ids is None or set(values) & set(_CRC_NAMES):
            return data
        protected = np.frombuffer(data, np.uint8).copy()
        protected[0] = crc_p02(protected, len(protected), ids[int(protected[1]) & 0x0F])
        return protected.tobytes()

    def decode(self, frame_id: int, is_extended: bool, data: bytes) -> tuple[str, dict] | None:
        """(message name, signal -> value; words for values with a table); None for a frame that is not of the DBC."""
        message = self._by_id.get((frame_id, is_extended))
        if message is None:
            return None
        try:
            decoded = message.decode(data, decode_choices=True, allow_truncated=False)
        except (cantools.Error, ValueError):
            return None
        return message.name, {key: _plain(value) for key, value in decoded.items()}


def data_ids(message) -> np.ndarray | None:
    """Data ID list of a message protected by end-to-end profile 2, uint8[16]; None for one that is not."""
    attributes = message.dbc.attributes if message.dbc is not None else {}
    if "E2EProfile" not in attributes or attributes["E2EProfile"].value != "P02":
        return None
    words = attributes["E2EDataIdList"].value.replace(",", " ").split()
    return np.array([int(word) for word in words], np.uint8)


def _start_value(signal):
    if signal.raw_initial is not None:
        return signal.conversion.raw_to_scaled(signal.raw_initial, decode_choices=False)
    low = signal.minimum if signal.minimum is not None else 0
    high = signal.maximum if signal.maximum is not None else 0
    return min(max(0, low), high) if high > low else 0


def _plain(value):
    """A number, or the word of a value table."""
    return str(value) if hasattr(value, "name") else value
