"""Golden data is what it was: every file has its hash, a missing, empty, changed or unlisted file is a failure."""

import json

import pytest

from tests.rules import golden_manifest


def _manifest():
    return json.loads(golden_manifest.MANIFEST.read_text())


def test_golden_files_agree_with_the_manifest():
    manifest = _manifest()
    assert len(manifest) >= 2
    assert any(name.endswith(".onnx") for name in manifest)
    assert golden_manifest.differences(manifest) == [], "if this was meant: python tests/rules/golden_manifest.py"


@pytest.mark.parametrize("damage, said", [(None, "missing"), (b"", "empty"), (b"other bytes", "changed")])
def test_damage_is_noticed(tmp_path, damage, said):
    name, entry = next(iter(_manifest().items()))
    if damage is not None:
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_bytes(damage)
    assert golden_manifest.differences({name: entry}, tmp_path) == [f"{name}: {said}"]


def test_every_model_has_its_data_sheet():
    names = [name for name in _manifest() if name.startswith("profiles/models/")]
    for name in names:
        if name.endswith(".onnx"):
            sheets = [other for other in names if other.startswith(name[:-5]) and not other.endswith(".onnx")]
            assert sheets, f"{name} has no data sheet"
