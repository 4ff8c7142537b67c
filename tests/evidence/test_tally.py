"""A run without a log is judged as the same run with one: the same limits, the same values."""

import json
from dataclasses import replace

import numpy as np
import pytest

from hilrunner.base import status
from hilrunner.evidence import latency, limit_measures
from hilrunner.evidence.judge_log import judge_log
from hilrunner.evidence.limit_measures import Measured
from hilrunner.evidence.plant_use import SettlingTally
from hilrunner.evidence.reader import read_run
from hilrunner.evidence.report import RunnerKnows, build_report
from hilrunner.evidence.tally import Tally
from hilrunner.record.statistics import HISTOGRAM_ATTACHMENT
from tests.evidence.test_verdict import EDGES, eventful, profile
from tests.tools import synthetic_run

TICKS = 3590
OF_THE_LOG = {"log_undamaged", "log_finished"}


def histograms(report) -> bytes:
    """What the loop of this run would have counted."""
    table: dict = {"scale": {"sub_bucket_bits": 6, "value_bits": 40}}
    for name, one in report.latency.distributions.items():
        used = np.flatnonzero(one.row)
        table[name] = {"extreme": one.extreme.tolist(), "buckets": np.column_stack((used, one.row[used])).tolist()}
    return json.dumps(table).encode()


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """The same records into a log and past a tally: (report of the log, verdict of the tally)."""
    blocks = []

    def keep(block):
        eventful(block)
        blocks.append({name: rows.copy() for name, rows in block.items()})

    text = profile("\n".join(f"{key} = {kept}" for key, (kept, _) in EDGES.items()))
    path = tmp_path_factory.mktemp("tally") / "run.mcap"
    synthetic_run.write_run(path, TICKS, profile_text=text, stall_every=900, edit=keep)
    report, tables = build_report(path), read_run(path).metadata
    tally = Tally([synthetic_run.AXIS], tables, [("profile.toml", "application/toml", text.encode())])
    for block in blocks:
        synthetic_run.write_block(tally, block)
    tally.add_attachment(HISTOGRAM_ATTACHMENT, "application/json", histograms(report))
    tally.close(tables)
    return report, tally.verdict


def test_every_limit_has_the_same_value_and_outcome(both):
    report, told = both
    of_log = {one.key: one for one in report.verdict.judgements if one.key not in OF_THE_LOG}
    of_tally = {one["key"]: one for one in told["limits"]}
    assert set(of_log) == set(of_tally) and set(EDGES) <= set(of_tally)
    for key, one in of_log.items():
        assert of_tally[key]["value"] == pytest.approx(one.value, rel=1e-12, abs=1e-12), key
        assert (of_tally[key]["outcome"], of_tally[key]["unit"]) == (one.outcome, one.unit), key
    assert (told["outcome"], told["exit_code"]) == ("passed", 0)


def fewer_states(block):
    """As a cut or damaged log may have them."""
    eventful(block)
    block["state"]["tick"][-100:] += 1


@pytest.mark.parametrize("edit", [None, eventful, fewer_states])
def test_a_log_is_judged_the_same_without_holding_its_records(tmp_path, edit):
    """The runner reads its log back in the same memory however long the run was; a report keeps every tick."""
    text = profile("\n".join(f"{key} = {kept}" for key, (kept, _) in EDGES.items()))
    path = synthetic_run.write_run(tmp_path / "run.mcap", TICKS, profile_text=text, stall_every=900, edit=edit)
    knows = RunnerKnows(TICKS - 6, "duration reached")
    of_report = build_report(path, knows=knows).verdict
    of_run = judge_log(path, knows)
    assert [repr(one) for one in of_run.judgements] == [repr(one) for one in of_report.judgements]


REQUIREMENT = '\n[[requirement]]\nid = "R1"\nformula = "always chamber_1_pressure < 1 MPa"\n'


def test_a_requirement_is_judged_by_the_runner_too(tmp_path):
    """By its log as a report does; without a log it cannot be judged, and does not pass."""
    text = profile("pressure_mpa_max = 30.0") + REQUIREMENT
    path = synthetic_run.write_run(tmp_path / "run.mcap", 200, profile_text=text)
    knows = RunnerKnows(200, "duration reached")
    of_report, of_run = build_report(path, knows=knows).verdict, judge_log(path, knows)
    assert of_report.exit_code == of_run.exit_code == 1
    assert "requirement R1" in {one.key for one in of_run.failed}
    tables = read_run(path).metadata
    tally = Tally(["lift"], tables, [("profile.toml", "application/toml", text.encode())])
    tally.close(tables)
    assert any(cause.startswith("requirement R1: not judged") for cause in tally.verdict["causes"])


def test_a_run_too_long_for_its_samples_is_judged_by_the_histogram(both, monkeypatch):
    report, _ = both
    monkeypatch.setattr(latency, "EXACT_SAMPLES_MAX", 1000)
    samples = latency.Samples()
    for _ in range(3):
        samples.take(np.arange(400))
    assert not samples.is_whole
    monkeypatch.setattr(limit_measures, "EXACT_SAMPLES_MAX", 1000)
    loop = report.latency.distributions["wake_lateness"]
    told = replace(report.latency, loop={"wake_lateness": replace(loop, values_ns={**loop.values_ns, "p999": 7})})
    measured = Measured(told, report.bus, report.axes, report.checks, report.coverage)
    assert limit_measures.measure("wake_lateness_us_p999", measured, {}).value == 0.007


def test_what_the_ring_dropped_fails_without_a_log_too(both):
    tables = {
        "run": {"exit_reason": "duration reached", "tick_count": "0", "dropped_ticks": "12", "axis_names": "lift"}
    }
    tally = Tally(["lift"], tables, [("profile.toml", "application/toml", profile("pressure_mpa_max = 30.0").encode())])
    tally.close(tables)
    assert tally.verdict["exit_code"] == 1
    causes = " ".join(tally.verdict["causes"])
    assert "ticks_lost_max: failed: 12 against 0" in causes
    assert "pressure_mpa_max: not judged: the log has no state of axis lift" in causes or "no axis" in causes


@pytest.mark.parametrize("batch", [1, 7, 100, 5000])
def test_stops_do_not_depend_on_how_the_run_is_cut(batch):
    rng = np.random.default_rng(5)
    tick = np.arange(5000)
    valve = np.repeat([0.3, 0.0, -0.7, 0.002, 0.3, 0.002, 0.01, 0.0, 0.9, 0.0], 500)
    valve[rng.integers(0, 5000, 5)] = 0.3  # a stretch at neutral that is broken, another that is too short
    speed = np.abs(valve) * 20 + rng.random(5000)
    whole = SettlingTally(1_000_000, 0.5)
    whole.take(tick, valve, speed)
    parts = SettlingTally(1_000_000, 0.5)
    for start in range(0, 5000, batch):
        rows = slice(start, start + batch)
        parts.take(tick[rows], valve[rows], speed[rows])
    assert parts.rows().tolist() == whole.rows().tolist()
    assert len(whole.rows()) >= 3


def test_a_firmware_that_is_silent_fails_without_a_log_too():
    tables = {"run": {"exit_reason": "duration reached", "tick_count": "0", "dropped_ticks": "0", "axis_names": "lift"}}
    for keys, code in (("", 1), ("[bench]\nrequire_firmware = false\n", 0)):
        text = profile("frames_rejected_max = 5").replace("[[axis]]", keys + "[[axis]]")
        tally = Tally(["lift"], tables, [("profile.toml", "application/toml", text.encode())])
        tally.close(tables)
        assert tally.verdict["exit_code"] == code, tally.verdict["causes"]
    assert status.MODE_WAITING == 0
