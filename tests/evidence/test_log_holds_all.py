"""The log holds all that the run used: it replays in an empty world, and it is what a run is started from again."""

import argparse
import json
import os
import shutil

import msgspec
import numpy as np
import onnx
import pytest
from onnx import TensorProto

from hilrunner import cli
from hilrunner.base import status
from hilrunner.base.errors import HilrunnerError, LogError, ProfileError, UsageError
from hilrunner.commands import again, run_session
from hilrunner.evidence import replay
from hilrunner.evidence.reader import read_run
from hilrunner.evidence.rebuild import sealed_profile
from hilrunner.record.read_back import check_attachments
from hilrunner.setup import effective, parcel, resources
from hilrunner.setup.arm import arm_offline
from hilrunner.setup.contract import signal_tables
from hilrunner.setup.profile import load_profile, parse_profile
from hilrunner.setup.stimulus import profile_stimulus
from tests.tools import bench_run

PAPER = """name = "holds"
[bench]
warm_up_ticks = 0
[[axis]]
name = "{name}"
circuit = "paper"
preset = "paper"
initial_position_mm = 300.0
model = "{model}"
"""


def network(folder, external=False, scale=1.0):
    """The shipped network as a foreign one: no metadata in the file, the description beside it; weights outside if asked."""
    folder.mkdir(exist_ok=True)
    path = folder / "net.onnx"
    model = onnx.load(resources.models_folder() / "paper-flow.onnx")
    description = {
        entry.key: entry.value
        for entry in model.metadata_props
        if entry.key not in ("hil.golden", "hil.weights_sha256")
    }
    description["hil.networks"] = json.loads(description["hil.networks"])
    del model.metadata_props[:]
    for tensor in model.graph.initializer:
        if tensor.name.endswith("bias_3"):
            values = onnx.numpy_helper.to_array(tensor) * scale
            tensor.CopyFrom(onnx.numpy_helper.from_array(values, tensor.name))
    if external:
        for tensor in model.graph.initializer:
            (folder / tensor.name).write_bytes(tensor.raw_data)
            tensor.ClearField("raw_data")
            tensor.data_location = TensorProto.EXTERNAL
            entry = tensor.external_data.add()
            entry.key, entry.value = "location", tensor.name
    path.write_bytes(model.SerializeToString())
    path.with_name("net.onnx.json").write_text(json.dumps(description))
    return path


def simulate(folder, text, *words):
    """A log of a profile in `folder`, moved to where nothing else lies, the folder gone."""
    world = folder / "world"
    (world / "mine.toml").write_text(text)
    log = folder / "alone.mcap"
    assert (
        cli.main(["simulate", "--profile", str(world / "mine.toml"), "--duration", "0.05", "--out", str(log), *words])
        == 0
    )
    shutil.rmtree(world)
    return log


def identical(log):
    return replay.build_replay(log, replay.ReplayOptions(part=replay.EXACT)).exact.identical


@pytest.mark.parametrize("external", [False, True], ids=["description beside", "weights outside too"])
def test_a_foreign_model_goes_whole_into_the_log(tmp_path, capsys, external):
    network(tmp_path / "world", external)
    log = simulate(tmp_path, PAPER.format(name="boom", model="net.onnx"), "--schedule", "steps")
    assert identical(log)
    held = read_run(log).attachments
    model = onnx.ModelProto.FromString(held["net.onnx"].data)
    assert {"hil.circuit", "hil.networks"} <= {entry.key for entry in model.metadata_props}
    assert not any(tensor.data_location == TensorProto.EXTERNAL for tensor in model.graph.initializer)


def test_a_shipped_model_stays_what_it_is_with_its_data_sheet(tmp_path):
    held = {one.name: one for one in parcel.pack(load_profile("paper"), status.ENGINE_SURROGATE).files}
    shipped = resources.models_folder() / "paper-flow.onnx"
    assert held["paper-flow.onnx"].data == shipped.read_bytes()
    assert held["paper-flow.onnx.json"].data == shipped.with_name("paper-flow.onnx.json").read_bytes()


def test_two_models_of_one_file_name_are_kept_apart(tmp_path):
    world = tmp_path / "world"
    world.mkdir()
    network(world / "a")
    network(world / "b", scale=1.5)
    text = PAPER.format(name="one", model="a/net.onnx")
    text += PAPER.format(name="two", model="b/net.onnx")[PAPER.index("[[axis]]") :]
    (world / "two.dbc").write_text(_two_axes())
    log = simulate(tmp_path, text + '[can]\ndbc = "two.dbc"\n', "--schedule", "steps")
    assert identical(log)
    run = read_run(log)
    assert run.attachments["net.onnx"].data != run.attachments["net-2.onnx"].data
    assert [axis.model for axis in sealed_profile(run).profile.axis] == ["net.onnx", "net-2.onnx"]


def _two_axes():
    from hilrunner.bench.tick import _generator

    return _generator().with_axes((resources.firmware_interface_folder() / "actuator.dbc").read_text(), 2)


def test_dbc_and_schedule_beside_the_profile_come_along(tmp_path, capsys):
    network(tmp_path / "world")
    shutil.copy(resources.firmware_interface_folder() / "actuator.dbc", tmp_path / "world" / "mine.dbc")
    (tmp_path / "world" / "mine.csv").write_text("time_s,valve_command\n0,0\n0.01,0.5\n0.03,0.5\n")
    text = PAPER.format(name="boom", model="net.onnx")
    log = simulate(tmp_path, text + '[can]\ndbc = "mine.dbc"\n[stimulus]\nschedule = "mine.csv"\n')
    assert identical(log)
    loaded = again.load_again(str(log))
    assert signal_tables(loaded)[0].can_id.size == 1
    assert profile_stimulus(loaded).commands.max() == 0.5


def options(**given):
    names = ("period_us", "overrun", "spin_us", "engine", "bitrate")
    return argparse.Namespace(**dict.fromkeys(names) | {"fd": False} | given)


def test_what_the_command_line_says_stands_in_the_profile_and_never_in_its_text(tmp_path):
    """A comment behind a table header was enough to make a second [bench] of it."""
    path = tmp_path / "p.toml"
    path.write_text(
        'name = "case"\n[bench] # 1 kHz\nwarm_up_ticks = 10\n[[axis]]\nname = "boom"\n[limits]\nrod_position_mm_max = 600.5\n'
    )
    given = options(period_us=2000, overrun="stop", spin_us=70, engine="reference", bitrate=250_000, fd=True)
    loaded = run_session._with_options(load_profile(str(path)), given)
    held = {one.name: one.data for one in parcel.pack(loaded, status.ENGINE_REFERENCE, models=False).files}
    assert held["profile.toml"] == path.read_bytes()
    profile = effective.profile_of_log(held, "run.mcap")
    bench = profile.bench
    assert (bench.period_us, bench.overrun, bench.spin_us, bench.engine) == (2000, "stop", 70, "reference")
    assert (profile.can.bitrate, profile.can.fd, profile.limits) == (250_000, True, {"rod_position_mm_max": 600.5})
    assert bench.warm_up_ticks == 10


def test_an_option_that_breaks_a_relation_of_the_profile_is_refused(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text('name = "case"\n[[axis]]\nname = "boom"\n[axis.command]\nstale_after_ms = 5.0\n')
    with pytest.raises(ProfileError, match=r"stale_after_ms: 5.0 ms is shorter than one period"):
        run_session._with_options(load_profile(str(path)), options(period_us=20_000, engine="reference"))


def test_the_effective_profile_reads_back_as_it_was_for_every_profile_that_ships():
    from hilrunner.setup.profile import available_profiles

    for name in available_profiles():
        profile = load_profile(name).profile
        assert effective.read_effective(effective.effective_json(profile), name) == profile
    with pytest.raises(ProfileError, match="is damaged"):
        effective.read_effective(b'{"name": ', "x")


def with_profile(tmp_path, **keys):
    """A profile as if out of a log that holds nothing else."""
    profile = parse_profile('name = "x"\n[[axis]]\nname = "a"\nmodel = "m.onnx"\n', "x")
    loaded = load_profile("amc-lift")
    return msgspec.structs.replace(loaded, profile=msgspec.structs.replace(profile, **keys), sealed={})


@pytest.mark.parametrize("kind", ["fifo", "device", "file", "shipped"])
def test_what_came_in_a_log_opens_no_file(tmp_path, kind):
    """A pipe would wait for ever, a device has no end, and a line of somebody's file would be printed."""
    name = {"fifo": str(tmp_path / "pipe"), "device": "/dev/zero", "file": "/etc/hostname", "shipped": "actuator.dbc"}[
        kind
    ]
    if kind == "fifo":
        os.mkfifo(name)
    from hilrunner.setup.profile import Can, Stimulus

    loaded = with_profile(tmp_path, can=Can(dbc=name), stimulus=Stimulus(schedule=name))
    for use in (signal_tables, profile_stimulus, lambda one: arm_offline(one, status.ENGINE_SURROGATE)):
        with pytest.raises(ProfileError, match="the log does not hold"):
            use(loaded)


def test_a_run_is_repeated_from_its_log_bit_for_bit(tmp_path, capsys):
    log, repeated = tmp_path / "run.mcap", tmp_path / "again.mcap"
    calm = bench_run.Plan(tick_count=300, damaged=(50, 51), silent=(100, 180))
    arrays = bench_run.make_run(log, calm)
    assert cli.main(["simulate", "--profile", str(log), "--schedule", str(log), "--out", str(repeated)]) == 0
    run = read_run(repeated)
    name = run.axis_names[0]
    for field in ("chamber_1_pressure_pa", "rod_position_m", "rod_velocity_mps"):
        np.testing.assert_array_equal(run.state[name][field], arrays["state"][field])
    assert identical(repeated)


def test_commands_of_a_log_meet_valve_faults_once_and_another_period(tmp_path):
    text = bench_run.PROFILE + '[[fault]]\nkind = "valve-gain"\naxis = "luffing"\ngain = 0.5\nat_s = 0.0\n'
    log = tmp_path / "run.mcap"
    arrays = bench_run.make_run(log, bench_run.Plan(tick_count=200), text)
    loaded = again.load_again(str(log))
    commands = again.stimulus_named(str(log), loaded).commands
    np.testing.assert_allclose(0.5 * commands[:, 0], arrays["command"]["valve_command"], rtol=0, atol=0)
    slower = loaded.changed(bench=msgspec.structs.replace(loaded.profile.bench, period_us=2000))
    np.testing.assert_array_equal(again.stimulus_named(str(log), slower).commands, commands[::2])
    with pytest.raises(UsageError, match="has the axes"):
        again.stimulus_named(str(log), load_profile("paper"))


def test_a_log_whose_parts_were_changed_is_not_run_again(tmp_path):
    log = tmp_path / "run.mcap"
    bench_run.make_run(log, bench_run.Plan(tick_count=20))
    changed = tmp_path / "changed.mcap"
    changed.write_bytes(log.read_bytes().replace(b'"preset": "lift"', b'"preset": "lime"'))
    with pytest.raises(HilrunnerError):
        again.load_again(str(changed))


def test_a_disk_that_gives_back_other_bytes_is_noticed_before_the_first_tick(tmp_path):
    log = tmp_path / "run.mcap"
    bench_run.make_run(log, bench_run.Plan(tick_count=20))
    held = [(name, one.media_type, one.data) for name, one in read_run(log).attachments.items()]
    check_attachments(log, held)
    name, media_type, data = held[1]
    other = data[:-2] + b"?\n"
    with pytest.raises(LogError, match="does not read back"):
        check_attachments(log, [held[0], (name, media_type, other), *held[2:]])


def test_a_log_cut_or_spoilt_anywhere_before_its_chunks_is_refused_in_words_or_holds_all(tmp_path):
    """Whatever the library for the file format makes of such bytes; lengths that were spoilt ask for no memory."""
    log = tmp_path / "run.mcap"
    bench_run.make_run(log, bench_run.Plan(tick_count=20))
    held = [(name, one.media_type, one.data) for name, one in read_run(log).attachments.items()]
    whole, spoilt = log.read_bytes(), tmp_path / "spoilt.mcap"
    end = whole.index(held[-1][2]) + len(held[-1][2])
    drawn = np.random.default_rng(4)
    places = sorted({*range(200), *range(end - 60, end), *drawn.integers(0, end, 200).tolist()})
    refused = 0
    for place in places:
        spoilt.write_bytes(whole[:place])
        with pytest.raises(LogError, match="does not read back"):
            check_attachments(spoilt, held)
        spoilt.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            check_attachments(spoilt, held)
        except LogError as error:
            assert "does not read back" in str(error)
            refused += 1
    assert refused > len(places) // 2
