"""The end of a run in numbers: one dictionary, printed as JSON or as text."""

import math

import numpy as np

from hilrunner.base import histogram_scale, records, state_layout, status
from hilrunner.base import ring as ring_layout
from hilrunner.base.units import M_PER_MM, NS_PER_MS, PA_PER_MPA
from hilrunner.record.statistics import clamped_counts as counted
from hilrunner.setup.contract import sent_signal_names
from hilrunner.setup.model_onnxruntime import engine_errors
from hilrunner.setup.session import RunResult
from hilrunner.setup.wire_span import bench_warnings


def latency_ns(ring: ring_layout.Ring) -> dict[str, dict[str, int]]:
    """Percentiles of every histogram of the loop that has samples."""
    return {
        name: histogram_scale.percentiles(ring.histogram[index], ring.extreme[index])
        for index, name in enumerate(records.HISTOGRAM_NAMES)
        if ring.extreme[index, histogram_scale.EXTREME_COUNT] > 0
    }


def frame_counts(result: RunResult) -> dict[str, dict[str, int]]:
    """Received frames by what became of them, an entry an axis and one for frames of no axis; zeros left out."""
    names = [axis.name for axis in result.armed.loaded.profile.axis] + ["other"]
    counts = {}
    for name, row in zip(names, result.ring.frame_count, strict=True):
        counts[name] = {text: int(count) for text, count in zip(status.FRAME_STATUS_NAMES, row, strict=True) if count}
    return counts


def clamped_counts(result: RunResult) -> dict[str, int]:
    """How often each sent signal could not carry its value and carried an end of its range instead; zeros left out."""
    return counted(result.ring, sent_signal_names(result.armed.loaded))


def axis_end(result: RunResult) -> list[dict]:
    """Where every axis ended."""
    ends = []
    for index, axis in enumerate(result.armed.loaded.profile.axis):
        state = result.armed.bench.state[index]
        ends.append(
            {
                "name": axis.name,
                "mode": status.MODE_NAMES[int(result.armed.bench.commands[index]["mode"])],
                "rod_position_mm": float(state[state_layout.ROD_POSITION] / M_PER_MM),
                "chamber_1_pressure_mpa": float(state[state_layout.CHAMBER_1_PRESSURE] / PA_PER_MPA),
                "chamber_2_pressure_mpa": float(state[state_layout.CHAMBER_2_PRESSURE] / PA_PER_MPA),
                "substeps": int(result.armed.bench.plant.substep_count[index]),
            }
        )
    return ends


def flag_names(bits: int) -> list[str]:
    """Names of the state flags seen in a run."""
    return [name for index, name in enumerate(status.FLAG_NAMES) if bits >> index & 1]


def summarise_run(result: RunResult, exit_code: int) -> dict:
    """Everything a person or a script asks after a run."""
    progress = result.armed.bench.progress[0]
    profile = result.armed.loaded.profile
    failed = ring_layout.word(result.ring, ring_layout.WORD_CHECK_FAILED_TICK)
    ticks = int(progress["tick_count"])
    return {
        "profile": profile.name,
        "exit_code": exit_code,
        "exit_reason": status.EXIT_NAMES[result.exit_reason],
        "bus_error": result.bus_error,
        "mode": result.mode,
        "period_us": profile.bench.period_us,
        "start_up_s": round(result.start_up_s, 3),
        "tick_count": ticks,
        "duration_s": round(int(progress["tick"] + 1) * profile.bench.period_us * 1e-6, 6) if ticks else 0.0,
        "miss_count": int(progress["miss_count"]),
        "skipped_count": int(progress["skipped_count"]),
        "warned_count": int(progress["warned_count"]),
        "warm_up_ticks": profile.bench.warm_up_ticks,
        "frames_received": int(progress["frames_received"]),
        "frames_sent": int(progress["frames_sent"]),
        "frames_unsent": int(progress["frames_unsent"]),
        "stall": _stall(result),
        "frames_kernel_dropped": ring_layout.word(result.ring, ring_layout.WORD_KERNEL_DROPPED),
        "frames": frame_counts(result),
        "clamped": clamped_counts(result),
        "flags": flag_names(int(progress["flags_seen"])),
        "latency_ns": latency_ns(result.ring),
        "axes": axis_end(result),
        "check_failed_tick": failed - 1 if failed else None,
        "log": str(result.log_path) if result.log_path else None,
        "recorder": result.recorder,
        "firmware": [one.as_dict() for one in result.firmware],
        "engine_errors": _engine_errors(result),
        "stimulus": result.stimulus_facts.as_dict() if result.stimulus_facts else None,
        "warnings": _warnings(result),
        "grants": [grant.as_dict() for grant in result.grants],
    }


def finite(value):
    """The same plain values with NaN and infinity as None, which JSON has."""
    if isinstance(value, dict):
        return {key: finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _warnings(result: RunResult) -> list[str]:
    stimulus = result.stimulus_facts
    return [*(stimulus.warnings if stimulus else ()), *bench_warnings(result.armed.loaded, result.armed.axes)]


def _stall(result: RunResult) -> dict:
    """Times without a served period that were longer than the profile allows, and the longest of all."""
    first = ring_layout.word(result.ring, ring_layout.WORD_STALL_TICK_FIRST)
    return {
        "count": ring_layout.word(result.ring, ring_layout.WORD_STALL_COUNT),
        "longest_ms": ring_layout.word(result.ring, ring_layout.WORD_STALL_NS_MAX) / NS_PER_MS,
        "limit_ms": result.armed.loaded.profile.deadline.stall_ms.max,
        "first_tick": first - 1 if first else None,
    }


def _engine_errors(result: RunResult) -> list[str]:
    """onnxruntime's words, where it is the reason that the run stopped."""
    if result.exit_reason != status.EXIT_NOT_FINITE:
        return []
    axes = result.armed.axes
    return engine_errors([axis.name for axis in result.armed.loaded.profile.axis], axes.plants)


def worst_us(latency: dict, name: str, statistic: str) -> str:
    """One figure of the latency table in microseconds, or a dash."""
    if name not in latency:
        return "-"
    return f"{np.float64(latency[name][statistic]) / 1000:.1f}"
