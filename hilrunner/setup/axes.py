"""From a checked profile to the plants of its axes: units become SI here, files are found, models are loaded."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hilrunner.base import status
from hilrunner.base.errors import ProfileError, StateError, UsageError
from hilrunner.base.units import M_PER_MM, N_PER_KN, NS_PER_US
from hilrunner.plant import load as plant_load
from hilrunner.plant import wave as plant_wave
from hilrunner.plant.parameters import make_parameters
from hilrunner.plant.step import AxisPlant, initial_state
from hilrunner.setup.profile import Axis, Load, LoadedProfile
from hilrunner.setup.stability_store import stored_stability_limit_s, stored_substep_count

# RK4 this fine is within 1e-6 MPa and 1e-6 mm of IDA on every run of tools/certify_plant; the loop's own step, as long as
# stability allows, is not on `lift` (docs/plant.md)
TRUTH_STEP_S = 50e-6
SUBSTEPS_MAX = (
    25_000  # RK4 steps a period: some 10 ms of processor time, and the truth's own step in the longest period
)
# the first status.PLANT_EQUATIONS with
_EQUATIONS_WITH_VOID = 2
_EQUATIONS_WITH_HANDOVER = 2


def period_s(loaded: LoadedProfile) -> float:
    """Loop period, s."""
    return loaded.profile.bench.period_us * 1e-6


def check_duration(duration_s: float | None, loaded: LoadedProfile) -> None:
    """Refuse a --duration in which no period fits; UsageError."""
    if duration_s is None or duration_s >= period_s(loaded):
        return
    raise UsageError(
        "--duration",
        f"{duration_s:g} s is shorter than one period",
        f"at least {period_s(loaded):g} s (the period is {loaded.profile.bench.period_us} us)",
        "raise it, or leave it out",
    )


def engine_named(loaded: LoadedProfile, asked: str | None) -> int:
    """status.ENGINE_* of the name a command was given, or of the profile's own."""
    return status.ENGINE_NAMES.index(asked or loaded.profile.bench.engine)


@dataclass(frozen=True)
class AxisSet:
    """Everything about the axes of one bench that is built once."""

    plants: list[AxisPlant]
    waves: list[np.ndarray]  # heave components
    initial_states: np.ndarray  # float64[axis, STATE_SIZE], valve neutral
    model_reports: list[Any]  # how each trained model was understood


def build_axes(loaded: LoadedProfile, engine: int) -> AxisSet:
    """Plants, waves and consistent initial states of a profile for one engine; errors as in `make_axis_plants`."""
    reports: list[Any] = []
    plants = make_axis_plants(loaded, engine, reports)
    waves = make_waves(loaded)
    return AxisSet(plants, waves, initial_states(loaded, plants, waves), reports)


def make_axis_plants(loaded: LoadedProfile, engine: int, understood: list | None = None) -> list[AxisPlant]:
    """The plants of a profile's axes for one engine.

    Args:
        engine: status.ENGINE_*.
        understood: if given, the ModelReport of every loaded model is appended.

    Raises:
        ProfileError: parameters, load or substeps are impossible. ModelError: the trained model is refused.
    """
    return [_axis_plant(loaded, index, engine, understood) for index in range(len(loaded.profile.axis))]


def reference_plants(loaded: LoadedProfile, engine: int = status.ENGINE_SURROGATE) -> list[AxisPlant]:
    """The first-principle plants beside the run's, in steps fine enough to judge it: cross-check and replay.

    A surrogate is judged by the whole model, even where the profile's own reference leaves out the mass of the spools.
    """
    plants, period = make_axis_plants(loaded, status.ENGINE_REFERENCE), period_s(loaded)
    if engine != status.ENGINE_REFERENCE and loaded.plant_equations >= _EQUATIONS_WITH_HANDOVER:
        plants = [_with_spool_mass(plant) for plant in plants]
    judges = []
    for index, plant in enumerate(plants):
        count = truth_substep_count(plant, period)
        judges.append(replace(plant, substep_count=_runnable(count, period, f"{loaded.path}: axis[{index}]")))
    return judges


def truth_substep_count(plant: AxisPlant, period: float) -> int:
    """RK4 steps a period (s) of a reference that judges others: at least the plant's own, none above TRUTH_STEP_S."""
    stable = plant.substep_count or stored_substep_count(plant, period)
    return max(stable, math.ceil(period / TRUTH_STEP_S - 1e-9))


def initial_states(loaded: LoadedProfile, plants: list[AxisPlant], waves: list[np.ndarray]) -> np.ndarray:
    """Consistent states before the first tick, valve neutral: float64[axis, STATE_SIZE]."""
    rows = []
    for index, (axis, plant, wave) in enumerate(zip(loaded.profile.axis, plants, waves, strict=True)):
        scale = plant_wave.load_scale_series(wave, np.zeros(1))[0]
        try:
            rows.append(initial_state(plant, axis.initial_position_mm * M_PER_MM, 0.0, float(scale)))
        except StateError as error:
            place = f"{loaded.path}: axis[{index}]: {error.place}"
            raise StateError(place, error.problem, error.limit, error.remedy) from error
    return np.array(rows)


def make_waves(loaded: LoadedProfile) -> list[np.ndarray]:
    """Heave components of every axis; an empty array where the profile has no wave."""
    waves = []
    for axis in loaded.profile.axis:
        if axis.wave is None:
            waves.append(plant_wave.no_heave())
        else:
            waves.append(
                plant_wave.heave_components(axis.wave.significant_height_m, axis.wave.peak_period_s, axis.wave.seed)
            )
    return waves


def _axis_plant(loaded: LoadedProfile, index: int, engine: int, understood: list | None) -> AxisPlant:
    axis = loaded.profile.axis[index]
    place = f"{loaded.path}: axis[{index}]"
    try:
        parameters = make_parameters(axis.preset, _constants(loaded, axis))
    except ProfileError as error:
        raise ProfileError(f"{place}.{error.place}", error.problem, error.limit, error.remedy) from error
    plant = AxisPlant(
        circuit=status.CIRCUIT_NAMES.index(axis.circuit),
        engine=engine,
        fast=axis.reference == "fast",
        parameters=parameters,
        load=_placed_load(axis.load, f"{place}.load"),
        substep_count=1,
        networks=None,
        position_range_m=_position_range_m(axis),
    )
    if engine != status.ENGINE_REFERENCE:
        networks = _networks(loaded, axis, place, engine, parameters, understood)
        plant = replace(plant, networks=networks, exact_substep_count=_exact_substeps(loaded, axis, plant, place))
    return replace(plant, substep_count=_substeps(loaded, axis, plant, place))


def _constants(loaded: LoadedProfile, axis: Axis) -> dict[str, float]:
    """The profile's own constants, with none of what came after the equations of the log they were read from."""
    return dict(axis.parameters) | ({"void_mpa": 0.0} if loaded.plant_equations < _EQUATIONS_WITH_VOID else {})


def _exact_substeps(loaded: LoadedProfile, axis: Axis, plant: AxisPlant, place: str) -> int:
    """RK4 steps of the periods a surrogate hands over: as fine as the reference that judges it; 0: it hands none over."""
    if loaded.plant_equations < _EQUATIONS_WITH_HANDOVER:
        return 0
    exact = replace(plant, engine=status.ENGINE_REFERENCE, substep_count=axis.reference_substeps)
    count = truth_substep_count(_with_spool_mass(exact), period_s(loaded))
    return _runnable(count, period_s(loaded), place)


def _with_spool_mass(plant: AxisPlant) -> AxisPlant:
    """The whole model of a first-principle plant; the fast one's own count of steps does not hold for it."""
    return replace(plant, fast=False, substep_count=0) if plant.fast else plant


def _position_range_m(axis: Axis) -> tuple[float, float] | None:
    if axis.position_range_mm is None:
        return None
    low, high = axis.position_range_mm
    return low * M_PER_MM, high * M_PER_MM


def _networks(loaded: LoadedProfile, axis: Axis, place: str, engine: int, parameters, understood: list | None):
    from hilrunner.setup.model import load_model
    from hilrunner.setup.parcel import read_model

    if axis.model is None:
        raise ProfileError(
            f"{place}.model",
            "missing",
            remedy='name a trained model, or the first-principle model by engine = "reference" under [bench] or by --engine reference',
        )
    networks, report = load_model(
        read_model(loaded, axis.model),
        circuit=axis.circuit,
        parameters=parameters,
        in_loop=engine == status.ENGINE_ONNX,
        description=axis.network or None,
    )
    if understood is not None:
        understood.append(report)
    return networks


def _substeps(loaded: LoadedProfile, axis: Axis, plant: AxisPlant, place: str) -> int:
    """Chosen substeps, or the profile's, refused when RK4 would be unstable with them or when no period could hold them."""
    period = period_s(loaded)
    surrogate = plant.engine != status.ENGINE_REFERENCE
    wanted = axis.surrogate_substeps if surrogate else axis.reference_substeps
    limit_s = _stability_limit_s(plant, place)
    if wanted == 0:
        return _runnable(stored_substep_count(plant, period), period, place)
    if period / wanted > limit_s:
        key = "surrogate_substeps" if surrogate else "reference_substeps"
        raise ProfileError(
            f"{place}.{key}",
            f"{wanted} substeps of {period / wanted * 1e6:.3g} us are unstable for RK4",
            limit=f"steps up to {limit_s * 1e6:.3g} us, so at least {int(np.ceil(period / limit_s))} substeps",
            remedy="raise it, or 0 to let hilrunner choose",
        )
    return wanted


def _stability_limit_s(plant: AxisPlant, place: str) -> float:
    try:
        limit_s = stored_stability_limit_s(plant)
    except (np.linalg.LinAlgError, ValueError, ZeroDivisionError, OverflowError):
        limit_s = 0.0
    if not limit_s > _SHORTEST_STEP_S:
        raise ProfileError(
            place, f"RK4 is stable up to {limit_s:.1e} s only", f"at least {_SHORTEST_STEP_S:g} s", _SOFTER
        )
    return limit_s


def _runnable(count: int, period: float, place: str) -> int:
    if count <= SUBSTEPS_MAX:
        return count
    raise ProfileError(
        place,
        f"needs {count} RK4 steps of {period / count * 1e6:.2g} us in each period of {period * 1e6:g} us to be stable",
        f"at most {SUBSTEPS_MAX}",
        _SOFTER,
    )


_SHORTEST_STEP_S = 1e-12
_SOFTER = (
    "soften the stiffest part (small dead or line volumes on large areas, small masses on stiff stops, a large bulk modulus), "
    "or shorten the period"
)


def _placed_load(load: Load, place: str) -> plant_load.LoadTable:
    try:
        return _load_table(load)
    except ProfileError as error:
        raise ProfileError(f"{place}: {error.place}", error.problem, error.limit, error.remedy) from error


def _load_table(load: Load) -> plant_load.LoadTable:
    if load.kind == "constant":
        table = plant_load.constant(load.force_kn * N_PER_KN)
    elif load.kind == "table":
        table = plant_load.from_table(np.array(load.position_mm) * M_PER_MM, np.array(load.table_force_kn) * N_PER_KN)
    else:
        table = plant_load.knuckle_boom(with_mass=load.equivalent_mass)
    if load.perturbation_std_ratio > 0:
        table = plant_load.perturbed(table, load.perturbation_std_ratio, load.perturbation_seed)
    return table


def period_ns(loaded: LoadedProfile) -> int:
    """Loop period, ns."""
    return loaded.profile.bench.period_us * NS_PER_US
