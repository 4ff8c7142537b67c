"""What `hilrunner simulate` shows and writes: figures, text, log, plot, progress."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hilrunner.base import status
from hilrunner.base.errors import UsageError
from hilrunner.base.units import M_PER_MM, PA_PER_MPA
from hilrunner.setup.axes import period_ns
from hilrunner.setup.model_onnxruntime import engine_errors
from hilrunner.setup.parcel import Parcel
from hilrunner.setup.profile import LoadedProfile
from hilrunner.setup.simulate import Simulated
from hilrunner.setup.stimulus_facts import StimulusFacts
from hilrunner.setup.wire_span import bench_warnings

_SHOWN = (
    ("chamber_1_pressure_pa", "p1", "MPa", PA_PER_MPA),
    ("chamber_2_pressure_pa", "p2", "MPa", PA_PER_MPA),
    ("rod_position_m", "x", "mm", M_PER_MM),
    ("rod_velocity_mps", "v", "mm/s", M_PER_MM),
)


def check_format(plot: Path | None) -> None:
    """Refuse a picture of an unknown kind before any time is spent."""
    if plot is not None and plot.suffix not in (".png", ".svg"):
        raise UsageError(
            f"--plot {plot}", f"'{plot.suffix}' is not a format", ".png, .svg", "choose one of these endings"
        )


def progress(label: str) -> Callable[[float], None] | None:
    """A bar on a terminal, nothing elsewhere."""
    if not sys.stderr.isatty():
        return None

    def show(share: float) -> None:
        bar = "#" * round(40 * share)
        end = "\n" if share >= 1.0 else ""
        sys.stderr.write(f"\r{label:7s} [{bar:<40s}] {100 * share:3.0f} %{end}")
        sys.stderr.flush()

    return show


def figures(
    loaded: LoadedProfile,
    engine: str,
    stimulus: StimulusFacts,
    first: Simulated,
    compare: str | None,
    second: Simulated | None,
) -> dict:
    """Ranges of every axis and, with a second engine, the largest and RMS differences."""
    axes = []
    for index, axis in enumerate(loaded.profile.axis):
        state = first.state[:, index]
        entry = {"name": axis.name, "flags": _flags(state)}
        for field, name, unit, factor in _SHOWN:
            key = f"{name}_{unit.replace('/', 'p').lower()}"
            entry[key] = [float(state[field].min() / factor), float(state[field].max() / factor)]
        if second is not None:
            entry["difference"] = _difference(state, second.state[:, index])
        axes.append(entry)
    finite = not int(np.bitwise_or.reduce(first.state["flags"].ravel())) & status.FLAG_NOT_FINITE
    return {
        "profile": loaded.profile.name,
        "schedule": stimulus.name,
        "stimulus": stimulus.as_dict() | {"text": stimulus.text()},
        "engine": engine,
        "compare": compare,
        "tick_count": len(first.tick),
        "duration_s": len(first.tick) * period_ns(loaded) * 1e-9,
        "finite": finite,
        "engine_errors": [] if finite else _engine_errors(loaded, first, second),
        "warnings": [*stimulus.warnings, *bench_warnings(loaded, first.armed.axes)],
        "axes": axes,
    }


def _engine_errors(loaded: LoadedProfile, *runs: Simulated | None) -> list[str]:
    names = [axis.name for axis in loaded.profile.axis]
    return [words for run in runs if run is not None for words in engine_errors(names, run.armed.axes.plants)]


def _flags(state: np.ndarray) -> list[str]:
    seen = int(np.bitwise_or.reduce(state["flags"])) if len(state) else 0
    return [name for bit, name in enumerate(status.FLAG_NAMES) if seen >> bit & 1]


def _difference(one: np.ndarray, other: np.ndarray) -> dict:
    count = min(len(one), len(other))
    found = {}
    for field, name, unit, factor in _SHOWN:
        difference = (one[field][:count] - other[field][:count]) / factor
        key = f"{name}_{unit.replace('/', 'p').lower()}"
        found[f"{key}_max"] = float(np.abs(difference).max())
        found[f"{key}_rms"] = float(np.sqrt(np.mean(difference**2)))
    return found


def text(found: dict) -> str:
    """The figures for people."""
    lines = [
        f"profile {found['profile']}, schedule {found['schedule']}, engine {found['engine']}: "
        f"{found['duration_s']:.3f} s simulated ({found['tick_count']} ticks)",
        f"  {found['stimulus']['text']}",
    ]
    for axis in found["axes"]:
        ranges = ", ".join(
            f"{name} {axis[key][0]:.4g} … {axis[key][1]:.4g} {unit}"
            for name, unit, key in (
                (name, unit, f"{name}_{unit.replace('/', 'p').lower()}") for _, name, unit, _ in _SHOWN
            )
        )
        lines.append(f"  {axis['name']}: {ranges}" + (f"; seen: {', '.join(axis['flags'])}" if axis["flags"] else ""))
        if "difference" in axis:
            worst = axis["difference"]
            lines.append(
                f"    {found['engine']} against {found['compare']}: max |dp1| {worst['p1_mpa_max']:.3e} MPa, "
                f"|dp2| {worst['p2_mpa_max']:.3e} MPa, |dx| {worst['x_mm_max']:.3e} mm, "
                f"|dv| {worst['v_mmps_max']:.3e} mm/s"
            )
    lines += [f"  warning: {warning}" for warning in found["warnings"]]
    if not found["finite"]:
        lines.append("  a state left the finite numbers: the run stopped there")
    lines += [f"  {error}" for error in found["engine_errors"]]
    return "\n".join(lines)


def write_log(path: Path, parcel: Parcel, run: Simulated, stimulus: StimulusFacts) -> None:
    """A log like that of a run, label 'simulated clock'; it replays bit for bit."""
    from hilrunner.record.mcap_log import LogWriter
    from hilrunner.record.read_back import check_attachments
    from hilrunner.setup.run_manifest import run_files, run_metadata

    loaded = parcel.loaded
    files = run_files(parcel, run.armed.bench.stimulus)
    attachments = [(one.name, one.media_type, one.data) for one in files]
    metadata = run_metadata(loaded, files, run.engine, [], None)
    metadata["run"] |= {"exit_reason": status.EXIT_NAMES[status.EXIT_STIMULUS_END], "stimulus": stimulus.text()}
    names = [axis.name for axis in loaded.profile.axis]
    log = LogWriter(path, names, 64 if loaded.profile.can.fd else 8, metadata, attachments)
    check_attachments(path, attachments)
    for begin in range(0, len(run.tick), 4096):
        part = slice(begin, begin + 4096)
        log.write_ticks(run.tick[part], run.command[part].reshape(-1), run.state[part].reshape(-1), 0, 0)
    counts = {"tick_count": len(run.tick), "last_tick": int(run.tick["tick"][-1]) if len(run.tick) else -1}
    counts |= dict.fromkeys(("frame_records", "miss_records", "dropped_ticks", "dropped_frames", "dropped_misses"), 0)
    metadata["run"] |= {key: str(value) for key, value in counts.items()}
    log.close(metadata)


def write_plot(
    path: Path, loaded: LoadedProfile, first: Simulated, second: Simulated | None, engine: str, compare: str | None
) -> None:
    """Command, pressures and position over time; the second engine dashed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, rows = pyplot.subplots(4, len(loaded.profile.axis), sharex=True, squeeze=False, figsize=(9, 9))
    for index, axis in enumerate(loaded.profile.axis):
        for run, name, style in ((first, engine, "-"), (second, compare, "--")):
            if run is None:
                continue
            time_s = run.tick["tick"] * period_ns(loaded) * 1e-9
            rows[0][index].plot(time_s, run.command["valve_command"][:, index], style, label=name)
            for row, (field, label, unit, factor) in zip(rows[1:, index], _SHOWN[:3], strict=True):
                row.plot(time_s, run.state[field][:, index] / factor, style)
                row.set_ylabel(f"{label}, {unit}")
        rows[0][index].set_ylabel("valve command")
        rows[0][index].set_title(axis.name)
        rows[0][index].legend()
        rows[-1][index].set_xlabel("time, s")
    for row in rows.ravel():
        row.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path)
    pyplot.close(figure)
