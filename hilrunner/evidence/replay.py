"""A replay of a run: bit-exact first, then the full model beside it; text, JSON, HTML and a log are views of it."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from hilrunner.base import exit_codes
from hilrunner.base.errors import HilrunnerError, LogError
from hilrunner.base.units import M_PER_MM, PA_PER_MPA
from hilrunner.evidence.coverage import coverage_sentences
from hilrunner.evidence.damaged import DamagedLogError
from hilrunner.evidence.facts import RunFacts, read_facts
from hilrunner.evidence.judging import verdict_of
from hilrunner.evidence.reader import Run, read_run
from hilrunner.evidence.rebuild import engine_of, known_stimulus, unpacked_profile
from hilrunner.evidence.replay_dae import IDA_RTOL, AxisDae, replay_dae
from hilrunner.evidence.replay_exact import ExactReplay, exact_sentence, replay_exact
from hilrunner.evidence.report import finite
from hilrunner.evidence.verdict import Judgement, Verdict, said
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
    verdict: Verdict  # of the run, as a report has it, and of the replay

    @property
    def exit_code(self) -> int:
        """The verdict's."""
        return self.verdict.exit_code


@np.errstate(all="ignore")  # a damaged log holds numbers of any size: what comes of them is shown, not warned of
def build_replay(path: str | Path, options: ReplayOptions, progress: Progress = lambda what, share: None) -> Replay:
    """Read a run and replay it.

    Raises LogError when the log cannot be read or lacks what a replay needs; ProfileError, ModelError, DbcError when this
    version refuses what the log carries; UsageError for a duration without a period; StateError when the full model has no consistent start.
    DamagedLogError in place of any of these where the log does not match its own checksums.
    """
    run = read_run(path)
    try:
        return _built(path, run, options, progress)
    except HilrunnerError as error:
        if run.mismatches:
            raise DamagedLogError(
                str(path), f"damaged, and it cannot be replayed: {run.mismatches[0]}; {error}"
            ) from None
        raise


def _built(path: str | Path, run: Run, options: ReplayOptions, progress: Progress) -> Replay:
    if not len(run.tick) or not run.axis_names:
        raise LogError(
            str(path), "holds no ticks with states, so there is nothing to replay", remedy="replay a log of `run`"
        )
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
        verdict, coverage = verdict_of(run, facts)
        return Replay(
            path=Path(path),
            run=run,
            facts=facts,
            exact=exact,
            axes=axes,
            tolerance=loaded.profile.crosscheck,
            perturbed_load=any(axis.load.perturbation_std_ratio > 0 for axis in loaded.profile.axis),
            notes=(*coverage_sentences(coverage), *facts.notes, *run.damage),
            verdict=verdict.joined(_replayed(exact, axes)),
        )


def _replayed(exact: ExactReplay | None, axes: list[AxisDae]) -> list[Judgement]:
    """What the replay itself says of the run."""
    judged = []
    if exact is not None:
        doc, detail = "the replay is the run, bit for bit", exact_sentence(exact)
        judged.append(said("bit_exact", doc, exact.identical, detail))
    for axis in axes:
        doc = f"axis {axis.axis} stays within the tolerance around the full model"
        detail = f"{axis.out_of_tolerance} of {len(axis.tick)} ticks out of tolerance"
        judged.append(said("full_model", doc, not axis.out_of_tolerance, detail, exit_codes.CROSS_CHECK_FAILED))
    return judged


def _check_axes(run: Run, loaded: LoadedProfile) -> None:
    names = tuple(axis.name for axis in loaded.profile.axis)
    if set(names) != set(run.axis_names):
        raise LogError(str(run.path), f"axes {', '.join(run.axis_names)} are not the profile's ({', '.join(names)})")


def _dae(run: Run, loaded: LoadedProfile, engine: int, options: ReplayOptions, progress: Progress) -> list[AxisDae]:
    built, plants = build_axes(loaded, engine), reference_plants(loaded, engine)
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
        "verdict": replay.verdict.as_dict(),
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
