"""A replay gives the same bits, names the first bit that is not the same, and says how far the full model is away."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from mcap.writer import CompressionType

from hilrunner import cli
from hilrunner.base import records, status
from hilrunner.base.errors import LogError
from hilrunner.evidence import replay
from hilrunner.evidence.reader import read_run
from hilrunner.evidence.replay_dae import COMPARISONS
from hilrunner.evidence.replay_log import write_replay
from hilrunner.setup import run_manifest
from tests.tools import bench_run
from tests.tools.copy_log import copy_with


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """An eventful run: (path, arrays)."""
    path = tmp_path_factory.mktemp("replay") / "run.mcap"
    return path, bench_run.make_run(path)


def exact(path):
    return replay.build_replay(path, replay.ReplayOptions(part=replay.EXACT))


def test_the_run_has_the_events_it_is_meant_to_have(recorded):
    _, arrays = recorded
    modes = set(arrays["command"]["mode"].tolist())
    assert {status.MODE_ACTIVE, status.MODE_STALE_HOLD, status.MODE_STALE_RAMP, status.MODE_FAIL_SAFE} <= modes
    assert np.ptp(arrays["state"]["load_scale"]) > 1e-4
    forced = arrays["command"]["mode"][arrays["command"]["tick"] == 1501]
    assert forced.tolist() == [status.MODE_FAIL_SAFE]


def test_every_bit_is_the_same(recorded):
    path, arrays = recorded
    result = exact(path)
    assert result.exact.identical, result.exact
    assert result.exact.compared_ticks == len(arrays["tick"])
    assert result.exit_code == 0
    assert result.exact.notes == ()


def test_a_forced_fail_safe_is_where_the_loop_flagged_it(recorded, tmp_path):
    """The rows of /rt/miss may be lost: what a limit did is not judged anew from them."""
    path, _ = recorded
    bare = copy_with(path, tmp_path / "bare.mcap", keep=lambda topic: topic != "/rt/miss")
    assert exact(bare).exact.identical


def test_a_log_from_before_the_flag_is_judged_anew(recorded, tmp_path):
    path, _ = recorded
    place = records.TICK.fields["flags"][1] - records.MESSAGE_OFFSET

    def unflagged(topic, log_time, data):
        return data if topic != "/rt/tick" else data[:place] + bytes([data[place] & ~4]) + data[place + 1 :]

    old = copy_with(path, tmp_path / "old.mcap", edit=unflagged, schema=lambda text: text.replace(b"forced", b"fprced"))
    assert exact(old).exact.identical


@pytest.mark.parametrize("axis_field", ["rod_position_m", "line_b_pressure_pa"])
def test_one_flipped_bit_is_named(recorded, tmp_path, axis_field):
    path, arrays = recorded
    wanted = 1234
    place = records.STATE.fields[axis_field][1] - records.MESSAGE_OFFSET

    def flip(topic, log_time, data):
        tick = int.from_bytes(data[4:12], "little")
        if topic != "/luffing/state" or tick != wanted:
            return data
        changed = bytearray(data)
        changed[place] ^= 1
        return bytes(changed)

    result = exact(copy_with(path, tmp_path / "flipped.mcap", edit=flip, compression=CompressionType.LZ4))
    assert not result.exact.identical
    assert (result.exact.first.tick, result.exact.first.field) == (wanted, axis_field)
    assert result.exact.first.topic == "/luffing/state"
    assert result.exact.differing == {f"/luffing/state {axis_field}": 1}
    assert result.exit_code == 1


def test_a_changed_frame_is_found_at_the_tick_it_acts(recorded, tmp_path):
    path, _ = recorded

    def drop(topic, log_time, data):
        if topic == "/can/rx" and int.from_bytes(data[4:12], "little") == 700:
            return data[:-8] + bytes(8)
        return data

    result = exact(copy_with(path, tmp_path / "dropped.mcap", edit=drop))
    assert result.exact.first.tick == 700
    assert result.exact.first.topic == "/luffing/command"


def test_a_gap_ends_the_proof_and_says_so(recorded, tmp_path):
    path, arrays = recorded
    run = read_run(path)
    cut = tmp_path / "gap.mcap"
    keep = lambda data: not 800 <= int.from_bytes(data[4:12], "little") < 810  # noqa: E731
    _copy_without(path, cut, keep)
    result = exact(cut)
    assert result.exact.first is None
    assert not result.exact.identical
    assert result.exact.compared_ticks == int(np.searchsorted(run.tick["tick"], 800))
    assert any("gap after tick 799" in note for note in result.exact.notes)
    assert result.exit_code == 1


def _copy_without(path, target, keep):
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with open(path, "rb") as source, open(target, "wb") as out:
        reader, writer, ids = make_reader(source), Writer(out), {}
        writer.start()
        for one in reader.iter_attachments():
            writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)
        for one in reader.iter_metadata():
            writer.add_metadata(one.name, one.metadata)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic not in ids:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            if channel.topic == "/log" or keep(message.data):
                writer.add_message(ids[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()


def test_a_cut_log_is_replayed_as_far_as_it_goes(recorded, tmp_path):
    path, arrays = recorded
    data = path.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 2 // 3])
    result = exact(cut)
    assert result.exact.first is None
    assert 500 < result.exact.compared_ticks < len(arrays["tick"])
    assert result.notes


def test_the_full_model_agrees_with_its_own_run(recorded):
    path, arrays = recorded
    result = replay.build_replay(path, replay.ReplayOptions(part=replay.DAE))
    (axis,) = result.axes
    assert len(axis.tick) == len(arrays["tick"])
    for quantity, limit in (("chamber 1 pressure", 2e-5), ("chamber 2 pressure", 2e-5), ("rod position", 1e-4)):
        figure = axis.figure(quantity, "run - IDA")
        assert 0 < figure.max < limit, figure
        assert figure.rms <= figure.max
        assert axis.figure(quantity, "run - reference, one step").max <= limit
    assert axis.figure("rod position", "run - IDA").max_normalised < 1e-5
    assert result.exit_code == 0


def test_another_plant_is_out_of_tolerance_from_its_first_motion_on(tmp_path):
    def lighter(loaded):
        from msgspec import structs

        axis = structs.replace(loaded.profile.axis[0], parameters={"valve_bt_mm3ps_sqrtmpa": 1.2e6})
        return structs.replace(loaded, profile=structs.replace(loaded.profile, axis=(axis,)))

    path = tmp_path / "other.mcap"
    bench_run.make_run(path, bench_run.Plan(tick_count=1000), alter=lighter)
    result = replay.build_replay(path, replay.ReplayOptions())
    assert not result.exact.identical
    assert result.axes[0].out_of_tolerance > 100
    assert result.axes[0].first_out_tick < 400


def test_the_written_log_holds_run_and_reference_and_replays_itself(recorded, tmp_path):
    path, arrays = recorded
    result = replay.build_replay(path, replay.ReplayOptions(part=replay.DAE, duration_s=1.0))
    out = tmp_path / "out.mcap"
    write_replay(out, result)
    again = read_run(out)
    assert again.state["luffing"].tobytes() == arrays["state"].tobytes()
    assert again.can_rx.tobytes() == arrays["can"].tobytes()
    rows = again.topics["/luffing/dae"]
    assert len(rows) == len(again.check["luffing"]) == len(result.axes[0].tick)
    assert np.array_equal(rows["rod_position_m"], result.axes[0].ida[:, 0])
    assert again.start_publish_ns == bench_run.START_REAL_NS
    assert exact(out).exact.identical


def test_the_command_prints_json_and_speed(recorded, tmp_path, capsys):
    path, _ = recorded
    page = tmp_path / "replay.html"
    assert cli.main(["replay", str(path), "--json", "--html", str(page), "--duration", "0.5"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["exact"]["identical"] is True
    assert told["exact"]["speed_factor"] > 0
    assert told["dae"][0]["ticks"] == 498
    assert {row["comparison"] for row in told["dae"][0]["errors"]} == set(COMPARISONS)
    assert page.read_text().count("<figure>") >= 8
    assert cli.main(["replay", str(path), "--only", "exact"]) == 0
    assert re.search(r"replayed in [\d.]+ s: \d+ times real time", capsys.readouterr().out)


SKIPPING = bench_run.Plan(tick_count=900, skips={300: 3, 600: 7})
NEVER_LATE = bench_run.Plan(tick_count=900)
VALVE_FAULTS = """
[[fault]]
kind = "valve-gain"
axis = "luffing"
value = 0.7
at_s = 0.2

[[fault]]
kind = "valve-stuck"
axis = "luffing"
value = 0.3
at_s = 0.5
duration_s = 0.1
"""


def smooth_stimulus(tick_count=900):
    """A command that is another one in every period, so that a skipped one cannot be guessed."""
    return 0.5 * np.sin(2 * np.pi * 1.7 * np.arange(tick_count) * 1e-3)[:, None]


@pytest.mark.parametrize("plan", [NEVER_LATE, SKIPPING], ids=["no skips", "skips"])
@pytest.mark.parametrize("faults", ["", VALVE_FAULTS], ids=["no faults", "valve faults"])
def test_a_stimulus_in_the_log_is_replayed_bit_for_bit(tmp_path, plan, faults):
    path = tmp_path / "stimulus.mcap"
    arrays = bench_run.make_run(path, plan, bench_run.PROFILE + faults, stimulus=smooth_stimulus())
    assert len(arrays["can"]) == 0 and np.ptp(arrays["command"]["valve_command"]) > 0.5
    result = exact(path)
    assert result.exact.identical, result.exact
    assert result.exact.notes == ()


def test_logged_commands_stand_in_for_a_missing_stimulus_and_meet_valve_faults_once(tmp_path):
    path = tmp_path / "bare.mcap"
    text = bench_run.PROFILE + VALVE_FAULTS
    arrays = bench_run.make_run(path, NEVER_LATE, text, stimulus=smooth_stimulus(), attach=False)
    assert (arrays["state"]["flags"] & status.FLAG_FAULT_ACTIVE).any()
    result = exact(path)
    assert result.exact.identical, result.exact
    assert any("not applied again" in note for note in result.exact.notes)


def test_without_its_stimulus_a_run_that_skipped_differs_and_says_why(tmp_path):
    path = tmp_path / "bare.mcap"
    bench_run.make_run(path, SKIPPING, stimulus=smooth_stimulus(), attach=False)
    result = exact(path)
    assert result.exact.first.tick == 300
    assert any("skipped periods are not in the log" in note for note in result.exact.notes)


@pytest.mark.parametrize(
    "damage", [lambda data: data[:40], lambda data: b"", lambda data: data.replace(b"900", b"000")], ids=range(3)
)
def test_a_damaged_stimulus_is_refused_in_words(tmp_path, monkeypatch, damage):
    path, honest = tmp_path / "damaged.mcap", run_manifest.stimulus_bytes
    monkeypatch.setattr(run_manifest, "stimulus_bytes", lambda stimulus: damage(honest(stimulus)))
    bench_run.make_run(path, NEVER_LATE, stimulus=smooth_stimulus())
    with pytest.raises(LogError, match="its stimulus"):
        exact(path)


def test_a_run_without_bus_carries_its_stimulus_and_leaves_no_file_behind(tmp_path):
    log = tmp_path / "run.mcap"
    (tmp_path / "temporary").mkdir()
    environment = os.environ | {"TMPDIR": str(tmp_path / "temporary")}
    words = ["--stimulus", "lift-profile-2ms", "--duration", "1", "--priority", "0", "--log", str(log)]
    done = subprocess.run([sys.executable, "-m", "hilrunner", *words], capture_output=True, text=True, env=environment)
    assert done.returncode in (0, 1, 3), (
        done.stderr
    )  # a busy host may miss deadlines: the replay must hold all the more
    assert not list((tmp_path / "temporary").glob("hilrunner-*"))
    assert len(read_run(log).attachments["stimulus.npy"].data) > 8 * 20_000
    assert exact(log).exact.identical


def test_what_cannot_be_replayed_is_refused_in_words(recorded, tmp_path, capsys):
    path, _ = recorded
    bare = copy_with(path, tmp_path / "bare.mcap", keep=lambda topic: topic == "/rt/tick")
    assert cli.main(["replay", str(bare)]) == 2
    assert "no ticks with states" in capsys.readouterr().err
    without = tmp_path / "without.mcap"
    data = (
        path.read_bytes().replace(b"profile.toml", b"profile.tumb").replace(b"profile.effective", b"profile.defective")
    )
    without.write_bytes(data)
    with pytest.raises(LogError, match="carries no profile"):
        exact(without)
    assert cli.main(["replay", str(path), "--out", str(path)]) == 2
    assert cli.main(["replay", str(path), "--rtol", "2"]) == 2
    capsys.readouterr()
    assert cli.main(["replay", str(path), "--duration", "1e-9"]) == 2, "nothing would be compared, and nothing may pass"
    assert "--duration: 1e-09 s is shorter than one period" in capsys.readouterr().err
