"""The bench of a log, built again from what the log carries, and from nothing else."""

import io
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from hilrunner.base import compiled, records, status
from hilrunner.base.errors import LogError
from hilrunner.evidence.budget import SKIPPED_PERIODS_MAX
from hilrunner.evidence.reader import Run
from hilrunner.realtime import faults as fault_kinds
from hilrunner.setup.effective import PROFILE_ATTACHMENT, profile_of_log
from hilrunner.setup.parcel import STIMULUS_ATTACHMENT
from hilrunner.setup.profile import LoadedProfile, SealedFile


@contextmanager
def unpacked_profile(run: Run) -> Iterator[LoadedProfile]:
    """The profile of a log, its DBC and models those of the log; see `sealed_profile`."""
    yield sealed_profile(run)


def sealed_profile(run: Run) -> LoadedProfile:
    """The profile of a log. Whatever path it names, only the log's own attachments are read, never the file system.

    Raises LogError when the log carries no profile; ProfileError when this version refuses it.
    """
    held = {name: one.data for name, one in run.attachments.items()}
    profile = profile_of_log(held, str(run.path))
    if profile is None:
        raise LogError(
            str(run.path), "carries no profile, so its bench cannot be built again", remedy="replay a log of `run`"
        )
    text = held.get(PROFILE_ATTACHMENT, b"").decode("utf-8", "replace")
    files = {name: SealedFile(data, f"{run.path}: {name}") for name, data in held.items()}
    return LoadedProfile(
        profile=profile,
        path=Path(f"{run.path}: profile"),
        text=text,
        sealed=files,
        plant_equations=_plant_equations(run),
    )


def _plant_equations(run: Run) -> int:
    """Which plant the run had (status.PLANT_EQUATIONS); logs from before there was a choice do not say, and have the first."""
    told = run.metadata.get("run", {}).get("plant_equations", "1")
    if told not in map(str, range(1, status.PLANT_EQUATIONS + 1)):
        raise LogError(
            str(run.path),
            f"its plant has equations '{told[:20]}', which this version does not know",
            f"1 to {status.PLANT_EQUATIONS}",
            "replay it with the version that made it",
        )
    return int(told)


def engine_of(run: Run, override: str | None = None) -> int:
    """status.ENGINE_* of a run, or of the name given."""
    name = override or run.metadata.get("run", {}).get("engine", status.ENGINE_NAMES[status.ENGINE_SURROGATE])
    if name not in status.ENGINE_NAMES:
        raise LogError(str(run.path), f"engine '{name}' is not one of this version", ", ".join(status.ENGINE_NAMES))
    return status.ENGINE_NAMES.index(name)


def stimulus_of(run: Run, notes: list[str]) -> np.ndarray | None:
    """Valve commands that took the place of the bus, float64[tick, axis]; None for a run that was commanded by frames.

    From the log's attachment, else (logs of other programs or versions) from the logged commands, which are those behind
    the valve faults: see `spend_valve_faults`.
    """
    attached = run.attachments.get(STIMULUS_ATTACHMENT)
    if attached is not None:
        return _from_attachment(run, attached.data)
    axes = run.axis_names
    if (
        len(run.can_rx)
        or not axes
        or not any((rows["mode"] == status.MODE_ACTIVE).any() for rows in run.command.values())
    ):
        return None
    last = max(int(rows["tick"][-1]) for rows in run.command.values() if len(rows))
    most = len(run.tick) + SKIPPED_PERIODS_MAX
    if last >= most:
        raise LogError(str(run.path), f"tick number {last} is damaged", f"{most} for a log of {len(run.tick)} ticks")
    stimulus = np.zeros((last + 1, len(axes)))
    for column, axis in enumerate(axes):
        rows = run.command[axis]
        stimulus[rows["tick"].astype(np.int64), column] = rows["valve_command"]
    notes.append("the valve commands are taken from the log itself: the run was not driven by frames")
    if len(run.tick) and run.tick["skipped_count"].any():
        _fill_skipped(stimulus, run.tick)
        notes.append("commands of skipped periods are not in the log; they are taken from the tick after")
    return stimulus


def known_stimulus(run: Run) -> np.ndarray | None:
    """`stimulus_of`, NaN where the commands are only logged ones and so unknown in skipped periods."""
    stimulus = stimulus_of(run, [])
    if stimulus is not None and STIMULUS_ATTACHMENT not in run.attachments:
        return np.full_like(stimulus, np.nan)
    return stimulus


def _from_attachment(run: Run, data: bytes) -> np.ndarray:
    file = io.BytesIO(data)
    try:
        _check_claim(file, len(data))
        stimulus = np.load(file, allow_pickle=False)
    except Exception as error:  # numpy lets what its parser of the head raises through: of tokens, syntax, types
        raise LogError(str(run.path), f"its stimulus cannot be read: {error}") from None
    if not isinstance(stimulus, np.ndarray) or len(stimulus.shape) != 2 or not len(stimulus):
        raise LogError(str(run.path), "its stimulus is no table of commands", f"(ticks, {len(run.axis_names)}) float64")
    if stimulus.ndim != 2 or stimulus.dtype != np.float64 or stimulus.shape[1] != max(len(run.axis_names), 1):
        raise LogError(
            str(run.path), f"its stimulus has shape {stimulus.shape}", f"(ticks, {len(run.axis_names)}) float64"
        )
    return stimulus


def _check_claim(file: io.BytesIO, size: int) -> None:
    """ValueError when the head of a table promises another size than the attachment has: numpy would allocate it first."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, layout = read(file)
    promised = math.prod(shape) * layout.itemsize
    if promised != size - file.tell():
        raise ValueError(f"{size - file.tell()} bytes for a table of {shape} {layout}, which takes {promised}")
    file.seek(0)


def spend_valve_faults(run: Run, faults: np.ndarray, notes: list[str]) -> None:
    """Let the valve faults of a bench do nothing where its commands are logged ones, on which they have acted already.

    They stay active, so that flags stay what they were.
    """
    spent = np.isin(faults["kind"], (fault_kinds.VALVE_STUCK, fault_kinds.VALVE_GAIN))
    if STIMULUS_ATTACHMENT in run.attachments or not spent.any():
        return
    faults["kind"][spent] = fault_kinds.VALVE_GAIN
    faults["value"][spent] = 1.0
    notes.append("the logged commands are those behind the valve faults, which are not applied again")


def _fill_skipped(stimulus: np.ndarray, tick: np.ndarray) -> None:
    for row in tick[tick["skipped_count"] > 0]:
        number = int(row["tick"])
        stimulus[max(number - int(row["skipped_count"]), 0) : number] = stimulus[number]


def version_notes(run: Run) -> list[str]:
    """What differs between the program that ran and the one that replays."""
    told = run.metadata.get("run", {}).get("compiled_source_hash")
    if told is None:
        return ["the log does not say which sources its loop was compiled from"]
    if told != compiled.source_hash():
        return [f"the loop was compiled from other sources ({told}; now {compiled.source_hash()}): bits may differ"]
    return []


def socket_frames(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Received frames as they came from the socket, in order of tick.

    Returns (frames uint8[f, 72] of struct can(fd)_frame, sizes int64[f], ticks int64[f]).
    """
    rows = run.can_rx
    rows = rows[np.argsort(rows["tick"], kind="stable")]
    frames = np.zeros((len(rows), 72), np.uint8)
    frames[:, :4] = np.ascontiguousarray(rows["can_id"]).view(np.uint8).reshape(-1, 4)
    frames[:, 4] = rows["length"]
    is_fd = (rows["flags"] & 1) != 0
    frames[:, 5] = np.where(is_fd, rows["flags"] & 0x07 | 0x04, 0)
    size = min(rows["data"].shape[1], 64) if len(rows) else 0
    frames[:, 8 : 8 + size] = rows["data"][:, :size]
    return frames, np.where(is_fd, 72, 16).astype(np.int64), rows["tick"].astype(np.int64)


assert records.CAN_FD_FRAME["data"].shape == (64,)
