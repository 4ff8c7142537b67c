"""Damaged copies of sound logs: cut off anywhere, one bit flipped in any part."""

import struct
from pathlib import Path

import numpy as np

from tests.attack.campaign import Attempt, Campaign, Tried
from tests.attack.outcome import call
from tests.attack.source import Source, sources

_NAMES = {
    0x01: "header", 0x02: "footer", 0x03: "schema", 0x04: "channel", 0x05: "message", 0x06: "chunk", 0x07: "message index",
    0x08: "chunk index", 0x09: "attachment", 0x0A: "attachment index", 0x0B: "statistics", 0x0C: "metadata",
    0x0D: "metadata index", 0x0E: "summary offset", 0x0F: "data end",
}  # fmt: skip
REPORT = ["report", "--json"]
REPLAY = ["replay", "--only", "exact", "--json"]


def parts_of(data: bytes) -> dict[str, list[tuple[int, int]]]:
    """Kind of record -> where such records are: (first byte, end). The head of a record is a part of its own."""
    parts: dict[str, list[tuple[int, int]]] = {"magic": [(0, 8), (len(data) - 8, len(data))]}
    place = 8
    while place < len(data) - 8:
        opcode, size = struct.unpack_from("<BQ", data, place)
        name = _NAMES.get(opcode, "private record")
        parts.setdefault("record heads", []).append((place, place + 9))
        if size:
            parts.setdefault(name, []).append((place + 9, place + 9 + size))
        if opcode == 0x06:
            parts.setdefault("chunk heads", []).append((place + 9, place + 9 + 48))
        place += 9 + size
    return parts


def _command(rng: np.random.Generator) -> list[str]:
    return REPLAY if rng.random() < 0.25 else REPORT


def _try(source: Source, damaged: Path, rng: np.random.Generator, what: str, group: str) -> Tried:
    words = _command(rng)
    outcome = call([words[0], str(damaged), *words[1:]])
    faults = source.judge(words, outcome, damaged)
    return Tried(
        f"{words[0]} of {what}", group, outcome.code, faults, outcome.wall_s, outcome.memory_bytes, outcome.err[-4000:]
    )


def prepare_cut(folder: Path) -> Attempt:
    """A copy that ends anywhere."""
    logs = sources(folder)

    def attempt(rng: np.random.Generator, own: Path) -> Tried:
        source = logs[rng.integers(len(logs))]
        near_end = rng.random() < 0.3
        low = len(source.data) - 8000 if near_end else 0
        cut = int(rng.integers(max(low, 0), len(source.data)))
        damaged = own / "cut.mcap"
        damaged.write_bytes(source.data[:cut])
        return _try(source, damaged, rng, f"{source.name} cut at byte {cut} of {len(source.data)}", source.name)

    return attempt


def prepare_flip(folder: Path) -> Attempt:
    """A copy with one bit flipped, in a part drawn first, so that short parts are hit as often as long ones."""
    logs = [(source, parts_of(source.data)) for source in sources(folder)]

    def attempt(rng: np.random.Generator, own: Path) -> Tried:
        source, parts = logs[rng.integers(len(logs))]
        part = sorted(parts)[rng.integers(len(parts))]
        start, end = parts[part][rng.integers(len(parts[part]))]
        byte, bit = int(rng.integers(start, end)), int(rng.integers(8))
        data = bytearray(source.data)
        data[byte] ^= 1 << bit
        damaged = own / "flipped.mcap"
        damaged.write_bytes(data)
        return _try(source, damaged, rng, f"{source.name}, bit {bit} of byte {byte} ({part})", part)

    return attempt


CUT = Campaign("cut", "a log that ends anywhere", 500, prepare_cut)
FLIP = Campaign("flip", "one bit flipped, in every part of a log", 2000, prepare_flip)
