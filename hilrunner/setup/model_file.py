"""A model file before anybody asks what it means: its bytes, the description beside it, the weights outside it.

`whole` makes of the three what a log keeps: one file with everything inside, or the file as it is where everything is inside already.
"""

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from hilrunner.base.errors import ModelError
from hilrunner.setup.text import decoded

FILE_SIZE_MAX_BYTES = 64 * 1024 * 1024  # the largest network a period could evaluate is far smaller
SHEET_SIZE_MAX_BYTES = 8 * 1024 * 1024
NODES_MAX = 10_000
OPSET_MAX = 26  # of onnxruntime 1.31
_ALLOWED = f"at most {FILE_SIZE_MAX_BYTES >> 20} MiB"


@dataclass(frozen=True)
class ModelFile:
    """What was read.

    Args:
        place: how errors call it. name: its bare name.
        data: the ONNX file. sheet_data: the JSON beside it as it is stored, empty where there is none; sheet: read.
        folder: where weights outside the file may lie; None: nowhere, the file came inside a log.
    """

    place: str
    name: str
    data: bytes
    sheet_data: bytes = b""
    folder: Path | None = None

    @property
    def digest(self) -> str:
        """SHA-256 of the file."""
        return hashlib.sha256(self.data).hexdigest()

    def sheet(self) -> dict:
        """The JSON beside it: our data sheet (with the file's sha256), or a user's description of a foreign model."""
        place = f"{self.place}.json"
        if not self.sheet_data:
            return {}
        try:
            sheet = json.loads(decoded(self.sheet_data))
        except (ValueError, RecursionError) as error:
            raise ModelError(place, f"cannot be read: {error}", "JSON", "correct the file or remove it") from error
        if not isinstance(sheet, dict):
            raise ModelError(place, "is not a JSON object", "an object with the hil.* keys of docs/surrogate.md")
        return sheet

    def vouched(self) -> bool:
        """Whether the data sheet names this very file; ModelError where it names another."""
        told = self.sheet().get("sha256")
        if told is not None and told != self.digest:
            raise ModelError(
                self.place,
                "is not the file its data sheet describes (sha256 differs)",
                remedy="restore the file, or export again",
            )
        return told is not None


@contextmanager
def damage_told(place: str) -> Iterator[None]:
    """What protobuf hands on though no exporter writes it (texts that are no UTF-8, fields of another kind) ends in one ModelError."""
    try:
        yield
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, RecursionError) as error:
        words = str(error).strip().splitlines() or [""]
        problem = f"is damaged, or in no form this version knows ({type(error).__name__}: {words[0][:200]})"
        raise ModelError(place, problem, remedy="export or copy it again") from error


def read_model_file(path: Path) -> ModelFile:
    """Read a model and what stands beside it; ModelError where that cannot be done within the budget."""
    beside = path.with_name(path.name + ".json") if path.name else path
    sheet = _read(beside, SHEET_SIZE_MAX_BYTES) if path.name and _is_file(beside) else b""
    data = _read(path, FILE_SIZE_MAX_BYTES)
    if not data:
        raise ModelError(str(path), "is empty", remedy="export or copy it again")
    return ModelFile(str(path), path.name, data, sheet, path.resolve().parent)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _read(path: Path, most_bytes: int) -> bytes:
    """A regular file of limited size: a pipe would wait for ever, a device has no end."""
    try:
        os.stat(path)
        if not path.is_file():
            raise ModelError(str(path), "is no regular file", remedy="name an ONNX file")
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size > most_bytes:
                raise ModelError(
                    str(path), f"{size / 2**20:.0f} MiB", f"at most {most_bytes >> 20} MiB", "a smaller network"
                )
            return file.read(most_bytes)
    except OSError as error:
        raise ModelError(
            str(path), f"cannot be read: {error.strerror}", remedy="check `model` in the profile"
        ) from error


def parse(file: ModelFile) -> tuple:
    """(onnx.ModelProto with every weight inside, its bytes); ModelError where it is damaged, too large or not whole."""
    import onnx
    from google.protobuf.message import DecodeError

    place = file.place
    try:
        model = onnx.ModelProto.FromString(file.data)
    except DecodeError as error:
        raise ModelError(place, "is damaged or no ONNX file", remedy="export or copy it again") from error
    if not model.HasField("graph") or not model.graph.node or not model.graph.output or not model.opset_import:
        raise ModelError(place, "holds no complete graph: cut off, or no ONNX file", remedy="export or copy it again")
    if len(model.graph.node) > NODES_MAX:
        raise ModelError(place, f"{len(model.graph.node)} nodes", f"at most {NODES_MAX}", "a smaller network")
    versions = [entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx")]
    if versions and max(versions) > OPSET_MAX:
        raise ModelError(place, f"opset {max(versions)}", f"at most {OPSET_MAX}", "export with opset 20 or lower")
    if _inline_external(file, model):
        return model, model.SerializeToString(deterministic=True)  # onnxruntime must not look for files again
    return model, file.data


def whole(file: ModelFile) -> ModelFile:
    """The same model with its weights and its description inside, readable without any other file.

    A file that lacks neither stays as it is, byte for byte, and keeps its data sheet, which vouches for it.
    """
    with damage_told(file.place):
        return _whole(file)


def _whole(file: ModelFile) -> ModelFile:
    file.vouched()
    sheet = file.sheet()
    model, data = parse(file)
    have = {entry.key for entry in model.metadata_props}
    added = {key: as_text(value) for key, value in sheet.items() if key.startswith("hil.") and key not in have}
    if data is file.data and not added:
        return replace(file, folder=None)
    for key, value in added.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
    return ModelFile(file.place, file.name, model.SerializeToString(deterministic=True))


def as_text(value) -> str:
    """A value of a description as the text that a file's metadata holds."""
    return value if isinstance(value, str) else json.dumps(value)


def properties(model, sheet: dict, description: dict | None) -> dict[str, str]:
    """The `hil.*` keys of a model: the profile's win over the file's own, and those over the file beside it."""
    found = {entry.key: entry.value for entry in model.metadata_props}
    for source in (sheet, description or {}):
        for key, value in source.items():
            if key.startswith("hil.") and (source is description or key not in found):
                found[key] = as_text(value)
    return found


def _inline_external(file: ModelFile, model) -> bool:
    """Weights stored beside the file are read if they lie in its folder, and refused anywhere else."""
    from onnx import TensorProto
    from onnx.external_data_helper import load_external_data_for_tensor

    budget = FILE_SIZE_MAX_BYTES - len(file.data)
    found = False
    for tensor in _tensors(model):
        if tensor.data_location != TensorProto.EXTERNAL:
            continue
        budget -= _external_size(file, tensor)
        if budget < 0:
            raise ModelError(file.place, "keeps more outside the file than it may", _ALLOWED, "a smaller network")
        try:
            load_external_data_for_tensor(tensor, str(file.folder))
        except Exception as error:  # onnx raises its own checker errors, ValueError and OSError here
            raise ModelError(
                file.place, f"external data of '{tensor.name}' cannot be read: {str(error).splitlines()[0]}",
                remedy="export it again as one file",
            ) from error  # fmt: skip
        tensor.data_location = TensorProto.DEFAULT
        del tensor.external_data[:]
        found = True
    return found


def _external_size(file: ModelFile, tensor) -> int:
    """Bytes a tensor outside the file takes, once it is sure that they lie in a regular file in the model's folder."""
    place = file.place
    entries = {entry.key: entry.value for entry in tensor.external_data}
    location = entries.get("location", "")
    if file.folder is None:
        raise ModelError(
            place, f"keeps '{tensor.name}' in '{location}', which the log does not hold", "one file",
            "run it again from its model: this version puts all weights into the log",
        )  # fmt: skip
    outside = not location or "\0" in location or Path(location).is_absolute()
    target = file.folder if outside else (file.folder / location).resolve()
    if outside or not target.is_relative_to(file.folder):
        raise ModelError(
            place, f"keeps '{tensor.name}' in '{location}', outside its folder", "one file", "save it as one file"
        )
    if not _is_file(target):
        raise ModelError(place, f"keeps '{tensor.name}' in '{location}', which is not there", remedy="copy it as well")
    size = target.stat().st_size
    if size > FILE_SIZE_MAX_BYTES:
        raise ModelError(place, f"keeps {size >> 20} MiB in '{location}'", _ALLOWED)
    length = entries.get("length", "")
    return int(length) if length.isdecimal() and int(length) < size else size


def _tensors(model):
    """Every tensor of the main graph; those of subgraphs too, wherever they hang."""
    waiting = [model.graph]
    while waiting:
        graph = waiting.pop()
        yield from graph.initializer
        for node in graph.node:
            for attribute in node.attribute:
                if attribute.HasField("t"):
                    yield attribute.t
                yield from attribute.tensors
                waiting += [*attribute.graphs, *([attribute.g] if attribute.HasField("g") else [])]
