"""All that a run uses, read once into memory before anything is built: profile, DBC, models, schedule.

The bench is built from this parcel, and the log holds it. So a run whose log could not be replayed cannot start: what the log will
lack is missing already when the bench is built, and a file that changes on disk meanwhile changes neither.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import msgspec

from hilrunner.base import status
from hilrunner.base.errors import ProfileError
from hilrunner.plant.schedule import SCHEDULES
from hilrunner.setup import effective, model_file, resources
from hilrunner.setup.contract import read_dbc, read_own_file
from hilrunner.setup.profile import LoadedProfile, SealedFile
from hilrunner.setup.profile_files import find_file, is_file, sealed_file
from hilrunner.setup.user_check import with_own_files

STIMULUS_ATTACHMENT = "stimulus.npy"
HISTOGRAM_ATTACHMENT = "rt_histograms.json"  # added by the recorder at the end
_MEDIA_TYPES = {".toml": "application/toml", ".json": "application/json", ".onnx": "application/onnx"}
_SCHEDULE_SIZE_MAX_BYTES = 256 * 1024 * 1024


@dataclass(frozen=True)
class PackedFile:
    """One file of the parcel."""

    name: str
    media_type: str
    data: bytes

    @property
    def digest(self) -> str:
        """SHA-256 of the data."""
        return hashlib.sha256(self.data).hexdigest()


@dataclass(frozen=True)
class Parcel:
    """A profile that names nothing outside its own files, and those files as the log keeps them."""

    loaded: LoadedProfile
    files: tuple[PackedFile, ...]

    def check_unchanged(self) -> None:
        """What a library has read from disk must still be what the log holds; ProfileError where somebody changed it meanwhile."""
        for one in (self.loaded.sealed or {}).values():
            if one.path is not None and one.path.read_bytes() != one.data:
                raise ProfileError(one.place, "changed while the run was set up", remedy="start the run again")


def pack(loaded: LoadedProfile, engine: int, models: bool = True) -> Parcel:
    """Read everything a profile names.

    Args:
        engine: status.ENGINE_* of the run; the parcel's profile names it. models: whether networks are asked for.

    Models become whole files (weights and description inside); two of one file name get names of their own, and the profile names
    them so.

    Raises:
        ProfileError, ModelError, DbcError: a file is missing, is no regular file, or is too large.
    """
    packing = _Packing(loaded)
    profile = loaded.profile
    dbc = packing.add(profile.can.dbc, read_dbc(loaded))
    mapping = tuple(with_own_files(one, packing.add_own_file) for one in profile.can.mapping)
    axes = []
    for axis in profile.axis:
        name = packing.add_model(axis.model) if axis.model and models else axis.model
        axes.append(msgspec.structs.replace(axis, model=name))
    changed = loaded.changed(
        axis=tuple(axes),
        can=msgspec.structs.replace(profile.can, dbc=dbc, mapping=mapping),
        bench=msgspec.structs.replace(profile.bench, engine=status.ENGINE_NAMES[engine]),
        stimulus=msgspec.structs.replace(profile.stimulus, schedule=packing.add_schedule(profile.stimulus.schedule)),
    )
    files = [
        PackedFile(effective.PROFILE_ATTACHMENT, "application/toml", loaded.text.encode()),
        PackedFile(effective.EFFECTIVE_ATTACHMENT, "application/json", effective.effective_json(changed.profile)),
        *(_packed(name, one.data) for name, one in packing.files.items()),
    ]
    # built from what the log will hold, read the way a replay reads it
    sealed = msgspec.structs.replace(
        changed,
        profile=effective.profile_of_log({one.name: one.data for one in files}, str(loaded.path)),
        sealed=packing.files,
    )
    return Parcel(sealed, tuple(files))


class _Packing:
    """Names and files as they are added."""

    def __init__(self, loaded: LoadedProfile) -> None:
        self.loaded = loaded
        self.files: dict[str, SealedFile] = {}
        self._names: dict[tuple[str, str], str] = {}  # (place, hash) -> name in the log
        self._taken = {
            effective.PROFILE_ATTACHMENT,
            effective.EFFECTIVE_ATTACHMENT,
            STIMULUS_ATTACHMENT,
            HISTOGRAM_ATTACHMENT,
        }

    def add(self, wanted: str, file: SealedFile, beside: str = "") -> str:
        """Keep a file under its bare name, or under one of its own where that is taken; `beside`: ending of a companion."""
        key = file.place, hashlib.sha256(file.data).hexdigest()
        if key not in self._names:
            self._names[key] = self._free(Path(wanted).name or "file", beside)
            self.files[self._names[key]] = file
        return self._names[key]

    def add_model(self, name: str) -> str:
        """A whole model and, where its data sheet vouches for it, that sheet."""
        model = model_file.whole(read_model(self.loaded, name))
        kept = self.add(model.name, SealedFile(model.data, model.place), ".json")
        if model.sheet_data:
            self.files[f"{kept}.json"] = SealedFile(model.sheet_data, f"{model.place}.json")
        return kept

    def add_own_file(self, name: str) -> str:
        """A Python file with a protection of the user's own."""
        return self.add(name, read_own_file(self.loaded, name))

    def add_schedule(self, name: str) -> str:
        """A schedule in a file; one that ships by name is part of the program, one that is missing is not asked for."""
        if name in SCHEDULES:
            return name
        found = sealed_file(self.loaded, name) if self.loaded.sealed and name in self.loaded.sealed else None
        path = self.loaded.path.parent / name
        if found is None and self.loaded.sealed is None and is_file(path):
            if path.stat().st_size > _SCHEDULE_SIZE_MAX_BYTES:
                return name
            found = SealedFile(path.read_bytes(), str(path))
        return name if found is None else self.add(name, found)

    def _free(self, name: str, beside: str) -> str:
        stem, dot, ending = name.rpartition(".")
        number = 1
        while True:
            tried = name if number == 1 else f"{stem}-{number}.{ending}" if dot and stem else f"{name}-{number}"
            if not {tried, tried + beside} & self._taken:
                self._taken |= {tried, tried + beside}
                return tried
            number += 1


def read_model(loaded: LoadedProfile, name: str) -> model_file.ModelFile:
    """A model a profile names, read but not yet understood; ModelError or ProfileError where it cannot be read."""
    found = sealed_file(loaded, name)
    if found is None:
        return model_file.read_model_file(find_file(loaded, name, resources.models_folder()))
    kept = next(key for key, one in loaded.sealed.items() if one is found)
    sheet = loaded.sealed.get(f"{kept}.json")
    return model_file.ModelFile(found.place, Path(kept).name, found.data, b"" if sheet is None else sheet.data)


def _packed(name: str, data: bytes) -> PackedFile:
    return PackedFile(name, _MEDIA_TYPES.get(Path(name).suffix.lower(), "application/octet-stream"), data)
