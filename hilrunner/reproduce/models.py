"""The trained models of a reproduction: those that ship, or a folder of the same names."""

import hashlib
import json
from dataclasses import dataclass, field, replace
from pathlib import Path

from hilrunner.base import status
from hilrunner.base.errors import UsageError
from hilrunner.plant.network import SurrogateNetworks
from hilrunner.plant.step import AxisPlant, default_substep_count
from hilrunner.setup import resources
from hilrunner.setup.axes import reference_plants
from hilrunner.setup.model import load_model
from hilrunner.setup.profile import load_profile

PAPER_FLOW, PAPER_RATES, LIFT_FLOW = "paper-flow.onnx", "paper-rates.onnx", "lift-flow.onnx"
PERIOD_S = 1e-3


@dataclass
class Models:
    """Model files by name; each is read once."""

    folder: Path
    _loaded: dict[str, SurrogateNetworks] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path | None) -> "Models":
        """The models in a folder, or those that ship."""
        if folder is not None and not folder.is_dir():
            raise UsageError(f"--models {folder}", "no such folder", f"one that holds {LIFT_FLOW} and its like")
        return cls(folder or resources.models_folder())

    def path(self, name: str) -> Path:
        """The file; one that the folder lacks is taken from what ships."""
        mine = self.folder / name
        return mine if mine.is_file() else resources.models_folder() / name

    def sha256(self, name: str) -> str:
        """Hash of a file."""
        return hashlib.sha256(self.path(name).read_bytes()).hexdigest()

    def networks(self, name: str, plant: AxisPlant) -> SurrogateNetworks:
        """The networks of a file, checked for a plant; ModelError where the file is refused."""
        if name not in self._loaded:
            circuit = status.CIRCUIT_NAMES[plant.circuit]
            self._loaded[name], _ = load_model(self.path(name), circuit, plant.parameters)
        return self._loaded[name]

    def surrogate(self, name: str, plant: AxisPlant) -> AxisPlant:
        """A plant run by the networks of a file."""
        return with_networks(plant, self.networks(name, plant))

    def sheet(self, name: str) -> dict:
        """The data sheet beside a file; {} where there is none."""
        path = self.path(name)
        beside = path.with_name(path.name + ".json")
        return json.loads(beside.read_text("utf-8")) if beside.is_file() else {}


def with_networks(plant: AxisPlant, networks: SurrogateNetworks) -> AxisPlant:
    """The surrogate of a plant, with as many substeps as its stability asks for."""
    made = replace(plant, engine=status.ENGINE_SURROGATE, fast=False, networks=networks, substep_count=0)
    return replace(made, substep_count=default_substep_count(made, PERIOD_S))


def exact_twin(plant: AxisPlant) -> AxisPlant:
    """A surrogate's own reduced model (spools without mass, its substeps) with everything solved exactly: no network."""
    return replace(plant, engine=status.ENGINE_REFERENCE, fast=True, networks=None)


def reference_of(profile: str) -> AxisPlant:
    """The complete first-principle plant of a shipped profile's first axis."""
    plant = replace(reference_plants(load_profile(profile))[0], fast=False, substep_count=0)
    return replace(plant, substep_count=default_substep_count(plant, PERIOD_S))
