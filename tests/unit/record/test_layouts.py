"""The layouts that ship name only what a log holds, and are what their generator makes."""

import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from hilrunner.base import records

ROOT = Path(__file__).resolve().parents[3]
LAYOUTS = ROOT / "profiles" / "layouts"
TOPICS = {
    "command": records.COMMAND,
    "state": records.STATE,
    "check": records.CHECK,
    "tick": records.TICK,
    "statistics": records.STATISTICS,
}


def assert_in_the_log(topic: str, field: str) -> None:
    group, kind = topic.strip("/").split("/")
    assert group in ("luffing", "rt")
    assert field in TOPICS[kind].names, f"{topic} has no {field}"


@pytest.mark.parametrize("suffix", ["foxglove.json", "plotjuggler.xml"])
def test_layouts_are_up_to_date(tmp_path, suffix):
    subprocess.run([sys.executable, ROOT / "tools" / "layouts", tmp_path, "amc-lift", "luffing"], check=True)
    shipped = (LAYOUTS / f"amc-lift.{suffix}").read_text()
    assert (tmp_path / f"amc-lift.{suffix}").read_text() == shipped, (
        "run tools/layouts profiles/layouts amc-lift luffing"
    )


def panels_of(node) -> list[str]:
    return [node] if isinstance(node, str) else panels_of(node["first"]) + panels_of(node["second"])


def test_foxglove_paths_exist_and_every_panel_is_placed():
    layout = json.loads((LAYOUTS / "amc-lift.foxglove.json").read_text())
    paths = [path["value"] for config in layout["configById"].values() for path in config.get("paths", [])]
    assert len(paths) > 15
    for path in paths:
        assert_in_the_log(*path.rsplit(".", 1))
    assert sorted(panels_of(layout["layout"])) == sorted(layout["configById"])
    assert layout["configById"]["Table!misses"]["topicPath"] == "/rt/miss"


def test_plotjuggler_curves_exist():
    root = ET.parse(LAYOUTS / "amc-lift.plotjuggler.xml").getroot()
    curves = [curve.get("name") for curve in root.iter("curve")]
    assert len(curves) > 15
    for curve in curves:
        assert_in_the_log(*curve.rsplit("/", 1))
    for splitter in root.iter("DockSplitter"):
        assert int(splitter.get("count")) == len(splitter) == len(splitter.get("sizes").split(";"))


def test_an_axis_name_of_the_profile_stands_in_the_layout():
    profile = (ROOT / "profiles" / "amc-lift.toml").read_text()
    assert 'name = "luffing"' in profile
