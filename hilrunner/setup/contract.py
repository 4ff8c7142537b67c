"""The CAN contract of a profile: which DBC, which mapping, and the integer tables the loop works with."""

from pathlib import Path

from hilrunner.base.errors import DbcError, ProfileError
from hilrunner.realtime.decode import CommandTable
from hilrunner.realtime.encode import MeasurementTable
from hilrunner.setup import resources
from hilrunner.setup.axes import find_file, period_ns
from hilrunner.setup.database import load_database
from hilrunner.setup.mapping import HEAVE_MESSAGE, AxisMapping, default_mapping
from hilrunner.setup.profile import LoadedProfile
from hilrunner.setup.signals import load_signals


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
    return load_signals(dbc_path(loaded), axis_mappings(loaded), period_ns(loaded), fd=loaded.profile.can.fd)


def sent_signal_names(loaded: LoadedProfile) -> list[str]:
    """`MESSAGE.signal` of every signal the bench fills, in the order of the measurement table."""
    return [
        f"{entry.message}.{mapped if isinstance(mapped, str) else mapped.signal}"
        for axis in axis_mappings(loaded)
        for entry in axis.measurements
        for mapped in entry.signals.values()
    ]


def axis_mappings(loaded: LoadedProfile) -> list[AxisMapping]:
    """One mapping an axis: the profile's own, or that of the shipped contract; ProfileError, DbcError."""
    mapping = loaded.profile.can.mapping
    axis_count = len(loaded.profile.axis)
    if not mapping:
        names = {message.name for message in load_database(dbc_path(loaded)).messages}
        return default_mapping(axis_count, with_heave=f"{HEAVE_MESSAGE}_1" in names)
    if len(mapping) != axis_count:
        raise ProfileError(
            f"{loaded.path}: can.mapping",
            f"maps {len(mapping)} axes, the profile has {axis_count}",
            remedy="one [[can.mapping]] an axis, in the order of [[axis]]",
        )
    return list(mapping)
