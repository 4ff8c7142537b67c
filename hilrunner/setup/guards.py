"""How the frames of a message are protected, from mapping or database to a row of realtime.checksum.GUARD.

AUTOSAR profiles: "Specification of SW-C End-to-End Communication Protection Library"; headers of P04 to P07 are big endian but for P05.
J1939: SAE J1939-71, Torque/Speed Control 1. Each profile is checked against the package autosar-e2e in the tests.
"""

from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

from hilrunner.base.errors import DbcError
from hilrunner.realtime import bits, checksum, e2e
from hilrunner.realtime.encode import PROTECTED_BY_GUARD, PROTECTED_P02, UNPROTECTED
from hilrunner.setup import signal_layout
from hilrunner.setup.crc_names import CrcParameters, named_crc
from hilrunner.setup.mapping import MAX_COUNTER_DELTA, Protection
from hilrunner.setup.signal_layout import Signal, find
from hilrunner.setup.user_check import ReadOwn, user_address

P02_BITS = 0x0FFF  # CRC and counter of profile 2
_CRC8 = CrcParameters(8, 0x1D, 0x00, False, False, 0x00)  # as profiles 1 and 11 use it
_CRC16 = CrcParameters(16, 0x1021, 0xFFFF, False, False, 0x0000)
_CRC32_P4 = CrcParameters(32, 0xF4ACFB13, 0xFFFFFFFF, True, True, 0xFFFFFFFF)
_CRC64 = CrcParameters(64, 0x42F0E1EBA9EA3693, (1 << 64) - 1, True, True, (1 << 64) - 1)
_SUMS = {
    "sum": checksum.ALGORITHM_SUM,
    "xor": checksum.ALGORITHM_XOR,
    "nibble-sum": checksum.ALGORITHM_NIBBLE_SUM,
}


@dataclass
class Guard:
    """One message's protection, ready for the tables."""

    kind: int = UNPROTECTED
    text: str = "none"  # for people
    data_ids: np.ndarray = field(default_factory=lambda: np.zeros(e2e.COUNTER_MODULUS, np.uint8))
    row: np.ndarray = field(default_factory=lambda: np.zeros((), checksum.GUARD))
    signals: list[np.ndarray] = field(default_factory=list)  # rows of counter and checksum, as `row` numbers them
    reserved: int = 0  # the bits of the message that belong to the protection
    counter_start: int = 0  # before the first frame that is sent
    fixed: list[tuple[int, int, int]] = field(default_factory=list)  # byte, mask, value


def make_guard(place: str, message, protection: Protection | str, max_counter_delta: int, read_own: ReadOwn) -> Guard:
    """The protection of a message; DbcError where it does not fit.

    Args:
        protection: of the mapping. read_own: the bytes of a file with a user's own function.
    """
    where = f"{place}: {message.name}"
    if protection == "none":
        return Guard()
    if protection == "dbc":
        protection = _declared(where, message)
        if protection is None:
            return Guard()
    if isinstance(protection, str):
        return _by_user(where, message, protection, read_own)
    profile = protection.profile or ("P02" if protection.data_id_list and not protection.checksum else "plain")
    guard = _BUILDERS[profile](where, message, protection)
    guard.row["counter_delta_max"] = _counter_delta_max(where, guard, max_counter_delta)
    return guard


def _counter_delta_max(where: str, guard: Guard, wanted: int) -> int:
    """The largest step of a counter that is no loss; the default gives way to a counter that has no room for it."""
    if guard.kind == PROTECTED_BY_GUARD and guard.row["counter_row"] == checksum.NO_ROW:
        return wanted
    modulus = int(guard.row["counter_modulus"]) if guard.kind == PROTECTED_BY_GUARD else e2e.COUNTER_MODULUS
    most = max(modulus - 2, 1)
    if wanted > most and wanted != MAX_COUNTER_DELTA:
        raise DbcError(where, f"max_counter_delta {wanted} does not fit", f"1..{most}")
    return min(wanted, most)


def _declared(where: str, message) -> Protection | None:
    """What the database's attributes E2EProfile, E2EDataIdList and E2EDataId say; None where they say nothing."""
    attributes = message.dbc.attributes if message.dbc and message.dbc.attributes else {}
    profile = str(attributes["E2EProfile"].value).strip() if "E2EProfile" in attributes else ""
    if not profile:
        return None
    if profile not in _BUILDERS or profile == "plain":
        known = ", ".join(name for name in _BUILDERS if name != "plain")
        raise DbcError(where, f"E2EProfile '{profile}' is not known", known)
    try:
        if profile == "P02":
            words = str(attributes["E2EDataIdList"].value).replace(",", " ").split()
            return Protection(profile="P02", data_id_list=[int(word) for word in words])
        if profile == "J1939":
            return Protection(profile="J1939")
        return Protection(profile=profile, data_id=int(attributes["E2EDataId"].value))
    except (KeyError, ValueError) as error:
        lacking = "E2EDataIdList" if profile == "P02" else "E2EDataId"
        allowed = "16 numbers 0..255" if profile == "P02" else "a number"
        raise DbcError(where, f"{lacking} cannot be read ({error})", allowed) from error


def _p02(where: str, message, protection: Protection) -> Guard:
    values = protection.data_id_list
    if len(values) != e2e.COUNTER_MODULUS or not all(0 <= value <= 255 for value in values):
        raise DbcError(where, f"Data ID list {values} does not fit", "16 numbers 0..255")
    if message.length < 2:
        raise DbcError(where, f"{message.length} bytes cannot hold P02", "2 bytes or more")
    guard = Guard(PROTECTED_P02, "AUTOSAR E2E P02: CRC-8 in byte 0, counter in byte 1", np.array(values, np.uint8))
    guard.reserved = P02_BITS
    return guard


def _field(name: str, byte: int, bit: int, length: int, big_endian: bool = True) -> Signal:
    """A header field: whole bytes from `byte` on, or `length` bits from `bit` of it on."""
    start = 8 * byte + (7 if big_endian and length >= 8 else bit)
    order = "big_endian" if big_endian and length >= 8 else "little_endian"
    return Signal(name, start, length, order, False, False, 1, 0, None, None, "", None, None, None)


def _start(where: str, message, protection: Protection, header_bytes: int, data_id_bits: int) -> int:
    """First byte of an AUTOSAR header; DbcError where the message has no room for it or the Data ID does not fit."""
    if protection.data_id is None or protection.data_id >> data_id_bits:
        found = "no data_id" if protection.data_id is None else f"data_id {protection.data_id}"
        raise DbcError(where, f"{protection.profile}: {found}", f"0..{(1 << data_id_bits) - 1}", "give `data_id`")
    if protection.offset_bytes + header_bytes > message.length:
        raise DbcError(
            where, f"{message.length} bytes cannot hold {protection.profile} from byte {protection.offset_bytes} on",
            f"{header_bytes} bytes",
        )  # fmt: skip
    return protection.offset_bytes


def _p01(where: str, message, protection: Protection) -> Guard:
    """Profiles 1 and 11: CRC-8 over Data ID and data, counter 0 … 14."""
    mode, name = protection.data_id_mode, protection.profile
    at = _start(where, message, protection, 2, 12 if mode == "nibble" else 16)
    if name == "P11" and mode not in ("both", "nibble"):
        raise DbcError(where, f"P11 knows no data_id_mode '{mode}'", "both, nibble")
    low, high = protection.data_id & 0xFF, protection.data_id >> 8
    guard = _guarded(f"AUTOSAR E2E {name}: CRC-8 in byte {at}, counter in byte {at + 1}, Data ID {mode}", 15)
    _place_counter(where, guard, _field("counter", at + 1, 0, 4))
    _place_checksum(where, message, guard, _field("CRC", at, 0, 8))
    _use_crc(guard, _CRC8)
    if mode == "alternating":
        guard.row["before_listed"] = 1
        guard.row["listed"] = [(low, high)[counter % 2] for counter in range(checksum.LISTED_COUNT)]
    else:
        _cover(where, guard, "before", {"both": [low, high], "low": [low], "nibble": [low, 0]}[mode])
    if mode == "nibble":
        _fix(guard, at + 1, 0xF0, high << 4)
    return guard


def _p04(where: str, message, protection: Protection) -> Guard:
    at = _start(where, message, protection, 12, 32)
    guard = _guarded(f"AUTOSAR E2E P04: header in bytes {at}..{at + 11}", 1 << 16)
    _fix_bytes(guard, at, message.length.to_bytes(2, "big"))
    _place_counter(where, guard, _field("counter", at + 2, 0, 16))
    _fix_bytes(guard, at + 4, protection.data_id.to_bytes(4, "big"))
    _place_checksum(where, message, guard, _field("CRC", at + 8, 0, 32))
    _use_crc(guard, _CRC32_P4)
    return guard


def _p05(where: str, message, protection: Protection) -> Guard:
    at = _start(where, message, protection, 3, 16)
    guard = _guarded(f"AUTOSAR E2E P05: header in bytes {at}..{at + 2}", 256)
    _place_checksum(where, message, guard, _field("CRC", at, 0, 16, big_endian=False))
    _place_counter(where, guard, _field("counter", at + 2, 0, 8))
    _use_crc(guard, _CRC16)
    _cover(where, guard, "after", list(protection.data_id.to_bytes(2, "little")))
    return guard


def _p06(where: str, message, protection: Protection) -> Guard:
    at = _start(where, message, protection, 5, 16)
    guard = _guarded(f"AUTOSAR E2E P06: header in bytes {at}..{at + 4}", 256)
    _place_checksum(where, message, guard, _field("CRC", at, 0, 16))
    _fix_bytes(guard, at + 2, message.length.to_bytes(2, "big"))
    _place_counter(where, guard, _field("counter", at + 4, 0, 8))
    _use_crc(guard, _CRC16)
    _cover(where, guard, "after", list(protection.data_id.to_bytes(2, "big")))
    return guard


def _p07(where: str, message, protection: Protection) -> Guard:
    at = _start(where, message, protection, 20, 32)
    guard = _guarded(f"AUTOSAR E2E P07: header in bytes {at}..{at + 19}", 1 << 32)
    _place_checksum(where, message, guard, _field("CRC", at, 0, 64))
    _fix_bytes(guard, at + 8, message.length.to_bytes(4, "big"))
    _place_counter(where, guard, _field("counter", at + 12, 0, 32))
    _fix_bytes(guard, at + 16, protection.data_id.to_bytes(4, "big"))
    _use_crc(guard, _CRC64)
    return guard


def _j1939(where: str, message, protection: Protection) -> Guard:
    """Message counter and checksum of TSC1: low and high nibble of the last byte, unless signals are named."""
    last = message.length - 1
    guard = _guarded("SAE J1939 message counter and checksum", protection.counter_modulus or 8)
    counter, told = _field("counter", last, 0, 4), _field("checksum", last, 4, 4)
    _place_counter(where, guard, _find(where, message, protection.counter) if protection.counter else counter)
    _place_checksum(where, message, guard, _find(where, message, protection.checksum) if protection.checksum else told)
    row = guard.row
    row["algorithm"], row["width"], row["mask"] = checksum.ALGORITHM_J1939, 4, 0x0F
    # the byte that holds both is left out; the counter is added by itself
    byte = int(row["checksum_byte"])
    row["skip_first"], row["skip_end"], row["blanked"] = byte, byte + 1, 0
    _cover(where, guard, "after", list(message.frame_id.to_bytes(4, "little")))
    return guard


def _plain(where: str, message, protection: Protection) -> Guard:
    """Counter and checksum by named signals."""
    if protection.counter is None and protection.checksum is None:
        raise DbcError(
            where, "protection names neither `counter` nor `checksum`", "one of them", "name the signals, or a profile"
        )
    told = []
    guard = _guarded("", 1)
    if protection.counter is not None:
        signal = _find(where, message, protection.counter)
        modulus = protection.counter_modulus or 1 << signal.length
        if modulus > 1 << signal.length or signal.length > 62:
            raise DbcError(
                where, f"counter_modulus {modulus} does not fit {signal.name}, {signal.length} bits", "up to 62 bits"
            )
        guard.row["counter_modulus"] = modulus
        guard.counter_start = ((protection.counter_first or 0) - 1) % modulus
        _place_counter(where, guard, signal)
        told.append(f"counter {signal.name} 0..{modulus - 1}")
    if protection.checksum is not None:
        told.append(_plain_checksum(where, message, protection, guard))
    guard.text = ", ".join(told)
    return guard


def _plain_checksum(where: str, message, protection: Protection, guard: Guard) -> str:
    signal = _find(where, message, protection.checksum)
    _place_checksum(where, message, guard, signal, protection)
    last = message.length - 1 if protection.last_byte is None else protection.last_byte
    if not protection.first_byte <= last < message.length:
        raise DbcError(
            where, f"bytes {protection.first_byte} to {last} are not those of the message", f"0..{message.length - 1}"
        )
    guard.row["first_byte"], guard.row["end_byte"] = protection.first_byte, last + 1
    _use_algorithm(where, guard, protection, signal)
    extra = list(protection.before)
    for what in reversed(protection.include):
        wide = 4 if message.is_extended_frame else 2
        extra = ([message.length] if what == "length" else list(message.frame_id.to_bytes(wide, "big"))) + extra
    _cover(where, guard, "before", extra)
    _cover(where, guard, "after", list(protection.after))
    if protection.data_id_list:
        if len(protection.data_id_list) != checksum.LISTED_COUNT:
            raise DbcError(where, f"data_id_list has {len(protection.data_id_list)} entries", "16 numbers 0..255")
        guard.row["after_listed"], guard.row["listed"] = 1, protection.data_id_list
    return f"{protection.algorithm or 'CRC'} in {signal.name} over bytes {protection.first_byte}..{last}"


def _use_algorithm(where: str, guard: Guard, protection: Protection, signal: Signal) -> None:
    row, mask = guard.row, (1 << signal.length) - 1
    name = protection.algorithm or ("" if protection.polynomial else "sum")
    if name in _SUMS:
        row["algorithm"], row["width"], row["mask"] = _SUMS[name], signal.length, mask
        row["start"], row["final_xor"] = protection.start or 0, (protection.final_xor or 0) & mask
        row["negated"] = protection.negated
        return
    if protection.polynomial is not None:
        crc = CrcParameters(
            signal.length, protection.polynomial, protection.start or 0, protection.reflect_in, protection.reflect_out,
            protection.final_xor or 0,
        )  # fmt: skip
    else:
        crc = named_crc(where, name)
        crc = crc._replace(
            start=crc.start if protection.start is None else protection.start,
            final_xor=crc.final_xor if protection.final_xor is None else protection.final_xor,
        )
    if crc.width != signal.length or max(crc.polynomial, crc.start, crc.final_xor) > mask:
        raise DbcError(where, f"{name or 'the CRC'} has {crc.width} bits, {signal.name} has {signal.length}", "as many")
    _use_crc(guard, crc)


def _guarded(text: str, modulus: int) -> Guard:
    guard = Guard(PROTECTED_BY_GUARD, text)
    guard.row["counter_modulus"] = modulus
    guard.row["counter_row"] = guard.row["checksum_row"] = checksum.NO_ROW
    guard.counter_start = modulus - 1  # the first frame carries 0
    return guard


def _find(where: str, message, name: str) -> Signal:
    """A signal of the message that `where` ends with."""
    return find(where.rpartition(": ")[0], message, name)


def _place(where: str, guard: Guard, signal: Signal) -> int:
    if signal.is_float or signal.multiplexer_ids is not None:
        raise DbcError(f"{where}.{signal.name}", "cannot be a counter or checksum", "a plain integer signal")
    row = signal_layout.row(f"{where}.{signal.name}", signal, Fraction(1), False)
    guard.reserved |= signal_layout.window_bits(row)
    guard.signals.append(row)
    return len(guard.signals) - 1


def _place_counter(where: str, guard: Guard, signal: Signal) -> None:
    guard.row["counter_row"] = _place(where, guard, signal)


def _place_checksum(where: str, message, guard: Guard, signal: Signal, protection: Protection | None = None) -> None:
    guard.row["checksum_row"] = _place(where, guard, signal)
    places = signal_layout.bit_places(signal.start, signal.length, signal.byte_order)
    first, last = min(places) // 8, max(places) // 8
    if last >= message.length:
        raise DbcError(f"{where}.{signal.name}", "reaches beyond the message", f"{message.length} bytes")
    whole = len(places) == 8 * (last - first + 1)
    wanted = protection.own_bits if protection else None
    if wanted == "skipped" and not whole:
        raise DbcError(
            f"{where}.{signal.name}", "does not fill whole bytes, so it cannot be skipped", 'own_bits = "zero"'
        )
    guard.row["blanked"] = wanted == "zero" or not whole
    guard.row["skip_first"], guard.row["skip_end"] = (first, last + 1) if not guard.row["blanked"] else (0, 0)
    guard.row["checksum_byte"], guard.row["end_byte"] = first, message.length


def _cover(where: str, guard: Guard, side: str, values: list[int]) -> None:
    if len(values) > checksum.EXTRA_COUNT_MAX:
        raise DbcError(where, f"{len(values)} bytes {side} the data", f"{checksum.EXTRA_COUNT_MAX} at most")
    guard.row[f"{side}_count"] = len(values)
    guard.row[side][: len(values)] = values


def _fix(guard: Guard, byte: int, mask: int, value: int) -> None:
    index = int(guard.row["fixed_count"])
    guard.row["fixed_byte"][index], guard.row["fixed_mask"][index] = byte, mask
    guard.row["fixed_value"][index] = value
    guard.row["fixed_count"] = index + 1
    guard.fixed.append((byte, mask, value))
    guard.reserved |= mask << 8 * byte


def _fix_bytes(guard: Guard, first: int, values: bytes) -> None:
    for index, value in enumerate(values):
        _fix(guard, first + index, 0xFF, value)


def _use_crc(guard: Guard, crc: CrcParameters) -> None:
    row, width = guard.row, crc.width
    row["algorithm"] = checksum.ALGORITHM_CRC_REFLECTED if crc.reflect_in else checksum.ALGORITHM_CRC
    row["width"], row["mask"], row["final_xor"] = width, (1 << width) - 1, crc.final_xor
    row["start"] = reflected(crc.start, width) if crc.reflect_in else crc.start << (64 - width)
    row["result_reflected"] = crc.reflect_in != crc.reflect_out
    row["table"] = crc_table(crc)


def reflected(value: int, width: int) -> int:
    """The bits of a number in the other order."""
    return int(f"{value:0{width}b}"[::-1], 2)


def crc_table(crc: CrcParameters) -> np.ndarray:
    """uint64[256]: the register after one byte; at the top of 64 bits where it is not reflected."""
    table = np.zeros(256, np.uint64)
    top, full = 1 << 63, (1 << 64) - 1
    for byte in range(256):
        if crc.reflect_in:
            register, polynomial = byte, reflected(crc.polynomial, crc.width)
            for _ in range(8):
                register = (register >> 1) ^ (polynomial if register & 1 else 0)
        else:
            register, polynomial = byte << 56, crc.polynomial << (64 - crc.width)
            for _ in range(8):
                register = ((register << 1) ^ (polynomial if register & top else 0)) & full
        table[byte] = register
    return table


def _by_user(where: str, message, named: str, read_own: ReadOwn) -> Guard:
    guard = _guarded(f"own function {named}", 1)
    guard.row["algorithm"] = checksum.ALGORITHM_USER
    guard.row["function"] = user_address(where, named, read_own)
    guard.counter_start = e2e.NO_COUNTER
    guard.row["checksum_byte"] = 0
    guard.row["end_byte"] = message.length
    return guard


_BUILDERS = {
    "P01": _p01,
    "P02": _p02,
    "P04": _p04,
    "P05": _p05,
    "P06": _p06,
    "P07": _p07,
    "P11": _p01,
    "J1939": _j1939,
    "plain": _plain,
}
assert bits.WINDOW_COUNT_MAX == 2  # a checksum of 64 bits lies in whole bytes
