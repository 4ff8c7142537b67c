"""The CAN contract of a profile: which DBC, which mapping, and the integer tables the loop works with."""

import tempfile
from functools import lru_cache
from pathlib import Path

from hilrunner.base.errors import DbcError, ProfileError
from hilrunner.realtime.decode import CommandTable
from hilrunner.realtime.encode import MeasurementTable
from hilrunner.setup import resources
from hilrunner.setup.axes import period_ns
from hilrunner.setup.database import load_database
from hilrunner.setup.mapping import HEAVE_MESSAGE, AxisMapping, default_mapping
from hilrunner.setup.profile import LoadedProfile, SealedFile
from hilrunner.setup.profile_files import find_file, is_file, sealed_file
from hilrunner.setup.signals import Wiring, wire

DBC_SIZE_MAX_BYTES = 64 * 1024 * 1024
OWN_FILE_SIZE_MAX_BYTES = 1024 * 1024


def dbc_path(loaded: LoadedProfile) -> Path:
    """The DBC a profile names: beside it, or the shipped one, or that of its log; DbcError where there is none."""
    found = sealed_file(loaded, loaded.profile.can.dbc)
    if found is not None:
        return found.path or _unpacked(Path(loaded.profile.can.dbc).name, found.data).path
    path = find_file(loaded, loaded.profile.can.dbc, resources.firmware_interface_folder())
    if not is_file(path):
        raise DbcError(
            f"{loaded.path}: can.dbc", f"no such file: {loaded.profile.can.dbc}", remedy="name a DBC beside the profile"
        )
    return path


class _Unpacked:
    """A file of a log on disk, under its own name, for libraries that read files; it goes with the process."""

    def __init__(self, name: str, data: bytes) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="hilrunner-dbc-")
        self.path = Path(self._folder.name) / name
        self.path.write_bytes(data)


@lru_cache(maxsize=8)
def _unpacked(name: str, data: bytes) -> _Unpacked:
    """Set-up asks several times for one DBC."""
    return _Unpacked(name, data)


def read_dbc(loaded: LoadedProfile) -> SealedFile:
    """The DBC a profile names, as bytes; DbcError where it cannot be read."""
    found = sealed_file(loaded, loaded.profile.can.dbc)
    if found is not None:
        return found
    path = dbc_path(loaded)
    try:
        if path.stat().st_size > DBC_SIZE_MAX_BYTES:
            raise DbcError(
                str(path), f"{path.stat().st_size >> 20} MiB", f"at most {DBC_SIZE_MAX_BYTES >> 20} MiB", "name a DBC"
            )
        return SealedFile(path.read_bytes(), str(path), path)
    except OSError as error:
        raise DbcError(str(path), f"cannot be read ({error.strerror})", remedy="name an existing DBC file") from error


def wiring(loaded: LoadedProfile) -> Wiring:
    """The mapping of a profile as it is understood; DbcError or ProfileError where it cannot be."""
    return wire(
        dbc_path(loaded),
        axis_mappings(loaded),
        period_ns(loaded),
        fd=loaded.profile.can.fd,
        read_own=lambda name: read_own_file(loaded, name).data,
        stale_after_ms=[axis.command.stale_after_ms for axis in loaded.profile.axis],
    )


def signal_tables(loaded: LoadedProfile) -> tuple[CommandTable, MeasurementTable]:
    """Command and measurement tables of a profile; DbcError or ProfileError where they cannot be made."""
    understood = wiring(loaded)
    return understood.commands, understood.measurements


def sent_signal_names(loaded: LoadedProfile) -> list[str]:
    """`MESSAGE.signal` of every row of the measurement table; a plain signal stands once in each page of its message."""
    return [sent.name for sent in wiring(loaded).sent]


def read_own_file(loaded: LoadedProfile, name: str) -> SealedFile:
    """A Python file with a protection of the user's own, beside the profile or in its log; DbcError where it cannot be read."""
    found = sealed_file(loaded, name)
    if found is not None:
        return found
    path = find_file(loaded, name, loaded.path.parent)
    try:
        if path.stat().st_size > OWN_FILE_SIZE_MAX_BYTES:
            raise DbcError(
                str(path), f"{path.stat().st_size} bytes", f"at most {OWN_FILE_SIZE_MAX_BYTES}", "name a Python file"
            )
        return SealedFile(path.read_bytes(), str(path), path)
    except OSError as error:
        remedy = "name a file beside the profile"
        raise DbcError(f"{loaded.path}: {name}", f"cannot be read ({error.strerror})", remedy=remedy) from None


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
