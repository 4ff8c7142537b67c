"""Where the files that ship are: profiles, trained models, the firmware interface; same answer in a source tree and in a wheel.

A wheel carries the top-level folders of the source tree as `hilrunner/_data/<folder>` (setup.py maps them). The source tree
wins when the package lies in one, so that an edited profile is the one that runs.
"""

from functools import cache
from pathlib import Path

import hilrunner
from hilrunner.base.errors import UsageError

_PACKAGE = Path(hilrunner.__file__).resolve().parent


def profiles_folder() -> Path:
    """Folder of the shipped profiles (`*.toml` and what they name: loads, schedules, faults)."""
    return _folder("profiles")


def models_folder() -> Path:
    """Folder of the shipped trained models (`*.onnx`, each with its data sheet)."""
    return profiles_folder() / "models"


def firmware_interface_folder() -> Path:
    """Folder a firmware team takes as it is: `actuator.dbc`, C sources, golden frames."""
    return _folder("firmware_iface")


def host_files_folder() -> Path:
    """Folder of what an administrator installs: the systemd unit, limits and device rules for group realtime."""
    return _folder("systemd", "tools/systemd")


@cache
def _folder(name: str, in_tree_name: str = "") -> Path:
    in_tree = _PACKAGE.parent / (in_tree_name or name)
    installed = _PACKAGE / "_data" / name
    if in_tree.is_dir() and (_PACKAGE.parent / "pyproject.toml").is_file():
        return in_tree
    if installed.is_dir():
        return installed
    raise UsageError(
        f"shipped folder '{name}'",
        f"neither {in_tree} (source tree) nor {installed} (installed) is there",
        remedy="install hilrunner again: this installation is incomplete",
    )
