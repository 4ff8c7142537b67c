"""One flipped bit anywhere in a log is noticed; a log that was cut off is incomplete, not damaged."""

import struct

import numpy as np
import pytest
from mcap.reader import make_reader

from hilrunner.base import exit_codes
from hilrunner.base.errors import LogError
from hilrunner.evidence.damaged import DamagedLogError
from hilrunner.evidence.reader import read_run
from tests.tools import synthetic_run
from tests.tools.copy_log import copy_with

FLIPS = 400
TICKS = 60


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return synthetic_run.write_run(tmp_path_factory.mktemp("integrity") / "run.mcap", TICKS, stall_every=25)


def damage_of(path, data: bytes) -> tuple[str, ...]:
    """What is told to be changed in a log of these bytes."""
    path.write_bytes(data)
    try:
        return read_run(path).mismatches
    except DamagedLogError as error:
        assert error.exit_code == exit_codes.DAMAGED == 7
        return (str(error),)


def flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def test_a_whole_log_matches_its_checksums(source):
    assert read_run(source).mismatches == ()


def test_a_bit_flipped_anywhere_is_noticed(source, tmp_path):
    data = source.read_bytes()
    bits = np.random.default_rng(11).integers(0, len(data) * 8, FLIPS)
    silent = [int(bit) for bit in bits if not damage_of(tmp_path / "x.mcap", flipped(data, int(bit)))]
    assert silent == []


def test_every_bit_of_head_and_end_is_noticed(source, tmp_path):
    """Magic, header, lengths and opcodes at the start; DataEnd, footer and magic at the end."""
    data = source.read_bytes()
    with open(source, "rb") as file:
        summary_start = make_reader(file).get_summary().statistics and struct.unpack_from("<Q", data, len(data) - 28)[0]
    ends = [
        *range(0, 60 * 8),
        *range((summary_start - 13) * 8, summary_start * 8),
        *range((len(data) - 37) * 8, len(data) * 8),
    ]
    silent = [bit for bit in ends if not damage_of(tmp_path / "x.mcap", flipped(data, bit))]
    assert silent == []


def test_a_flipped_bit_is_noticed_where_the_writer_was_killed(source, tmp_path):
    """Up to its last seal: what comes behind it is a part of a second that nobody says is whole."""
    data = source.read_bytes()
    whole = data[: data.rindex(struct.pack("<BQ", 0x80, 12)) + 21]
    assert damage_of(tmp_path / "x.mcap", whole) == ()
    bits = np.random.default_rng(12).integers(64, len(whole) * 8, FLIPS)
    silent = [int(bit) for bit in bits if not noticed(tmp_path / "x.mcap", flipped(whole, int(bit)), whole)]
    assert silent == []


def noticed(path, data: bytes, whole: bytes) -> bool:
    """Told as changed, refused, or read as a log that was cut off at that place: nothing behind it is taken."""
    path.write_bytes(data)
    try:
        run = read_run(path)
    except LogError:
        return True
    return bool(run.mismatches) or len(run.damage) > 1


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8, 0.97])
def test_a_cut_log_is_not_called_damaged(source, tmp_path, share):
    data = source.read_bytes()
    path = tmp_path / "x.mcap"
    path.write_bytes(data[: int(len(data) * share)])
    try:
        run = read_run(path)
    except LogError as error:
        assert error.exit_code == exit_codes.BAD_INPUT
        return
    assert run.mismatches == ()
    assert run.damage


def test_blocks_that_were_never_written_are_a_cut(source, tmp_path):
    """A file system that lost power may give zeros for the newest blocks."""
    data = source.read_bytes()
    end = data.rindex(struct.pack("<BQ", 0x80, 12)) + 21
    (tmp_path / "x.mcap").write_bytes(data[:end] + b"\0" * 4096)
    run = read_run(tmp_path / "x.mcap")
    assert run.mismatches == ()
    assert any("never stored" in text for text in run.damage)


def test_an_attachment_that_is_not_the_one_the_log_names_is_noticed(source, tmp_path):
    """Also where every checksum fits, because another program wrote the file anew."""
    written = copy_with(source, tmp_path / "copy.mcap")
    assert read_run(written).mismatches == ()
    changed = tmp_path / "changed.mcap"
    edit = {"run": {"sha256:profile.toml": "0" * 64}}
    synthetic_run.write_run(changed, TICKS, metadata=edit)
    assert any("profile.toml" in text for text in read_run(changed).mismatches)
