"""Texts of other people's tools: every usual encoding and line end gives the same text, and what is no text is said to be none."""

import codecs
import gzip
import os

import pytest

from hilrunner.base.errors import DbcError, ProfileError
from hilrunner.setup import text
from hilrunner.setup.database import load_database
from hilrunner.setup.profile import load_profile

LINES = "Größe in µm\n½ Öffnung\n"
PACKED = gzip.compress(LINES.encode() * 20, mtime=0)  # a fixed time: the data name the tests


@pytest.mark.parametrize(
    "data",
    [
        LINES.encode("utf-8"),
        LINES.encode("utf-8-sig"),
        LINES.encode("cp1252"),
        LINES.encode("utf-16"),
        codecs.BOM_UTF16_BE + LINES.encode("utf-16-be"),
        codecs.BOM_UTF32_LE + LINES.encode("utf-32-le"),
        LINES.encode("utf-16-le"),
        LINES.encode("utf-16-be"),
        LINES.replace("\n", "\r\n").encode("utf-8-sig"),
        LINES.replace("\n", "\r").encode("cp1252"),
        gzip.compress(LINES.encode("cp1252"), mtime=0),
        gzip.compress(LINES[:5].encode(), mtime=0) + gzip.compress(LINES[5:].encode(), mtime=0),
    ],
)
def test_every_encoding_gives_the_same_text(tmp_path, data):
    path = tmp_path / "a.txt"
    path.write_bytes(data)
    assert text.read_text(path, ProfileError) == LINES


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (bytes(range(256)), "zero bytes"),
        (b"\x81\x8d\x8f", "neither UTF-8 nor cp1252"),
        (codecs.BOM_UTF8 + b"\xff", "begins as UTF-8"),
        (PACKED[:-12], "the gzip file is cut"),
        (PACKED[:10] + b"\xff" * 40, "the gzip file is damaged"),
    ],
)
def test_what_is_no_text_is_refused(tmp_path, data, told):
    path = tmp_path / "a.txt"
    path.write_bytes(data)
    with pytest.raises(ProfileError, match=told) as refused:
        text.read_text(path, ProfileError)
    assert str(path) in str(refused.value) and "remedy" in str(refused.value)


def test_what_is_no_file_is_refused_at_once(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path, told in ((tmp_path, "is a folder"), (pipe, "pipe or a device"), (tmp_path / "none", "no such file")):
        with pytest.raises(ProfileError, match=told):
            text.read_text(path, ProfileError)
    with pytest.raises(ProfileError, match="device"):
        text.read_text(text.Path("/dev/zero"), ProfileError)


def test_a_file_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(text, "_STEP_BYTES", 1 << 16)
    for data in (gzip.compress(b"\n" * (2 << 20)), b"\n" * (2 << 20)):
        (tmp_path / "a.log").write_bytes(data)
        with pytest.raises(ProfileError, match="too large"):
            text.read_contents(tmp_path / "a.log", ProfileError, most_bytes=1 << 20)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "cp1252", "utf-16"])
def test_a_profile_in_any_encoding(tmp_path, encoding):
    path = tmp_path / "mine.toml"
    path.write_bytes('name = "mine"\r\ndescription = "Prüfstand"\r\n[[axis]]\r\nname = "boom"\r\n'.encode(encoding))
    assert load_profile(str(path)).profile.description == "Prüfstand"


DBC = 'VERSION ""\n\nBU_: A B\n\nBO_ 100 CMD: 8 A\n SG_ Weg : 0|16@1- (1,0) [0|0] "µm" B\n'


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_the_units_of_a_dbc_in_any_encoding(tmp_path, encoding):
    path = tmp_path / "a.dbc"
    path.write_bytes(DBC.replace("\n", "\r\n").encode(encoding))
    assert load_database(path).get_message_by_name("CMD").signals[0].unit == "µm"


def test_a_dbc_that_is_none(tmp_path):
    path = tmp_path / "a.dbc"
    path.write_text("hello")
    with pytest.raises(DbcError, match="not a DBC"):
        load_database(path)


def test_a_folder_named_like_a_profile_is_no_profile(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "amc-lift").mkdir()
    (tmp_path / "results").mkdir()
    assert load_profile("amc-lift").path.name == "amc-lift.toml"
    with pytest.raises(ProfileError, match="results: is a folder"):
        load_profile("results")
