"""What a python-can bus is opened with: can.conf and the environment, the profile's [can] options, and --bus-option.

python-can reads its own configuration without a word about where it is wrong, and casts texts to numbers; both happen here.
"""

import configparser
import json
import os
from pathlib import Path
from typing import Any

from hilrunner.base.errors import UsageError
from hilrunner.setup.text import read_text

_SECTION = "default"
_FORM = "a line [default], then lines KEY = VALUE"


def configured() -> dict[str, Any]:
    """python-can's own configuration: its files, then CAN_CONFIG, CAN_INTERFACE, CAN_CHANNEL and CAN_BITRATE.

    Raises:
        UsageError: a file or a variable that cannot be read; names its line and the remedy.
    """
    import can.util

    found: dict[str, Any] = {}
    for name in can.util.CONFIG_FILES:
        path = Path(name).expanduser()
        if path.is_file() and os.access(path, os.R_OK):  # python-can leaves out what it may not read
            found |= _of_file(path)
    return found | _of_environment()


def with_words(options: dict[str, Any], words: list[str]) -> dict[str, Any]:
    """Options of a profile with those of the command line (`KEY=VALUE`) in their place; UsageError for any other word."""
    found = dict(options)
    for word in words:
        key, mark, value = word.partition("=")
        key = key.strip().replace("-", "_")
        if not mark or not key.isidentifier():
            raise UsageError("--bus-option", f"'{word}' is not KEY=VALUE", "an option of the python-can interface",
                             "write for example --bus-option port=29536")  # fmt: skip
        if key in ("interface", "channel", "fd"):
            raise UsageError(f"--bus-option {key}", "has an option of its own", remedy=f"use --{key}")
        found[key] = cast(value.strip())
    return found


def cast(text: str) -> Any:
    """A whole number (decimal, or 0x...), a number, true or false, else the text: as python-can does with its files."""
    import can.util

    if text.lower().startswith("0x"):
        try:
            return int(text, 16)
        except ValueError:
            return text
    return can.util.cast_from_string(text)


def resolved(interface: str, channel: str | None, options: dict[str, Any]) -> dict[str, Any]:
    """Arguments for `can.Bus(ignore_config=True, ...)`; UsageError for an unknown interface or a value it cannot have."""
    import can
    import can.util

    given = {
        **{key: cast(value) if isinstance(value, str) else value for key, value in configured().items()},
        **options,
    }
    given |= {"interface": interface, "channel": channel}
    try:
        return dict(can.util.load_config(path=os.devnull, config=given))
    except can.CanInterfaceNotImplementedError:
        import difflib

        near = difflib.get_close_matches(interface, can.VALID_INTERFACES, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise UsageError(f"-i {interface}", "no such python-can interface", ", ".join(sorted(can.VALID_INTERFACES)),
                         f"{hint}name one of these") from None  # fmt: skip
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise UsageError(
            f"-i {interface}",
            f"an option has a wrong value: {error}",
            remedy="correct --bus-option, [can] options or can.conf",
        ) from None


def _of_file(path: Path) -> dict[str, str]:
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment]  # capital letters stay
    text = read_text(path, UsageError, "correct or remove it")
    try:
        parser.read_string(text, source=str(path))
    except configparser.MissingSectionHeaderError as error:
        raise UsageError(
            f"{path}: line {error.lineno}",
            "no section begins above it",
            _FORM,
            "write [default] above it, or remove the file",
        ) from None
    except (configparser.DuplicateOptionError, configparser.DuplicateSectionError) as error:
        raise UsageError(
            f"{path}: line {error.lineno}", "stands twice in the file", _FORM, "remove one of the two"
        ) from None
    except configparser.ParsingError as error:
        line = error.errors[0][0] if error.errors else 1
        raise UsageError(f"{path}: line {line}", "is not KEY = VALUE", _FORM, "correct or remove the line") from None
    return dict(parser.items(_SECTION)) if parser.has_section(_SECTION) else {}


def _of_environment() -> dict[str, Any]:
    import can.util

    try:
        found = can.util.load_environment_config()
        if not isinstance(found, dict):
            raise TypeError(f"it is a {type(found).__name__}")
    except (json.JSONDecodeError, TypeError) as error:
        raise UsageError("CAN_CONFIG", f"is not a JSON object: {error}", '{"interface": "...", "channel": "..."}',
                         "correct or unset the environment variable") from None  # fmt: skip
    return found
