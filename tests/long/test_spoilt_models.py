"""Two thousand spoilt model files: each loads, or is refused in one line, and none takes a minute."""

import time
from collections import Counter

import spoilt_models

from hilrunner.base.errors import ModelError
from hilrunner.plant.parameters import make_parameters
from hilrunner.setup import resources
from hilrunner.setup.model import load_model

COUNT = 2000
SLOWEST_S = 60.0


def test_two_thousand_spoilt_models(tmp_path, drawn):
    outcomes: Counter = Counter()
    path = tmp_path / "spoilt.onnx"
    for name, circuit in (("paper-flow.onnx", "paper"), ("lift-flow.onnx", "lift")):
        data = (resources.models_folder() / name).read_bytes()
        for _ in range(COUNT // 2):
            spoilt = spoilt_models.spoilt(data, drawn)
            path.write_bytes(spoilt)
            begun_s = time.monotonic()
            try:
                load_model(path, circuit, make_parameters(circuit))
                outcomes["loaded"] += 1
            except ModelError as error:
                assert len(str(error).splitlines()) == 1, error
                outcomes["refused"] += 1
            if sum(outcomes.values()) > 1:  # the first one compiles what was not compiled yet
                assert time.monotonic() - begun_s < SLOWEST_S, spoilt
    print(dict(outcomes))
    assert min(outcomes.values()) > COUNT // 100
