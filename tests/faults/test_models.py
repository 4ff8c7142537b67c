"""Every way a model file can be wrong ends in one clear error that names the place, and `hilrunner check` exits with 2."""

import json
import shutil

import numpy as np
import onnx
import onnx_models
import pytest
import spoilt_models
from onnx import TensorProto, helper, numpy_helper

from hilrunner.base.errors import ModelError
from hilrunner.plant.parameters import make_parameters
from hilrunner.setup import resources
from hilrunner.setup.model import load_model
from hilrunner.setup.model_file import FILE_SIZE_MAX_BYTES
from tests.tools.error_lines import error_lines


def shipped(tmp_path, name="paper-flow.onnx"):
    path = tmp_path / name
    shutil.copy(resources.models_folder() / name, path)
    return path


def refuse(path, *words, circuit="paper", parameters=None, **options):
    with pytest.raises(ModelError) as caught:
        load_model(path, circuit, parameters, **options)
    text = str(caught.value)
    assert path.name in text
    for word in words:
        assert word in text, text
    return text


def changed(tmp_path, change, name="paper-flow.onnx"):
    path = shipped(tmp_path, name)
    model = onnx.load(path)
    change(model)
    onnx.save(model, path)
    return path


def test_a_file_that_is_not_there(tmp_path):
    refuse(tmp_path / "none.onnx", "cannot be read", "No such file")


def test_an_empty_file(tmp_path):
    path = tmp_path / "empty.onnx"
    path.touch()
    refuse(path, "is empty")


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.99])
def test_a_truncated_file(tmp_path, share):
    path = shipped(tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    text = refuse(path)
    assert "damaged" in text or "cut off" in text


def test_a_file_of_another_kind(tmp_path):
    path = tmp_path / "text.onnx"
    path.write_text("this is no network\n" * 40)
    refuse(path, "ONNX")


def test_a_gigabyte_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "huge.onnx"
    with open(path, "wb") as file:
        file.truncate(1 << 30)  # sparse: takes no room
    refuse(path, "1024 MiB", f"{FILE_SIZE_MAX_BYTES >> 20} MiB")


def test_weights_that_are_no_numbers(tmp_path):
    def poison(model):
        for tensor in model.graph.initializer:
            if tensor.name.endswith("weight_1"):
                values = numpy_helper.to_array(tensor).copy()
                values[2, 3] = np.nan
                values[0, 0] = np.inf
                tensor.CopyFrom(numpy_helper.from_array(values, tensor.name))

    refuse(changed(tmp_path, poison), "network 'flow'", "2 of 250 numbers", "weight of layer 1", "not finite")


def test_a_matrix_of_the_wrong_width(tmp_path):
    def widen(model):
        for tensor in model.graph.initializer:
            if tensor.name.endswith("weight_1"):
                tensor.CopyFrom(numpy_helper.from_array(np.zeros((10, 26)), tensor.name))

    refuse(changed(tmp_path, widen), "Gemm", "takes 26 columns, gets 25")


def test_more_numbers_than_the_metadata_names(tmp_path):
    path = tmp_path / "wide.onnx"
    layers = onnx_models.weights((4, 5, 2))
    constants = {f"k{i}": kernel for i, (kernel, _) in enumerate(layers)}
    nodes = [
        helper.make_node("MatMul", ["x", "k0"], ["a"]),
        helper.make_node("Tanh", ["a"], ["b"]),
        helper.make_node("MatMul", ["b", "k1"], ["y"]),
    ]
    onnx_models.save(path, nodes, constants, inputs=4)
    refuse(path, "takes 4 and gives 2 numbers", "names 3 and 2")


def test_no_metadata_at_all(tmp_path):
    path = changed(tmp_path, lambda model: model.ClearField("metadata_props"))
    refuse(path, "hil.circuit", "hil.networks", path.name + ".json")


@pytest.mark.parametrize(
    ("key", "value", "word"),
    [
        ("hil.circuit", "crane", "unknown"),
        ("hil.recipe", "soup", "unknown"),
        ("hil.format", "9", "format 9"),
        ("hil.networks", "{not json", "not JSON"),
        ("hil.networks", "{}", "JSON dict"),
        ("hil.networks", "[]", "0 networks for role 'flow'"),
        ("hil.networks", '[{"role": "cook"}]', "role 'cook'"),
        ("hil.networks", '[{"role": "flow", "inputs": [], "outputs": []}]', "inputs"),
        ("hil.parameters", "[1]", "JSON list"),
    ],
)
def test_metadata_that_makes_no_sense(tmp_path, key, value, word):
    def spoil(model):
        for entry in model.metadata_props:
            if entry.key == key:
                entry.value = value

    refuse(changed(tmp_path, spoil), word)


@pytest.mark.parametrize(
    ("field", "value", "word"),
    [("unit", "psi", "'psi'"), ("name", "colour_pa", "(colour"), ("low", 1e9, "training range"), ("low", "x", "'x'")],
)
def test_a_quantity_that_makes_no_sense(tmp_path, field, value, word):
    def spoil(model):
        for entry in model.metadata_props:
            if entry.key == "hil.networks":
                networks = json.loads(entry.value)
                networks[0]["inputs"][0][field] = value
                entry.value = json.dumps(networks)

    refuse(changed(tmp_path, spoil), word)


def with_external_data(tmp_path, location, size=None):
    folder = tmp_path / "model"
    folder.mkdir()
    path = shipped(folder)
    model = onnx.load(path)
    for tensor in model.graph.initializer:
        if tensor.name.endswith("weight_0"):
            data = tensor.raw_data
            tensor.ClearField("raw_data")
            tensor.data_location = TensorProto.EXTERNAL
            for key, value in (("location", location), ("offset", "0"), ("length", str(len(data)))):
                entry = tensor.external_data.add()
                entry.key, entry.value = key, value
            target = folder / location
            if target.resolve().is_relative_to(tmp_path) and size is None:
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(data)
            elif size is not None:
                with open(target, "wb") as file:
                    file.truncate(size)
    path.write_bytes(model.SerializeToString())
    return path


def test_external_data_in_the_same_folder_is_read(tmp_path):
    path = with_external_data(tmp_path, "weights.bin")
    inside, _ = load_model(path, "paper", in_loop=False)
    whole, _ = load_model(resources.models_folder() / "paper-flow.onnx", "paper")
    np.testing.assert_array_equal(inside.networks["flow"].weights[0], whole.networks["flow"].weights[0])


@pytest.mark.parametrize("location", ["../weights.bin", "/etc/hostname", "a/../../weights.bin", ""])
def test_external_data_outside_the_folder_is_refused(tmp_path, location):
    refuse(
        with_external_data(tmp_path, location or "weights.bin") if location else _no_location(tmp_path),
        "outside its folder",
    )


def _no_location(tmp_path):
    path = with_external_data(tmp_path, "weights.bin")
    model = onnx.ModelProto.FromString(path.read_bytes())
    for tensor in model.graph.initializer:
        if tensor.data_location == TensorProto.EXTERNAL:
            del tensor.external_data[0]
    path.write_bytes(model.SerializeToString())
    return path


def test_external_data_that_is_missing_or_huge(tmp_path):
    path = with_external_data(tmp_path, "weights.bin")
    (path.parent / "weights.bin").unlink()
    refuse(path, "weights.bin", "not there")
    (tmp_path / "second").mkdir()
    refuse(with_external_data(tmp_path / "second", "weights.bin", size=1 << 30), "1024 MiB")


def test_external_data_shorter_than_it_says(tmp_path):
    path = with_external_data(tmp_path, "weights.bin")
    (path.parent / "weights.bin").write_bytes(b"1234")
    refuse(path, "weight_0")


def test_a_node_that_cannot_be_ported_is_named(tmp_path):
    path = tmp_path / "lstm.onnx"
    onnx_models.lstm(path)
    refuse(path, "node 1, LSTM 'memory'", "--engine onnx")


@pytest.mark.parametrize(
    ("nodes", "word"),
    [
        ([helper.make_node("Softmax", ["x"], ["y"])], "node 0, Softmax"),
        ([helper.make_node("Tanh", ["x"], ["y"])], "without a layer"),
        ([helper.make_node("Add", ["x", "x"], ["y"])], "no MatMul or Gemm"),
        ([helper.make_node("Identity", ["x"], ["y"])], "no MatMul or Gemm"),
        ([helper.make_node("Identity", ["nowhere"], ["y"])], "nothing makes"),
        ([helper.make_node("Div", ["one", "x"], ["y"])], "divides a constant"),
    ],
)
def test_graphs_that_are_no_chain_of_layers(tmp_path, nodes, word):
    path = tmp_path / "odd.onnx"
    onnx_models.save(path, nodes, {"one": [1.0]})
    refuse(path, word)


def test_an_activation_with_another_shape_is_refused(tmp_path):
    path = tmp_path / "elu.onnx"
    (kernel, _), (last, _) = onnx_models.weights((3, 4, 2))
    nodes = [
        helper.make_node("MatMul", ["x", "k"], ["a"]),
        helper.make_node("Elu", ["a"], ["b"], alpha=0.5),
        helper.make_node("MatMul", ["b", "l"], ["y"]),
    ]
    onnx_models.save(path, nodes, {"k": kernel, "l": last})
    refuse(path, "alpha = 0.5")


@pytest.mark.parametrize(("hidden", "word"), [((600,), "600 units"), ((4,) * 8, "9 layers")])
def test_networks_too_large_for_a_period(tmp_path, hidden, word):
    path = tmp_path / "large.onnx"
    onnx_models.keras_style(path, hidden=hidden)
    refuse(path, word, "--engine onnx")


def test_a_newer_opset_than_onnxruntime_knows(tmp_path):
    def age(model):
        model.opset_import[0].version = 99

    refuse(changed(tmp_path, age), "opset 99")


def test_the_wrong_circuit(tmp_path):
    refuse(shipped(tmp_path, "lift-flow.onnx"), "circuit 'lift'", "'paper'")


def test_another_plant_than_it_was_trained_for():
    path = resources.models_folder() / "paper-flow.onnx"
    parameters = make_parameters("paper", {"supply_pressure_mpa": 25.0})
    refuse(path, "supply_pressure_mpa = 30", "25", "hilrunner train", parameters=parameters)
    # what its inputs already scale out may differ
    load_model(path, "paper", make_parameters("paper", {"mass_kg": 900.0, "dead_volume_1_mm3": 2e6}))


def test_a_file_changed_after_its_data_sheet(tmp_path):
    path = shipped(tmp_path)
    shutil.copy(resources.models_folder() / "paper-flow.onnx.json", tmp_path)
    load_model(path, "paper")
    model = onnx.load(path)
    model.doc_string = "touched"
    onnx.save(model, path)
    refuse(path, "data sheet", "sha256")


def test_a_data_sheet_that_is_no_json(tmp_path):
    path = shipped(tmp_path)
    path.with_name(path.name + ".json").write_text("[1]")
    with pytest.raises(ModelError, match="JSON object"):
        load_model(path, "paper")
    path.with_name(path.name + ".json").write_text("{")
    with pytest.raises(ModelError, match="cannot be read"):
        load_model(path, "paper")


def test_a_kernel_that_disagrees_with_onnxruntime_is_not_used(tmp_path, monkeypatch):
    from dataclasses import replace

    from hilrunner.setup import model as module

    honest = module._in_si

    def crooked(*arguments):
        network = honest(*arguments)
        return replace(network, output_scale=network.output_scale * (1.0 + 1e-8))

    monkeypatch.setattr(module, "_in_si", crooked)
    refuse(shipped(tmp_path), "differ by", "of their range")


def test_the_command_line_exits_with_2_and_one_line(tmp_path, capsys):
    from hilrunner.cli import main

    profile = tmp_path / "p.toml"
    text = (resources.profiles_folder() / "paper.toml").read_text("utf-8")
    (tmp_path / "broken.onnx").write_bytes(b"\x08\x08 broken")
    profile.write_text(text.replace("paper-flow.onnx", "broken.onnx"))
    assert main(["check", str(profile)]) == 2
    (line,) = error_lines(capsys.readouterr().err)
    assert "broken.onnx" in line


def spoilt(tmp_path, key, value):
    def spoil(model):
        for entry in model.metadata_props:
            if entry.key == key:
                entry.value = value

    return changed(tmp_path, spoil)


@pytest.mark.parametrize("value", ["NaN", "Infinity", '"30"', "[30]", "true", "null"])
def test_what_a_network_was_trained_for_must_be_a_number(tmp_path, value):
    path = spoilt(tmp_path, "hil.parameters", f'{{"supply_pressure_mpa": {value}}}')
    refuse(path, "hil.parameters", "supply_pressure_mpa", "finite number", parameters=make_parameters("paper"))


@pytest.mark.parametrize(
    ("value", "word"),
    [
        ("[" * 100_000, "not JSON"),
        ('[{"role": "flow", "inputs": 5, "outputs": []}]', "no short list"),
        ('[{"role": "flow", "inputs": [3], "outputs": []}]', "inputs"),
        ('[{"role": "flow", "inputs": [' + ",".join(["{}"] * 5000) + '], "outputs": []}]', "no short list"),
    ],
)
def test_descriptions_of_the_wrong_kind(tmp_path, value, word):
    refuse(spoilt(tmp_path, "hil.networks", value), word)


@pytest.mark.parametrize(
    ("unit", "low"), [("[]", "0.0"), ('"MPa"', "-Infinity"), ('"MPa"', "false"), ('"MPa"', "-1e300")]
)
def test_quantities_of_the_wrong_kind(tmp_path, unit, low):
    path = shipped(tmp_path)
    networks = next(e.value for e in onnx.load(path).metadata_props if e.key == "hil.networks")
    entry = json.loads(networks)
    entry[0]["inputs"][0] |= {"unit": json.loads(unit), "low": json.loads(low)}
    refuse(spoilt(tmp_path, "hil.networks", json.dumps(entry)), entry[0]["inputs"][0]["name"])


def test_texts_and_giants_among_the_constants(tmp_path):
    words = helper.make_tensor("words", TensorProto.STRING, [2], [b"a", b"b"])
    refuse(changed(tmp_path, lambda model: model.graph.initializer.append(words)), "constant 'words'", "texts")
    giant = TensorProto(name="giant", data_type=TensorProto.DOUBLE, dims=[1 << 20, 1 << 20])
    refuse(changed(tmp_path, lambda model: model.graph.initializer.append(giant)), "constant 'giant'", "at most")
    short = TensorProto(name="short", data_type=TensorProto.DOUBLE, dims=[40], raw_data=b"12345678")
    refuse(changed(tmp_path, lambda model: model.graph.initializer.append(short)), "constant 'short'", "damaged")


def test_a_bias_of_another_length_is_refused_by_its_node(tmp_path):
    def shorten(model):
        for tensor in model.graph.initializer:
            if tensor.name.endswith("bias_1"):
                tensor.CopyFrom(numpy_helper.from_array(np.zeros(7), tensor.name))

    refuse(changed(tmp_path, shorten), "Gemm", "do not fit")


def test_a_small_file_that_wants_the_machines_memory_or_time(tmp_path, monkeypatch):
    """Engine onnx runs any graph: a first row goes through a process of its own, with a budget."""
    from hilrunner.setup import model_probe

    path = tmp_path / "giant.onnx"
    size = numpy_helper.from_array(np.array([4_000_000_000]), "size")
    nodes = [
        helper.make_node("ConstantOfShape", ["size"], ["zeros"]),
        helper.make_node("ReduceSum", ["zeros"], ["sum"]),
        helper.make_node("MatMul", ["x", "K"], ["m"]),
        helper.make_node("Add", ["m", "sum"], ["y"]),
    ]
    model = onnx_models.save(path, nodes, {"K": np.ones((3, 2))})
    model.graph.initializer.append(size)
    onnx.save(model, path)
    refuse(path, "network 'flow'", "1 GB and 60 s", in_loop=True)
    monkeypatch.setattr(model_probe, "TIME_MAX_S", 3)
    monkeypatch.setattr(model_probe, "_BUDGET", "1 GB and 3 s")
    refuse(_endless(tmp_path / "endless.onnx"), "network 'flow'", "took too long", in_loop=True)


def _endless(path):
    """A Loop of 2^62 rounds."""
    one = helper.make_tensor_value_info
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["go_on"]), helper.make_node("Identity", ["value"], ["same"])],
        "body",
        [
            one("round", TensorProto.INT64, []),
            one("go", TensorProto.BOOL, []),
            one("value", TensorProto.FLOAT, ["n", 2]),
        ],
        [one("go_on", TensorProto.BOOL, []), one("same", TensorProto.FLOAT, ["n", 2])],
    )
    nodes = [
        helper.make_node("MatMul", ["x", "K"], ["m"]),
        helper.make_node("Loop", ["rounds", "yes", "m"], ["y"], body=body),
    ]
    model = onnx_models.save(path, nodes, {"K": np.ones((3, 2))})
    model.graph.initializer.append(numpy_helper.from_array(np.array(1 << 62), "rounds"))
    model.graph.initializer.append(numpy_helper.from_array(np.array(True), "yes"))
    onnx.save(model, path)
    return path


@pytest.mark.parametrize("kind", ["fifo", "device", "folder"])
def test_a_model_that_is_no_regular_file(tmp_path, kind):
    """A pipe would wait for ever; a device has no end."""
    import os
    from pathlib import Path

    path = Path("/dev/zero") if kind == "device" else tmp_path / "net.onnx"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    refuse(path, "no regular file")


def test_external_data_of_many_tensors_shares_one_budget(tmp_path):
    path = with_external_data(tmp_path, "weights.bin", size=FILE_SIZE_MAX_BYTES - 100_000)
    model = onnx.ModelProto.FromString(path.read_bytes())
    for tensor in model.graph.initializer:
        for entry in list(tensor.external_data):
            if entry.key == "length":
                tensor.external_data.remove(entry)
    path.write_bytes(model.SerializeToString())
    (outside,) = [tensor for tensor in model.graph.initializer if tensor.data_location == TensorProto.EXTERNAL]
    for number in range(3):
        copy = model.graph.initializer.add()
        copy.CopyFrom(outside)
        copy.name = f"more{number}"
    path.write_bytes(model.SerializeToString())
    refuse(path, "external")


def test_spoilt_files_load_or_are_refused_in_one_line(tmp_path):
    data = (resources.models_folder() / "paper-flow.onnx").read_bytes()
    drawn = np.random.default_rng(4)
    path = tmp_path / "spoilt.onnx"
    refused = 0
    for _ in range(60):
        path.write_bytes(spoilt_models.spoilt(data, drawn))
        try:
            load_model(path, "paper", make_parameters("paper"))
        except ModelError as error:
            refused += 1
            assert len(str(error).splitlines()) == 1 and len(str(error)) < 5000, error
    assert refused > 30


def test_a_text_that_is_no_utf8_inside_a_model(tmp_path):
    path = shipped(tmp_path)
    name = onnx.load(path).graph.name.encode()
    path.write_bytes(path.read_bytes().replace(name, b"\xe1" * len(name)))
    refuse(path, "paper-flow.onnx")
