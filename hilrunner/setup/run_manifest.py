"""What a log must carry to be repeated and believed: metadata tables, and everything the run used as attachments (`setup.parcel`)."""

import hashlib
import io
import json
import subprocess
import sys
from importlib import metadata as package_metadata
from pathlib import Path

import numpy as np

import hilrunner
from hilrunner.base import compiled, status
from hilrunner.setup import host
from hilrunner.setup.parcel import STIMULUS_ATTACHMENT, PackedFile, Parcel
from hilrunner.setup.profile import LoadedProfile

STIMULUS_MEDIA_TYPE = "application/octet-stream"
_PACKAGES = ("numpy", "numba", "llvmlite", "python-can", "onnxruntime", "mcap")


def run_metadata(
    loaded: LoadedProfile, files: list[PackedFile], engine: int, grants: list, report: host.HostReport | None
) -> dict:
    """The tables `run` and `host`, all values text; `files` are those the log holds, each with its hash."""
    profile = loaded.profile
    run = {
        "hilrunner_version": hilrunner.__version__,
        "git_revision": git_revision(),
        "compiled_source_hash": compiled.source_hash(),
        "plant_equations": loaded.plant_equations,
        "python_version": sys.version.split()[0],
        **{f"{name}_version": package_metadata.version(name) for name in _PACKAGES},
        "profile_name": profile.name,
        "profile_sha256": hashlib.sha256(loaded.text.encode()).hexdigest(),
        "engine": status.ENGINE_NAMES[engine],
        "period_ns": profile.bench.period_us * 1000,
        "overrun": profile.bench.overrun,
        "axis_names": ",".join(axis.name for axis in profile.axis),
        "wave_seeds": ",".join(str(axis.wave.seed) if axis.wave else "-" for axis in profile.axis),
        "load_seeds": ",".join(str(axis.load.perturbation_seed) for axis in profile.axis),
        "can_bitrate": profile.can.bitrate,
        **{f"sha256:{one.name}": one.digest for one in files},
    }
    tables = {"run": {key: str(value) for key, value in run.items()}}
    if report is None:
        tables["host"] = {"mode_label": host.mode_label([], [], simulated_clock=True)}
        return tables
    tables["host"] = {
        # judged again by the report when the misses of the run are known
        "mode_label": host.mode_label(grants, report.findings),
        "mode_reasons": "; ".join(host.mode_reasons(grants, report.findings)),
        **report.facts,
        "findings": json.dumps([finding.as_dict() for finding in report.findings]),
        "grants": json.dumps([grant.as_dict() for grant in grants]),
    }
    return tables


def run_files(parcel: Parcel, stimulus: np.ndarray | None) -> list[PackedFile]:
    """What the log of a run holds: its parcel, and the commands that take the place of the bus, where they do.

    The commands of skipped periods stand nowhere else, and a logged command is the one behind the valve faults.
    """
    found = list(parcel.files)
    if stimulus is not None:
        found.append(PackedFile(STIMULUS_ATTACHMENT, STIMULUS_MEDIA_TYPE, stimulus_bytes(stimulus)))
    return found


def stimulus_bytes(stimulus: np.ndarray) -> bytes:
    """Valve commands, float64[tick, axis], as a NumPy file."""
    file = io.BytesIO()
    np.save(file, np.ascontiguousarray(stimulus, dtype=np.float64), allow_pickle=False)
    return file.getvalue()


def git_revision() -> str:
    """Commit of the source tree this runs from, with `+` when it has changes; `release` for an installed package."""
    root = Path(hilrunner.__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return "release"
    try:
        words = ["git", "-C", str(root), "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"]
        return subprocess.run(words, capture_output=True, text=True, timeout=5, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"
