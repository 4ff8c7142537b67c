"""`hilrunner reproduce`: its smallest real runs, what it writes, and that a damaged network is seen."""

import json
import re
import shutil

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from hilrunner import cli
from hilrunner.commands import reproduce as command
from hilrunner.reproduce import cases, holding, run
from hilrunner.reproduce.compare import compare
from hilrunner.reproduce.models import LIFT_FLOW, PAPER_FLOW, PAPER_RATES, Models, exact_twin, reference_of
from hilrunner.reproduce.networks import FRESH_SEED, fresh_seed
from hilrunner.reproduce.rows import MUST_FAILS, MUST_HOLDS, NO_MUST, Row
from hilrunner.reproduce.trajectories import PAPER_LIMITS, error_rows
from hilrunner.setup import resources

ROW_KEYS = {
    "key", "what", "measured", "unit", "label", "article", "source", "must", "aim", "at_least", "timing", "must_met", "aim_met",
}  # fmt: skip


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """Two parts through the command line."""
    folder = tmp_path_factory.mktemp("reproduce")
    assert cli.main(["reproduce", "--quick", "--only", "networks", "paper", "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def found(ran):
    """Its JSON."""
    return json.loads((ran / "reproduce.json").read_text())


def rows_of(found) -> dict[str, dict]:
    return {row["key"]: row for part in found["parts"] for row in part["rows"]}


def test_json_holds_every_row_once_with_all_its_keys(found):
    rows = [row for part in found["parts"] for row in part["rows"]]
    assert len(rows) == len(rows_of(found)) > 15
    assert all(set(row) == ROW_KEYS for row in rows)
    assert [part["name"] for part in found["parts"]] == ["paper", "networks"]
    judged = {row["key"] for row in rows if row["must"] is not None}
    assert set(found["musts_met"]) | set(found["musts_not_met"]) == judged
    assert not set(found["musts_met"]) & set(found["musts_not_met"])


def test_the_articles_lift_is_far_within_its_must_and_stands_beside_the_articles_figures(found):
    rows = rows_of(found)
    for run_name, printed in (("nominal", (0.1001, 0.0093)), ("perturbed", (0.0402, 0.0099))):
        for symbol, article in zip(("p1", "p2"), printed, strict=True):
            row = rows[f"paper.{run_name}.{symbol}"]
            assert row["must_met"] and 0.0 < row["measured"] < 1e-4 == row["must"]
            assert row["article"] == article and "IDA" in row["label"] and PAPER_FLOW in row["label"]
            assert rows[f"paper.{run_name}_own_form.{symbol}"]["measured"] > 1000 * row["measured"]


def test_networks_are_told_with_the_best_constant_and_their_training(found):
    rows = rows_of(found)
    for key in ("paper-flow.flow", "lift-flow.supply", "lift-flow.return"):
        assert rows[f"networks.{key}"]["must_met"] and "best constant" in rows[f"networks.{key}"]["label"]
    assert rows["networks.parameters"]["measured"] == 672
    assert rows["networks.paper-rates.rates"]["must"] is None
    # a constant on the article's rates comes out small: a normalised error alone is no evidence
    assert rows["networks.literal_constant"]["measured"] < 1e-3
    assert "processor time" in rows["networks.paper-rates.training"]["label"]


def test_the_page_shows_every_row_and_needs_nothing_but_itself(ran, found):
    text = (ran / "reproduce.html").read_text()
    assert not re.search(r"(?:src|href)=|url\(|@import|https?://|<script", text)
    plain = text.replace("&#x27;", "'").replace("&quot;", '"')
    for row in rows_of(found).values():
        assert row["what"] in plain and row["label"] in plain
    for figure in range(5, 12):
        assert f"As Figure {figure}:" in text
    assert text.count("<svg") >= 20 and "musts hold" in text


def test_the_table_says_which_musts_hold(capsys, tmp_path, monkeypatch):
    kept = Row("a", "kept figure", 1.0, "mm", "made up", must=2.0, aim=0.5)
    broken = Row("b", "broken figure", 3.0, "mm", "made up", must=2.0)
    part = run.Part("paper", "Made up", rows=[kept, broken])
    monkeypatch.setitem(run.PARTS, "paper", lambda models, quick: part)
    assert cli.main(["reproduce", "--only", "paper", "--out", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "1 of 2 musts hold" in text and "NOT MET: broken figure: 3 mm, must <= 2" in text
    assert "aim not reached: kept figure" in text
    assert cli.main(["reproduce", "--only", "paper", "--out", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["musts_not_met"] == ["b"]


def damaged(folder):
    """The shipped flow network of circuit paper with one weight 1 % larger, without the sheet that would betray it."""
    model = onnx.load(resources.models_folder() / PAPER_FLOW)
    tensor = next(one for one in model.graph.initializer if one.name.endswith("weight_1"))
    weights = numpy_helper.to_array(tensor).copy()
    weights.ravel()[np.abs(weights).argmax()] *= 1.01
    tensor.CopyFrom(numpy_helper.from_array(weights, tensor.name))
    onnx.save(model, folder / PAPER_FLOW)
    return Models.of(folder)


def test_one_damaged_weight_breaks_the_must(tmp_path):
    case = cases.paper_lift(False).shortened(2.0)
    verdicts = []
    for models in (Models.of(None), damaged(tmp_path)):
        one = compare(case, models.surrogate(PAPER_FLOW, case.plant), None)
        verdicts.append([row.verdict for row in error_rows("k", one, PAPER_LIMITS)])
    assert verdicts == [[MUST_HOLDS, MUST_HOLDS, NO_MUST], [MUST_FAILS, MUST_FAILS, NO_MUST]]


def test_what_is_not_a_number_meets_nothing():
    def row(value, **limits):
        return Row("k", "what", value, "1", "label", **limits)

    assert row(float("nan"), must=1.0).verdict == row(None, must=1.0).verdict == MUST_FAILS
    assert row(float("nan"), must=1.0).as_dict()["measured"] is None
    assert row(2.0, must=1.0).verdict == MUST_FAILS and row(2.0, must=1.0, at_least=True).verdict == MUST_HOLDS
    assert row(0.0, must=0.0).verdict == MUST_HOLDS and row(1e-300, must=0.0).verdict == MUST_FAILS
    assert row(5.0).verdict == NO_MUST


@pytest.mark.parametrize(("profile", "file"), [("paper", PAPER_FLOW), ("amc-lift", LIFT_FLOW)])
def test_a_hold_adds_nothing_and_the_articles_form_creeps(profile, file):
    models, reference = Models.of(None), reference_of(profile)
    surrogate = models.surrogate(file, reference)
    for start in holding.starts_of(surrogate, 0.5).values():
        mine = holding.hold(surrogate, start, 3.0)
        assert mine.drift_m == holding.hold(exact_twin(surrogate), start, 3.0).drift_m
    if profile == "paper":
        rest = holding.starts_of(surrogate, 0.3)["from rest"]
        own = holding.hold(models.surrogate(PAPER_RATES, reference), rest, 3.0)
        assert abs(own.drift_m) > 1e-5 and abs(own.rate_mps) > 1e-6


def test_held_out_runs_are_the_same_every_time_and_all_different():
    drawn = [cases.held_out("amc-lift", number, 4.0) for number in range(3)]
    again = cases.held_out("amc-lift", 1, 4.0)
    np.testing.assert_array_equal(drawn[1][0].commands, again[0].commands)
    assert len({scale for _, scale, _ in drawn}) == 3
    for case, scale, start_m in drawn:
        assert 0.7 <= scale <= 1.1 and 0.2 <= start_m <= 1.0 and np.abs(case.commands).max() <= 1.0
        assert np.ptp(case.commands) > 0.2
    assert cases.held_out("paper", 0, 4.0)[0].commands.min() >= 0.0


def test_fresh_points_never_come_from_the_seed_of_the_training():
    assert fresh_seed({"seed": 1}) != 1
    assert fresh_seed({"seed": FRESH_SEED}) != FRESH_SEED


def test_the_command_knows_the_parts_there_are():
    assert tuple(run.PARTS) == command.PARTS


def test_bad_input_exits_with_2(tmp_path, capsys):
    assert cli.main(["reproduce", "--models", str(tmp_path / "nowhere"), "--out", str(tmp_path)]) == 2
    assert "--models" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert cli.main(["reproduce", "--out", str(tmp_path / "file" / "below")]) == 2
    assert "cannot be written" in capsys.readouterr().err
    broken = tmp_path / "models"
    broken.mkdir()
    shutil.copy(resources.models_folder() / PAPER_FLOW, broken / LIFT_FLOW)
    assert (
        cli.main(["reproduce", "--only", "networks", "--quick", "--models", str(broken), "--out", str(tmp_path)]) == 2
    )
    assert "circuit" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stopped:
        cli.main(["reproduce", "--only", "nothing"])
    assert stopped.value.code == 2
