"""Cut anywhere, flip anything: what lies before the damage is recovered, and nothing ends in a traceback."""

import io
import zlib

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType

from hilrunner.base import records
from hilrunner.base.errors import LogError
from hilrunner.evidence.chunk import _unpack_lz4_partly
from hilrunner.evidence.reader import read_run
from hilrunner.record.mcap_log import BLOCK_SIZE_BYTES
from tests.tools import synthetic_run
from tests.tools.copy_log import copy_with

CUTS = 50  # of each of the four kinds: 200 in all
MESSAGE_BYTES = 9 + 22 - records.MESSAGE_OFFSET
TICK_BYTES = records.TICK.itemsize + MESSAGE_BYTES


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    blocks = {}
    folder = tmp_path_factory.mktemp("cut")
    path = synthetic_run.write_run(folder / "run.mcap", 4000, stall_every=900, edit=blocks.update)
    kinds = {
        "own": path,
        "plain": copy_with(path, folder / "plain.mcap", compression=CompressionType.NONE, chunk_size=200_000),
        "lz4": copy_with(path, folder / "lz4.mcap", compression=CompressionType.LZ4, chunk_size=200_000),
        "unchunked": copy_with(path, folder / "unchunked.mcap", use_chunking=False),
    }
    return kinds, blocks


def ticks_before(data: bytes, cut: int, ticks: np.ndarray) -> int:
    """Tick messages that lie wholly before the cut in a file that stores them uncompressed."""
    ends = []
    place = 0
    for row in ticks:
        place = data.index(row.tobytes()[records.MESSAGE_OFFSET :], place)
        ends.append(place + records.TICK.itemsize - records.MESSAGE_OFFSET)
    return int(np.searchsorted(ends, cut, side="right"))


def chunks(data: bytes, ticks: np.ndarray) -> list[tuple[int, bytes, np.ndarray]]:
    """Of every chunk of a whole file: where its compressed bytes are, those bytes, where its ticks end when uncompressed."""
    found, first = [], 0
    for record in StreamReader(io.BytesIO(data), emit_chunks=True).records:
        if not isinstance(record, Chunk):
            continue
        content = zstandard.ZstdDecompressor().decompress(record.data, max_output_size=record.uncompressed_size)
        ends, place = [], 0
        for row in ticks[first:]:
            raw = row.tobytes()[records.MESSAGE_OFFSET :]
            place = content.find(raw, place)
            if place < 0:
                break
            ends.append(place + len(raw))
        first += len(ends)
        found.append((data.index(record.data), record.data, np.array(ends)))
    assert first == len(ticks)
    return found


def ticks_in_whole_blocks(parts: list[tuple[int, bytes, np.ndarray]], cut: int) -> int:
    """Ticks whose compressed block lies wholly before the cut."""
    count = 0
    for offset, packed, ends in parts:
        if offset + len(packed) <= cut:
            count += len(ends)
            continue
        size = len(zstandard.ZstdDecompressor().decompressobj().decompress(packed[: max(0, cut - offset)]))
        assert size % BLOCK_SIZE_BYTES == 0, "a block is not where the writer promises it"
        return count + int(np.searchsorted(ends, size, side="right"))
    return count


def chunk_starts(path) -> list[int]:
    with open(path, "rb") as file:
        return [index.chunk_start_offset for index in make_reader(file).get_summary().chunk_indexes]


def read_cut(tmp_path, data: bytes):
    path = tmp_path / "cut.mcap"
    path.write_bytes(data)
    try:
        return read_run(path)
    except LogError as error:
        assert str(path) in str(error)
        return None


@pytest.mark.parametrize("kind", ["own", "plain", "lz4", "unchunked"])
def test_a_cut_keeps_every_whole_tick_before_it(source, tmp_path, kind):
    kinds, blocks = source
    data = kinds[kind].read_bytes()
    whole = blocks["tick"]
    rng = np.random.default_rng(zlib.crc32(kind.encode()))
    counts = []
    for cut in np.sort(rng.integers(0, len(data), CUTS)):
        run = read_cut(tmp_path, data[:cut])
        found = run.tick if run is not None else whole[:0]
        assert found.tobytes() == whole[: len(found)].tobytes()
        counts.append((int(cut), len(found)))
        if run is not None and not run.finished:
            assert run.damage
    assert [n for _, n in counts] == sorted(n for _, n in counts)
    if kind in ("plain", "unchunked"):
        for cut, count in counts[:: CUTS // 5]:
            assert count == ticks_before(data, cut, whole)
    else:
        # compressed: no more than the block that was hit is lost
        lost = [round(cut / len(data) * len(whole)) - count for cut, count in counts]
        assert max(lost) < 150
    if kind == "own":
        parts = chunks(data, whole)
        assert [count for _, count in counts] == [ticks_in_whole_blocks(parts, cut) for cut, _ in counts]


def test_no_block_of_our_logs_is_longer_than_promised(source):
    """Fed byte by byte, a chunk comes out in steps: each is what a cut there would cost."""
    kinds, blocks = source
    for _, packed, ends in chunks(kinds["own"].read_bytes(), blocks["tick"]):
        stream = zstandard.ZstdDecompressor().decompressobj()
        steps = [len(stream.decompress(packed[k : k + 1])) for k in range(len(packed))]
        assert sum(steps) >= ends[-1]
        assert max(steps) <= BLOCK_SIZE_BYTES


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_cut_lz4_block_gives_every_byte_before_the_cut(data):
    content = data.draw(st.binary(min_size=1, max_size=400)) * data.draw(st.integers(1, 40))
    linked = data.draw(st.booleans())
    packed = lz4.frame.compress(content, block_linked=linked, store_size=data.draw(st.booleans()))
    assert _unpack_lz4_partly(packed, len(content)) == content
    before = 0
    for cut in range(0, len(packed), max(1, len(packed) // 20)):
        part = _unpack_lz4_partly(packed[:cut], len(content))
        assert content.startswith(part)
        assert len(part) >= before
        before = len(part)


def test_flipped_bits_never_end_in_a_traceback(source, tmp_path):
    kinds, blocks = source
    rng = np.random.default_rng(7)
    for kind, path in kinds.items():
        data = bytearray(path.read_bytes())
        for _ in range(25):
            place = int(rng.integers(0, len(data)))
            data[place] ^= 1 << int(rng.integers(0, 8))
            run = read_cut(tmp_path, bytes(data))
            assert run is not None or place < 20_000, f"{kind}: a flip at {place} lost the whole log"


def test_damage_in_one_chunk_leaves_the_others(source, tmp_path):
    kinds, blocks = source
    data = bytearray(kinds["own"].read_bytes())
    middle = chunk_starts(kinds["own"])[1] + 2000
    data[middle : middle + 100_000] = b"\xff" * 100_000
    run = read_cut(tmp_path, bytes(data))
    assert run.finished
    assert len(run.damage) >= 1
    assert len(blocks["tick"]) / 2 < len(run.tick) < len(blocks["tick"])
    assert run.tick["tick"][-1] == blocks["tick"]["tick"][-1]


def test_reading_goes_on_after_a_broken_record_length(source, tmp_path):
    kinds, blocks = source
    data = bytearray(kinds["own"].read_bytes())
    chunk = chunk_starts(kinds["own"])[1]
    data[chunk + 5] ^= 0x10  # a length of many gigabytes
    run = read_cut(tmp_path, bytes(data))
    assert run.tick["tick"][-1] == blocks["tick"]["tick"][-1]
    assert any("reading goes on" in text for text in run.damage)


def test_a_flipped_payload_bit_is_kept_and_named(source, tmp_path):
    kinds, blocks = source
    data = bytearray(kinds["plain"].read_bytes())
    row = blocks["state"][1234].tobytes()[records.MESSAGE_OFFSET :]
    data[data.index(row) + records.STATE.fields["rod_position_m"][1] - records.MESSAGE_OFFSET] ^= 1
    run = read_cut(tmp_path, bytes(data))
    differs = run.state["lift"]["rod_position_m"] != blocks["state"]["rod_position_m"]
    assert np.flatnonzero(differs).tolist() == [1234]
    assert any("checksum" in text for text in run.damage)
