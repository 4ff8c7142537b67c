"""A replay of a run: bit-exact first, then the full model beside it; text, JSON, HTML and a log are views of it."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from hilrunner.base import exit_codes
from hilrunner.base.errors import LogError
from hilrunner.base.units import M_PER_MM, PA_PER_MPA
from hilrunner.evidence.budget import SKIPPED_REPLAYED_MAX
from hilrunner.evidence.facts import RunFacts, read_facts
from hilrunner.evidence.reader import Run, read_run
from hilrunner.evidence.rebuild import engine_of, known_stimulus, unpacked_profile
from hilrunner.evidence.replay_dae import IDA_RTOL, AxisDae, replay_dae
from hilrunner.evidence.replay_exact import ExactReplay, replay_exact
from hilrunner.evidence.report import finite
from hilrunner.setup.axes import build_axes, check_duration, period_s, reference_plants
from hilrunner.setup.profile import CrossCheck, LoadedProfile

EXACT, DAE, BOTH = "exact", "dae", "both"

Progress = Callable[[str, float], None]  # (what is being done, share 0..1)


@dataclass(frozen=True)
class ReplayOptions:
    """What to do: `part` of EXACT, DAE, BOTH; `duration_s` and `rtol` of the full model; `engine` in place of the run's."""

    part: str = BOTH
    duration_s: float | None = None
    rtol: float = IDA_RTOL
    engine: str | None = None


@dataclass(frozen=True)
class Replay:
    """What came of it."""

    path: Path
    run: Run
    facts: RunFacts
    exact: ExactReplay | None
    axes: list[AxisDae]
    tolerance: CrossCheck
    perturbed_load: bool
    notes: tuple[str, ...]

    @property
    def exit_code(self) -> int:
        """0; 1: the replay is not the run, bit for bit; 5: the surrogate left the profile's tolerance."""
        if self.exact is not None and not self.exact.identical:
            return exit_codes.VERDICT_FAILED
        if any(axis.out_of_tolerance for axis in self.axes):
            return exit_codes.CROSS_CHECK_FAILED
        return exit_codes.PASSED


def build_replay(path: str | Path, options: ReplayOptions, progress: Progress = lambda what, share: None) -> Replay:
    """Read a run and replay it.

    Raises LogError when the log cannot be read or lacks what a replay needs; ProfileError, ModelError, DbcError when this
    version refuses what the log carries; UsageError for a duration without a period; StateError when the full model has no consistent start.
    """
    run = read_run(path)
    if not len(run.tick) or not run.axis_names:
        raise LogError(
            str(path), "holds no ticks with states, so there is nothing to replay", remedy="replay a log of `run`"
        )
    _check_skipped(run)
    facts = read_facts(run)
    with unpacked_profile(run) as loaded:
        _check_axes(run, loaded)
        check_duration(options.duration_s, loaded)
        facts = replace(facts, period_ns=loaded.profile.bench.period_us * 1000)
        engine = engine_of(run, options.engine)
        exact, axes = None, []
        if options.part in (EXACT, BOTH):
            exact = replay_exact(run, facts, loaded, engine, lambda share: progress("bit-exact replay", share))
        if options.part in (DAE, BOTH):
            axes = _dae(run, loaded, engine, options, progress)
        return Replay(
            path=Path(path),
            run=run,
            facts=facts,
            exact=exact,
            axes=axes,
            tolerance=loaded.profile.crosscheck,
            perturbed_load=any(axis.load.perturbation_std_ratio > 0 for axis in loaded.profile.axis),
            notes=(*facts.notes, *run.damage),
        )


def _check_skipped(run: Run) -> None:
    """Skipped periods are computed too: a count that no run can have would keep the plant busy for days."""
    count = int(run.tick["skipped_count"].sum(dtype=np.int64))
    if count > SKIPPED_REPLAYED_MAX:
        raise LogError(
            str(run.path),
            f"/rt/tick tells of {count} skipped periods, which a replay has to compute",
            f"{SKIPPED_REPLAYED_MAX}",
            "the field skipped_count is damaged, or the host slept for an hour: run again",
        )


def _check_axes(run: Run, loaded: LoadedProfile) -> None:
    names = tuple(axis.name for axis in loaded.profile.axis)
    if set(names) != set(run.axis_names):
        raise LogError(str(run.path), f"axes {', '.join(run.axis_names)} are not the profile's ({', '.join(names)})")


def _dae(run: Run, loaded: LoadedProfile, engine: int, options: ReplayOptions, progress: Progress) -> list[AxisDae]:
    built, plants = build_axes(loaded, engine), reference_plants(loaded)
    stimulus = known_stimulus(run)
    limits = tolerances(loaded.profile.crosscheck)
    span = options.duration_s
    tick_limit = None if span is None else int(np.searchsorted(run.tick["tick"], round(span / period_s(loaded))))
    results = []
    for index, axis in enumerate(loaded.profile.axis):
        results.append(
            replay_dae(
                run,
                axis.name,
                index,
                plants,
                built.plants[index],
                built.initial_states[index],
                period_s(loaded),
                limits,
                stimulus=None if stimulus is None else stimulus[:, index],
                rtol=options.rtol,
                tick_limit=tick_limit,
                progress=lambda share, name=axis.name: progress(f"IDA, axis {name}", share),
            )  # fmt: skip
        )
    return results


def tolerances(rules: CrossCheck) -> np.ndarray:
    """Largest errors allowed, float64[12]: x, v, p1, p2 of the trajectory, of one step, sustained; infinite: not watched."""
    pressure, position = rules.pressure_tolerance_mpa * PA_PER_MPA, rules.position_tolerance_mm * M_PER_MM
    step = rules.one_step_pressure_tolerance_mpa * PA_PER_MPA
    sustained = rules.sustained_pressure_tolerance_mpa * PA_PER_MPA
    free = np.inf
    return np.array([position, free, pressure, pressure, free, free, step, step, free, free, sustained, sustained])


def as_dict(replay: Replay) -> dict:
    """The replay as plain JSON values."""
    exact = replay.exact
    table = {
        "log": str(replay.path),
        "profile": replay.facts.profile_name,
        "exit_code": replay.exit_code,
        "exact": None
        if exact is None
        else {
            **asdict(exact),
            "identical": exact.identical,
            "speed_factor": exact.speed_factor,
            "processor_factor": exact.processor_factor,
        },
        "dae": [
            {
                "axis": axis.axis,
                "ticks": len(axis.tick),
                "errors": [asdict(figure) for figure in axis.figures],
                "out_of_tolerance_ticks": axis.out_of_tolerance,
                "first_out_tick": axis.first_out_tick,
                "training_range": [
                    {
                        "network": place.network,
                        "input": place.name,
                        "low": place.low,
                        "high": place.high,
                        "at_worst": place.at_worst,
                        "share_at_worst": place.share_at_worst,
                    }
                    for place in axis.places
                ],
                "simulated_s": axis.simulated_s,
                "ida_wall_s": axis.ida_wall_s,
                "ida_speed_factor": speed(axis.simulated_s, axis.ida_wall_s),
                "reference_wall_s": axis.reference_wall_s,
                "reference_speed_factor": speed(axis.simulated_s, axis.reference_wall_s),
                "notes": list(axis.notes),
            }
            for axis in replay.axes
        ],
        "notes": list(replay.notes),
    }
    return finite(table)


def speed(simulated_s: float, wall_s: float) -> float:
    """Times faster than real time."""
    return simulated_s / wall_s if wall_s > 0 else float("inf")
