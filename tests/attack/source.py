"""The logs that are attacked: one that the recorder wrote in a run of its own, one with every event a replay has to follow."""

import contextlib
import hashlib
import importlib
import io
import json
import subprocess
import sys
from pathlib import Path

from hilrunner import cli
from hilrunner.base.errors import LogError
from hilrunner.evidence.reader import Run, read_run
from tests.attack.outcome import Outcome, call
from tests.tools import bench_run

PROFILE = """name = "attacked"

[[axis]]
name = "luffing"
circuit = "lift"
preset = "lift"
initial_position_mm = 600.0

[bench]
engine = "reference"
warm_up_ticks = 0

[limits]
pressure_mpa_max = 60.0
ticks_lost_max = 0
frames_rejected_max = 100000
"""
_MACHINE_TIMES = ("wall_s", "processor_s", "speed_factor", "processor_factor", "ida_wall_s", "ida_speed_factor")


def recorded_log(folder: Path, duration_s: float = 0.4) -> Path:
    """A run of the reference engine by a stimulus, written by the recorder process."""
    profile, log = folder / "attacked.toml", folder / "recorded.mcap"
    profile.write_text(PROFILE)
    words = ["run", "--profile", str(profile), "--stimulus", "lift-hold-lower-hold", "--duration", str(duration_s)]
    done = subprocess.run(
        [sys.executable, "-m", "hilrunner", *words, "--priority", "0", "--log", str(log)],
        cwd=folder, capture_output=True, text=True, timeout=1800,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return log


def eventful_log(folder: Path, tick_count: int = 700) -> Path:
    """Frames, skipped periods, misses, fail-safes: through the compiled cycle without a clock."""
    log = folder / "eventful.mcap"
    plan = bench_run.Plan(
        tick_count=tick_count,
        skips={150: 2},
        late_us={100: 120, 400: 6000},
        silent=(300, 360),
        damaged=(50,),
        resets=(450,),
    )
    bench_run.make_run(log, plan)
    return log


def sources(folder: Path) -> list["Source"]:
    """Both, each with what it says undamaged."""
    logs = [Source(recorded_log(folder)), Source(eventful_log(folder))]
    warm_up(logs[1].path)
    return logs


def warm_up(log: Path) -> None:
    """Load in this process what reading a log needs, so that the children find it loaded."""
    for words in (["report", str(log), "--json"], ["replay", str(log), "--only", "exact", "--json"]):
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            cli.main(words)
    for name in ("report_html", "report_text", "replay_html", "replay_text", "junit"):
        importlib.import_module(f"hilrunner.evidence.{name}")


class Source:
    """An undamaged log: its bytes, its contents, and what each command says of it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name = path.stem
        self.data = path.read_bytes()
        self.contents = contents_of(read_run(path))
        self._said: dict[str, tuple[int, str]] = {}

    def judge(self, words: list[str], outcome: Outcome, damaged: Path) -> list[str]:
        """Faults of a command on the damaged copy, a silent pass among them.

        Passing is right only where the copy still holds all there was, and everything said is what is said of the whole log.
        """
        faults = outcome.faults()
        if outcome.code == 0:
            try:
                same = contents_of(read_run(damaged)) == self.contents
            except LogError:
                same = False
            if not same or _figures(outcome.out) != self._whole(words)[1]:
                faults.append("silent pass: not what the whole log holds or says")
        return faults

    def _whole(self, words: list[str]) -> tuple[int, str]:
        key = " ".join(words)
        if key not in self._said:
            outcome = call([words[0], str(self.path), *words[1:]])
            self._said[key] = (outcome.code, _figures(outcome.out))
        return self._said[key]


def contents_of(run: Run) -> str:
    """A hash over all that was recorded: every topic, attachment and table of metadata."""
    digest = hashlib.sha256()
    for topic in sorted(run.topics):
        digest.update(topic.encode() + run.topics[topic].tobytes())
    for name in sorted(run.attachments):
        digest.update(name.encode() + run.attachments[name].data)
    digest.update(json.dumps(run.metadata, sort_keys=True).encode())
    return digest.hexdigest()


def _figures(out: str) -> str:
    """What a command said as JSON, without the file's name and size and the times this machine took."""
    try:
        table = json.loads(out)
    except ValueError:
        return out
    return json.dumps(_without(table), sort_keys=True)


def _without(value):
    if isinstance(value, dict):
        left_out = ("log", "size_bytes", "damage", "notes", *_MACHINE_TIMES)
        return {key: _without(one) for key, one in value.items() if key not in left_out}
    return [_without(one) for one in value] if isinstance(value, list) else value
