"""The pages in a real Chromium: whole, legible in light and dark, on a narrow screen and on paper, without a network."""

import re
import shutil
import subprocess

import numpy as np
import pytest
from matplotlib import image

from hilrunner import cli
from tests.tools import bench_run, synthetic_run

WIDTH, HEIGHT = 1200, 1600
_PROBE = """<script>addEventListener("load", () => {
  const wide = document.documentElement.scrollWidth > innerWidth;
  const flat = [...document.querySelectorAll("svg")].filter((one) => one.getBoundingClientRect().height < 50).length;
  document.body.dataset.probe = JSON.stringify({wide, flat, figures: document.querySelectorAll("svg").length});
});</script></body>"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Report and replay pages made by the commands."""
    folder = tmp_path_factory.mktemp("pages")
    synthetic_run.write_run(folder / "run.mcap", 6000, stall_every=1500)
    assert cli.main(["report", str(folder / "run.mcap"), "--html", str(folder / "report.html")]) in (0, 1)
    bench_run.make_run(folder / "replayed.mcap", bench_run.Plan(tick_count=400))
    assert cli.main(["replay", str(folder / "replayed.mcap"), "--html", str(folder / "replay.html")]) == 0
    assert cli.main(["reproduce", "--quick", "--only", "paper", "--out", str(folder)]) == 0
    return folder


def chromium(folder, *options) -> str:
    program = shutil.which("chromium")
    assert program, "chromium is needed: apt-get install chromium"
    done = subprocess.run(
        [program, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
         "--disable-background-networking", "--disable-component-update", "--disable-sync",
         f"--user-data-dir={folder / 'browser'}", *options],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", ["report", "replay", "reproduce"])
def test_a_page_needs_nothing_but_itself(pages, name):
    text = (pages / f"{name}.html").read_text()
    assert not re.search(r"(?:src|href)=|url\(|@import|https?://|<script", text)
    assert text.count("<svg") >= 8


@pytest.mark.parametrize("name", ["report", "replay", "reproduce"])
@pytest.mark.parametrize("width", [WIDTH, 420])
def test_nothing_runs_over_the_edge(pages, name, width):
    probe = pages / "probe.html"
    probe.write_text((pages / f"{name}.html").read_text().replace("</body>", _PROBE))
    # headless windows are at least 500 px wide: the narrow page is a frame in a wide one
    window = [f"--window-size={max(width, 500)},{HEIGHT}"]
    dom = chromium(pages, *window, "--dump-dom", f"file://{probe}")
    seen = re.search(r"data-probe=\"([^\"]*)\"", dom)[1].replace("&quot;", '"')
    assert '"wide":false' in seen and '"flat":0' in seen, seen


@pytest.mark.parametrize("name", ["report", "replay", "reproduce"])
def test_light_and_dark(pages, name):
    shades = {}
    for scheme, number in (("light", 1), ("dark", 0)):
        picture = pages / f"{name}-{scheme}.png"
        chromium(
            pages, f"--window-size={WIDTH},{HEIGHT}", f"--blink-settings=preferredColorScheme={number}",
            f"--screenshot={picture}", f"file://{pages / f'{name}.html'}",
        )  # fmt: skip
        pixels = image.imread(picture)[..., :3]
        assert pixels.shape[:2] == (HEIGHT, WIDTH)
        shades[scheme] = float(np.median(pixels))
        grey = pixels.mean(axis=2)
        assert np.count_nonzero(np.abs(grey - np.median(grey)) > 0.4) > 5000, "text and lines stand out"
        assert np.count_nonzero(np.ptp(pixels, axis=2) > 0.25) > 1000, "curves have colours"
    assert shades["light"] > 0.9
    assert shades["dark"] < 0.15


def test_on_paper(pages):
    out = pages / "report.pdf"
    chromium(pages, f"--print-to-pdf={out}", "--no-pdf-header-footer", f"file://{pages / 'report.html'}")
    data = out.read_bytes()
    assert data.startswith(b"%PDF-")
    count = len(re.findall(rb"/Type\s*/Page[^s]", data))
    assert 2 <= count <= 8
