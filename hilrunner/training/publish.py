"""The files a training leaves: ONNX, data sheet, golden vectors inside both, curves."""

import hashlib
import json
from pathlib import Path

from hilrunner.training.export import GOLDEN_COUNT, to_onnx
from hilrunner.training.problem import Recipe
from hilrunner.training.train import Outcome, Plan, versions, write_json

# recipe -> what its networks answer, for the file's name: paper-flow.onnx, lift-flow.onnx, paper-rates.onnx
_FILE_WORDS = {"flow": "flow", "paper": "rates"}
_CURVE_KEYS = ("iteration", "seconds", "train", "validation", "gamma")
_CURVE_ROWS = 60  # of the curve kept in the data sheet: enough to draw


def write_model(recipe: Recipe, outcomes: list[Outcome], plan: Plan, folder: Path, command: str, profile: dict) -> Path:
    """Write `<circuit>-<flow|rates>.onnx`, its data sheet `.onnx.json` and `.curves.json`, and prove the file can be loaded.

    Returns:
        Path of the ONNX file.

    Raises:
        ModelError: the file does not load, or the compiled kernel and onnxruntime disagree.
    """
    from hilrunner.setup.model import load_model

    parameters: dict[str, float] = {}
    for problem in recipe.problems:
        parameters |= problem.parameters
    training = {
        "seed": plan.seed,
        "networks": {outcome.facts["role"]: _short(outcome.facts) for outcome in outcomes},
        "versions": versions(),
    }
    networks = [outcome.network for outcome in outcomes]
    model = to_onnx(networks, recipe.circuit, recipe.name, parameters, training, plan.seed)
    data = model.SerializeToString()
    path = folder / model_file_name(recipe.circuit, recipe.name)
    path.write_bytes(data)
    sheet = {
        "file": path.name,
        "sha256": hashlib.sha256(data).hexdigest(),
        "circuit": recipe.circuit,
        "recipe": recipe.name,
        "made_by": command,
        "profile": profile,
        "seed": plan.seed,
        "parameters": parameters,
        "golden_vectors": GOLDEN_COUNT,
        "networks": [outcome.facts | {"curve": thinned(outcome.curves)} for outcome in outcomes],
        "versions": versions(),
    }
    write_json(path.with_name(path.name + ".json"), sheet)
    curves = {outcome.facts["role"]: outcome.curves for outcome in outcomes}
    path.with_suffix(".curves.json").write_text(json.dumps(curves), "utf-8")
    load_model(path, recipe.circuit)
    return path


def model_file_name(circuit: str, recipe: str) -> str:
    """Name of a model file by its circuit and what its networks answer."""
    return f"{circuit}-{_FILE_WORDS[recipe]}.onnx"


def thinned(curves: list[dict]) -> list[dict]:
    """A training's curve with few enough rows for a data sheet; the last iteration is always among them."""
    stride = max(1, -(-len(curves) // _CURVE_ROWS))
    return [{key: row[key] for key in _CURVE_KEYS} for row in curves[::-1][::stride][::-1]]


def _short(facts: dict) -> dict:
    keys = ("iterations", "train_points", "unsolved_points", "effective_parameters", "weights_sha256")
    return {key: facts[key] for key in keys} | {"test_rms": facts["test"]["rms"]}
