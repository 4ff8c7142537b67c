"""CRC algorithms by name: those of the catalogue that crccheck carries, and the names that crcmod uses for some of them."""

import difflib
import re
from typing import NamedTuple

from hilrunner.base.errors import DbcError

# crcmod's predefined names that the catalogue does not list as they are
_CRCMOD = {
    "crc8": "CRC-8/SMBUS",
    "crc8darc": "CRC-8/DARC",
    "crc16": "CRC-16/ARC",
    "crcccittfalse": "CRC-16/IBM-3740",
    "crcaugccitt": "CRC-16/SPI-FUJITSU",
    "crc32": "CRC-32/ISO-HDLC",
    "crc32c": "CRC-32/ISCSI",
    "crc64": "CRC-64/GO-ISO",
    "crc64we": "CRC-64/WE",
    "crc64jones": "CRC-64/REDIS",
    "j1850": "CRC-8/SAE-J1850",
}


class CrcParameters(NamedTuple):
    """The six parameters of a CRC as the catalogue of parametrised CRC algorithms defines them."""

    width: int
    polynomial: int
    start: int
    reflect_in: bool
    reflect_out: bool
    final_xor: int


def named_crc(where: str, name: str) -> CrcParameters:
    """Parameters of a CRC by its name (case, dashes and slashes do not matter); DbcError with near names."""
    import crccheck.crc

    known: dict[str, type] = {}
    plain_names: list[str] = []
    for kind in crccheck.crc.ALLCRCCLASSES:
        for text in (*kind._names, kind.__name__):
            known.setdefault(_plain(text), kind)
        plain_names.append(kind._names[0])
    asked = _plain(name)
    kind = known.get(asked) or known.get(_plain(_CRCMOD.get(asked, "")))
    if kind is None:
        ends = [one for one in plain_names if _plain(one.partition("/")[2]) == asked]
        kind = known[_plain(ends[0])] if len(ends) == 1 else None
    if kind is None:
        near = difflib.get_close_matches(name.upper(), plain_names, n=4, cutoff=0.4)
        raise DbcError(
            where, f"no checksum is called '{name}'", f"sum, xor, nibble-sum, or a CRC such as {', '.join(near or plain_names[:4])}",
            "correct the name, or give polynomial, start, reflect_in, reflect_out and final_xor",
        )  # fmt: skip
    return CrcParameters(
        kind._width,
        kind._poly,
        kind._initvalue,
        bool(kind._reflect_input),
        bool(kind._reflect_output),
        kind._xor_output,
    )


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())
