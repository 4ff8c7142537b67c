"""The contract's files as tests need them: DBC, golden frames, Data IDs; missing or empty files are failures."""

import csv
import sys
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cantools
import e2e.p02
import numpy as np

from hilrunner.setup import signals

FOLDER = Path(__file__).resolve().parents[2] / "firmware_iface"
DBC = FOLDER / "actuator.dbc"


class GoldenFrame(NamedTuple):
    """One row of golden_frames.csv; `use`: both, send (encoders only), bench (encoders from SI only)."""

    message: str
    axis: int
    can_id: int
    use: str
    values: dict[str, float]
    data: bytes
    source: str


def golden_frames() -> list[GoldenFrame]:
    """Every golden frame."""
    with open(FOLDER / "golden_frames.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) >= 20, "golden_frames.csv is cut short"
    assert all(row["source"] for row in rows)
    return [
        GoldenFrame(
            row["message"],
            int(row["axis"]),
            int(row["can_id"], 16),
            row["use"],
            {name: float(value) for name, value in (pair.split("=") for pair in row["values"].split())},
            bytes.fromhex(row["data"]),
            row["source"],
        )
        for row in rows
    ]


@cache
def database() -> cantools.database.Database:
    """actuator.dbc as cantools reads it."""
    return cantools.database.load_file(DBC)


def data_ids(name: str) -> bytes:
    """The Data ID list of a message."""
    return bytes(
        int(word) for word in database().get_message_by_name(name).dbc.attributes["E2EDataIdList"].value.split()
    )


@cache
def tables(axis_count: int = 2):
    """(CommandTable, MeasurementTable) of actuator.dbc."""
    return signals.load_signals(DBC, signals.default_mapping(axis_count))


def command_frame(
    axis: int = 1, *, control: int = 2, setpoint_percent: float = 0.0, timestamp_us: int = 0, counter: int = 1
) -> bytearray:
    """A VALVE_COMMAND made by cantools and autosar-e2e, that is by none of our code."""
    message = database().get_message_by_name(f"VALVE_COMMAND_{axis}")
    values = {
        "crc8": 0,
        "alive_counter": counter,
        "control": control,
        "valve_setpoint": setpoint_percent,
        "timestamp_us": timestamp_us,
    }
    return protected(message.name, message.encode(values, strict=False))


def protected(name: str, data: bytes) -> bytearray:
    """The same frame with a right CRC for the counter it carries."""
    frame = bytearray(data)
    e2e.p02.e2e_p02_protect(frame, data_ids(name), increment_counter=False)
    return frame


def make_axes():
    """The module firmware_iface/make_axes.py."""
    if str(FOLDER) not in sys.path:
        sys.path.insert(0, str(FOLDER))
    import make_axes as module

    return module


def as_array(data: bytes) -> np.ndarray:
    """u1[64] with zeros behind."""
    out = np.zeros(64, np.uint8)
    out[: len(data)] = np.frombuffer(bytes(data), np.uint8)
    return out
