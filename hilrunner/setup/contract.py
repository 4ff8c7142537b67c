"""The CAN contract of a profile: which DBC, which mapping, and the integer tables the loop works with."""

from pathlib import Path

from hilrunner.base.errors import DbcError, ProfileError
from hilrunner.realtime.decode import CommandTable
from hilrunner.realtime.encode import MeasurementTable
from hilrunner.setup import resources
from hilrunner.setup.axes import find_file, period_ns
from hilrunner.setup.profile import LoadedProfile
from hilrunner.setup.signals import AxisMapping, default_mapping, load_signals


def dbc_path(loaded: LoadedProfile) -> Path:
    """The DBC a profile names: beside it, or the shipped one; DbcError where there is none."""
    path = find_file(loaded.path, loaded.profile.can.dbc, resources.firmware_interface_folder())
    if not path.is_file():
        raise DbcError(
            f"{loaded.path}: can.dbc", f"no such file: {loaded.profile.can.dbc}", remedy="name a DBC beside the profile"
        )
    return path


def signal_tables(loaded: LoadedProfile) -> tuple[CommandTable, MeasurementTable]:
    """Command and measurement tables of a profile; DbcError or ProfileError where they cannot be made."""
    return load_signals(dbc_path(loaded), _mapping(loaded), period_ns(loaded), fd=loaded.profile.can.fd)


def _mapping(loaded: LoadedProfile) -> list[AxisMapping]:
    mapping = loaded.profile.can.mapping
    axis_count = len(loaded.profile.axis)
    if not mapping:
        return default_mapping(axis_count)
    if len(mapping) != axis_count:
        raise ProfileError(
            f"{loaded.path}: can.mapping",
            f"maps {len(mapping)} axes, the profile has {axis_count}",
            remedy="one [[can.mapping]] an axis, in the order of [[axis]]",
        )
    return list(mapping)
