"""Samples on disk: chunks that can be made in any order, resumed after a stop, and counted; splits never overlap.

A folder holds `<split>-<number>.npy` chunks (inputs and targets side by side, float64) and `samples.json` with the seed, the
ranges, and for every chunk its rows, its unsolved points and its sha256. A chunk is written under another name and
renamed, so what carries a chunk's name is whole.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hilrunner.base.errors import UsageError
from hilrunner.training.problem import Problem
from hilrunner.training.sampling import Split, unit_points

CHUNK_ROWS = 250_000
MANIFEST = "samples.json"


@dataclass
class Samples:
    """One problem's points: what is on disk and how to read it."""

    folder: Path
    problem: Problem
    seed: int
    splits: tuple[Split, ...]
    chunk_rows: int
    chunks: dict[str, dict] = field(default_factory=dict)

    @property
    def point_count(self) -> int:
        """Points of all splits."""
        return sum(split.count for split in self.splits)

    def unsolved(self) -> int:
        """Points the plant could not answer; they are counted here and left out of the chunks."""
        return sum(chunk["unsolved"] for chunk in self.chunks.values())

    def files(self, split: str) -> list[Path]:
        """Chunk files of a split in order."""
        names = sorted(name for name in self.chunks if name.startswith(f"{split}-"))
        return [self.folder / name for name in names]

    def load(self, split: str, rows: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """(inputs, targets) of a split, or of its first rows, in memory."""
        parts, have = [], 0
        for path in self.files(split):
            part = np.load(path)
            parts.append(part)
            have += len(part)
            if rows is not None and have >= rows:
                break
        table = np.concatenate(parts)[:rows]
        width = len(self.problem.inputs)
        return table[:, :width], table[:, width:]


def make_samples(
    problem: Problem,
    folder: Path,
    splits: tuple[Split, ...],
    seed: int,
    chunk_rows: int = CHUNK_ROWS,
    workers: int = 2,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> Samples:
    """Fill a folder with the points of one problem, going on where an earlier call stopped.

    Args:
        report: called with points done and points in all after every chunk.

    Raises:
        UsageError: the folder holds samples of other ranges, seed or sizes, or a chunk is not what was written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    samples = Samples(folder, problem, seed, splits, chunk_rows)
    identity = _identity(samples)
    manifest = _read_manifest(folder)
    if manifest and manifest["identity"] != identity:
        raise UsageError(
            str(folder), "holds samples of other ranges, seed or sizes", remedy="another --out, or delete it"
        )
    known = manifest.get("chunks", {})
    tasks, done = [], 0
    for split in splits:
        for number, first in enumerate(range(split.first, split.first + split.count, chunk_rows)):
            name = f"{split.name}-{number:05d}.npy"
            rows = min(chunk_rows, split.first + split.count - first)
            if name in known and _is_whole(folder / name, known[name]):
                samples.chunks[name] = known[name]
                done += rows
            else:
                tasks.append((name, first, rows))
    report(done, samples.point_count)
    with ThreadPoolExecutor(workers) as pool:  # the plant's functions release the interpreter's lock
        for name, facts in pool.map(lambda task: _make_chunk(samples, *task), tasks):
            samples.chunks[name] = facts
            done += facts["rows"] + facts["unsolved"]
            _write_manifest(samples, identity)
            report(done, samples.point_count)
    _write_manifest(samples, identity)
    return samples


def _make_chunk(samples: Samples, name: str, first: int, rows: int) -> tuple[str, dict]:
    points = unit_points(first, rows, samples.point_count, samples.problem.dimensions, samples.seed)
    inputs, targets, solved = samples.problem.answer(points)
    solved = solved & np.isfinite(targets).all(axis=1) & np.isfinite(inputs).all(axis=1)
    table = np.concatenate([inputs, targets], axis=1)[solved]
    temporary = samples.folder / (name + ".part")
    with open(temporary, "wb") as file:
        np.save(file, table)
    os.replace(temporary, samples.folder / name)
    unsolved = int(np.count_nonzero(~solved))
    digest = hashlib.sha256((samples.folder / name).read_bytes()).hexdigest()
    return name, {"rows": len(table), "unsolved": unsolved, "sha256": digest}


def _identity(samples: Samples) -> dict:
    problem = samples.problem
    return {
        "role": problem.role,
        "seed": samples.seed,
        "chunk_rows": samples.chunk_rows,
        "splits": [[split.name, split.first, split.count] for split in samples.splits],
        "inputs": [[quantity.name, quantity.low, quantity.high] for quantity in problem.inputs],
        "outputs": [quantity.name for quantity in problem.outputs],
        "parameters": problem.parameters,
    }


def _read_manifest(folder: Path) -> dict:
    path = folder / MANIFEST
    if not path.is_file():
        return {}
    try:
        return json.loads(path.read_text("utf-8"))
    except ValueError as error:
        raise UsageError(str(path), "is damaged", remedy="delete the folder") from error


def _write_manifest(samples: Samples, identity: dict) -> None:
    path = samples.folder / MANIFEST
    temporary = path.with_suffix(".part")
    temporary.write_text(
        json.dumps({"identity": identity, "chunks": samples.chunks}, indent=1, sort_keys=True), "utf-8"
    )
    os.replace(temporary, path)


def _is_whole(path: Path, facts: dict) -> bool:
    return path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() == facts["sha256"]


@dataclass(frozen=True)
class Scaling:
    """What -1 and 1 stand for, inputs and targets."""

    input_low: np.ndarray
    input_high: np.ndarray
    target_low: np.ndarray
    target_high: np.ndarray

    def normalised(self, inputs: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both mapped to -1..1."""
        x = 2.0 * (inputs - self.input_low) / (self.input_high - self.input_low) - 1.0
        y = 2.0 * (targets - self.target_low) / (self.target_high - self.target_low) - 1.0
        return x, y


def scaling_of(problem: Problem, targets: np.ndarray) -> Scaling:
    """Inputs by their declared training range, targets by what the samples show."""
    low = np.array([quantity.low for quantity in problem.inputs])
    high = np.array([quantity.high for quantity in problem.inputs])
    return Scaling(low, high, targets.min(axis=0), targets.max(axis=0))


class Data:
    """Normalised points for training, in memory or read chunk by chunk from disk."""

    def __init__(
        self, scaling: Scaling, arrays: tuple[np.ndarray, np.ndarray] | None = None, files: list[Path] | None = None
    ):
        self.scaling = scaling
        self.files = files or []
        self.width = len(scaling.input_low)
        self.outputs = len(scaling.target_low)
        self.arrays = None if arrays is None else scaling.normalised(*arrays)
        self.rows = len(arrays[0]) if arrays is not None else sum(len(np.load(f, mmap_mode="r")) for f in self.files)
        self._tensors: dict = {}

    @property
    def target_count(self) -> int:
        """Points times outputs."""
        return self.rows * self.outputs

    def batches(self, rows: int, device) -> Iterator[tuple]:
        """(inputs, targets) as float64 tensors on a device, `rows` points at a time."""
        import torch

        if self.arrays is not None:
            if device not in self._tensors:
                self._tensors[device] = [torch.tensor(array, device=device) for array in self.arrays]
            inputs, targets = self._tensors[device]
            for first in range(0, self.rows, rows):
                yield inputs[first : first + rows], targets[first : first + rows]
            return
        for path in self.files:
            table = np.load(path, mmap_mode="r")
            for first in range(0, len(table), rows):
                part = np.array(table[first : first + rows])
                x, y = self.scaling.normalised(part[:, : self.width], part[:, self.width :])
                yield torch.tensor(x, device=device), torch.tensor(y, device=device)
