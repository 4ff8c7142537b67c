"""What the runner tells the recorder process: one JSON object on its standard input."""

import dataclasses
import json
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Attachment:
    """A file to keep inside the log: one of `fd` (a memory file the recorder inherits), `path` and `text` is set."""

    name: str
    media_type: str
    path: str | None = None
    text: str | None = None
    fd: int | None = None


@dataclass(frozen=True)
class CheckConfig:
    """What the online cross-check needs.

    `plants_fd` is an inherited memory file with the pickle of a list with one plant.step.AxisPlant with engine reference for each
    axis, and of the stimulus that takes the place of the bus, float64[axis, tick], or None. What is unpickled could run any code:
    so it has no name by which anybody else could reach it.
    Tolerances are absolute; NaN or None switches one off. `one_step_decimation` 1 checks every tick's own step, n every
    n-th; `record_decimation` likewise for the records written to /<axis>/check.
    """

    plants_fd: int  # of launch.plants_file
    initial_states: list[list[float]]  # per axis the STATE_SIZE floats of the state before the first tick
    pressure_tolerance_pa: float | None = None  # shadow trajectory, chambers 1 and 2
    position_tolerance_m: float | None = None
    velocity_tolerance_mps: float | None = None
    one_step_pressure_tolerance_pa: float | None = None
    one_step_position_tolerance_m: float | None = None
    sustained_pressure_tolerance_pa: float | None = None  # the free run's errors, mean of a second of open valve
    one_step_decimation: int = 1
    record_decimation: int = 1


@dataclass(frozen=True)
class RecorderConfig:
    """One run as the recorder sees it."""

    ring_fd: int  # of launch.RingBlock; inherited by the recorder
    ring_shape: list[int]  # base.ring.RingShape
    axis_names: list[str]
    period_ns: int
    parent_pid: int  # the runner: its death ends the log
    log_path: str | None = None  # None: no log, only cross-check, statistics and live view
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)  # tables "run" and "host"
    attachments: list[Attachment] = field(default_factory=list)
    statistics_hz: float = 1.0
    live_port: int | None = None
    live_hz: float = 25.0
    sent_signals: list[str] = field(default_factory=list)  # MESSAGE.signal of every entry of the ring's clamped_count
    cpus: list[int] | None = None  # cores the recorder may use; None: all but the runner's choice
    check: CheckConfig | None = None
    module: str = "hilrunner.record"  # the program that takes the records: this room's, or one that keeps no log


def encode(config: RecorderConfig) -> str:
    """The JSON text."""
    return json.dumps(dataclasses.asdict(config))


def decode(text: str) -> RecorderConfig:
    """The configuration in a JSON text; unknown keys are refused (TypeError)."""
    values = json.loads(text)
    values["attachments"] = [Attachment(**one) for one in values["attachments"]]
    if values["check"] is not None:
        values["check"] = CheckConfig(**values["check"])
    return RecorderConfig(**values)
