"""What a bus is opened with: can.conf, the environment, the profile and --bus-option, each refused with its place where it is wrong."""

import can
import can.util
import pytest

from hilrunner.base.errors import UsageError
from hilrunner.setup.bus_settings import configured, resolved, with_words
from hilrunner.setup.profile import parse_profile


@pytest.fixture
def conf(tmp_path, monkeypatch):
    """A can.conf of one's own and no other."""
    path = tmp_path / "can.conf"
    monkeypatch.setattr(can.util, "CONFIG_FILES", [str(path)])
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    return path


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_a_file_in_any_encoding(conf, encoding, monkeypatch):
    conf.write_bytes(
        "# Prüfstand\r\n[default]\r\ninterface = virtual\r\nchannel = 100%\r\nData_Rate = 5\r\n".encode(encoding)
    )
    assert configured() == {"interface": "virtual", "channel": "100%", "Data_Rate": "5"}
    monkeypatch.setenv("CAN_CHANNEL", "other")
    assert configured()["channel"] == "other"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("interface = virtual\n", r"can.conf: line 1: no section.*\[default\]"),
        ("# c\n\ninterface = virtual\n", "can.conf: line 3: no section"),
        ("[default]\ninterface\n", "can.conf: line 2: is not KEY = VALUE"),
        ("[default]\na = 1\na = 2\n", "can.conf: line 3: stands twice"),
        ("[default]\n[default]\n", "can.conf: line 2: stands twice"),
        ("\0\0", "can.conf: cannot be read"),
    ],
)
def test_a_file_that_is_wrong_is_named_with_its_line(conf, text, told):
    conf.write_text(text)
    with pytest.raises(UsageError, match=told) as refused:
        configured()
    assert "remedy" in str(refused.value)


@pytest.mark.parametrize("text", ["{", "[1]", "3"])
def test_a_variable_that_is_wrong(conf, monkeypatch, text):
    monkeypatch.setenv("CAN_CONFIG", text)
    with pytest.raises(UsageError, match="CAN_CONFIG: is not a JSON object"):
        configured()


def test_words_go_before_the_profile_and_become_numbers():
    profile = parse_profile(
        'name = "a"\n[[axis]]\nname = "b"\n[can.options]\nhost = "bench"\nport = 5\nlisten = true\n', "a.toml"
    )
    words = ["port=29536", "data-bitrate=2000000", "id=0x1F", "timeout=0.5", "fast=True", "note=a=b"]
    assert with_words(profile.can.options, words) == {
        "host": "bench", "port": 29536, "listen": True, "data_bitrate": 2_000_000, "id": 31, "timeout": 0.5, "fast": True,
        "note": "a=b",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("word", "told"),
    [("port", "is not KEY=VALUE"), ("=5", "is not KEY"), ("a b=5", "is not KEY"), ("channel=x", "--channel")],
)
def test_words_that_are_no_options(word, told):
    with pytest.raises(UsageError, match=told):
        with_words({}, [word])


def test_the_command_goes_before_the_file(conf):
    conf.write_text("[default]\ninterface = kvaser\nchannel = 3\nbitrate = 250000\nrx_queue_size = 7\n")
    settings = resolved("virtual", "bench", {"bitrate": 500_000})
    assert settings["interface"] == "virtual" and settings["channel"] == "bench"
    assert settings["bitrate"] == 500_000 and settings["rx_queue_size"] == 7


@pytest.mark.parametrize(
    ("interface", "options", "told"),
    [
        ("virtal", {}, "no such python-can interface.*did you mean 'virtual'"),
        ("virtual", {"port": "no"}, "an option has a wrong value: Port"),
        ("virtual", {"port": 99999}, "an option has a wrong value: Port"),
        ("virtual", {"state": "sleepy"}, "an option has a wrong value"),
    ],
)
def test_values_that_python_can_refuses(conf, interface, options, told):
    with pytest.raises(UsageError, match=told):
        resolved(interface, "x", options)
