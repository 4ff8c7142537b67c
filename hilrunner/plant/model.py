"""What a plant is made of: one description an axis (cold), and all axes in flat arrays (hot, constant after arming)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from hilrunner.base import status
from hilrunner.base.errors import ProfileError
from hilrunner.plant.load import LoadTable
from hilrunner.plant.network import NetworkBank, assemble_bank
from hilrunner.plant.stability import default_substep_count

SCRATCH_SIZE = 256  # float64; what a network or a solver needs within one period


@dataclass(frozen=True, eq=False)
class AxisPlant:
    """One actuator, cold.

    Args:
        circuit: status.CIRCUIT_*.
        parameters: (1,) PARAMETERS record array.
        load: static load and its inertia over the rod position.
        engine: status.ENGINE_*.
        fast: reference engine with spools without mass (fewer, larger steps).
        substep_count: integrator steps a period; 0: chosen from the stability limit when assembled with a period.
        exact_substep_count: for engines surrogate and onnx: steps of the exact engine in the periods that the surrogate hands over
            (plant.handover); 0: it hands none over.
        networks: for engines surrogate and onnx.
        position_range_m: where the rod is meant to move; None: the whole stroke. Stability is judged there.
    """

    circuit: int
    parameters: np.ndarray
    load: LoadTable
    engine: int = status.ENGINE_REFERENCE
    fast: bool = False
    substep_count: int = 0
    exact_substep_count: int = 0
    networks: Any = None
    position_range_m: tuple[float, float] | None = field(default=None)

    @property
    def position_limits_m(self) -> tuple[float, float]:
        """The range of positions that counts; m."""
        return self.position_range_m or (0.0, float(self.parameters["stroke_m"][0]))


class PlantModel(NamedTuple):
    """Every axis; arrays have a leading axis dimension and are read-only."""

    parameters: np.ndarray  # (axes,) PARAMETERS
    circuit: np.ndarray  # (axes,) int64 status.CIRCUIT_*
    engine: np.ndarray  # (axes,) int64 status.ENGINE_*
    fast: np.ndarray  # (axes,) bool: spools without mass in the reference engine
    substep_count: np.ndarray  # (axes,) int64
    exact_substep_count: np.ndarray  # (axes,) int64; 0: no period is handed over to the exact engine
    load: np.ndarray  # (axes,) plant.load.LOAD
    network: NetworkBank


def assemble(axes: Sequence[AxisPlant], period_s: float = 1e-3) -> PlantModel:
    """Lay all axes out for the loop and freeze them.

    Args:
        axes: one or more; a substep_count of 0 becomes default_substep_count(axis, period_s).

    Raises:
        ProfileError: no axis, or an end stop so soft that a stalled cylinder would empty its dead volume.
    """
    if not axes:
        raise ProfileError("plant", "no axis", "one or more")
    for index, axis in enumerate(axes):
        _check_end_stops(axis, index)
    model = PlantModel(
        parameters=np.concatenate([axis.parameters for axis in axes]),
        circuit=np.array([axis.circuit for axis in axes], np.int64),
        engine=np.array([axis.engine for axis in axes], np.int64),
        fast=np.array([axis.fast for axis in axes], np.bool_),
        substep_count=np.array(
            [axis.substep_count or default_substep_count(axis, period_s) for axis in axes], np.int64
        ),
        exact_substep_count=np.array([axis.exact_substep_count for axis in axes], np.int64),
        load=np.concatenate([axis.load.record() for axis in axes]),
        network=assemble_bank([axis.networks for axis in axes]),
    )
    for array in model[:-1]:
        array.flags.writeable = False
    return model


def _check_end_stops(axis: AxisPlant, index: int) -> None:
    prm = axis.parameters[0]
    low, high = axis.position_limits_m
    for at_end, area, dead, name in (
        (low <= 0.0, "rod_side_area_m2", "dead_volume_1_m3", "dead_volume_1_mm3"),
        (high >= prm["stroke_m"], "bore_area_m2", "dead_volume_2_m3", "dead_volume_2_mm3"),
    ):
        penetration = prm[area] * prm["supply_pressure_pa"] / prm["end_stop_stiffness_npm"]
        lost = penetration * (prm["bore_area_m2"] if dead == "dead_volume_1_m3" else prm["rod_side_area_m2"])
        if at_end and lost > 0.5 * prm[dead]:
            raise ProfileError(
                f"axis {index}: parameter '{name}'",
                f"{prm[dead] * 1e9:g} mm3 is emptied by the {penetration * 1e3:.2g} mm a stalled rod presses into its stop",
                f"at least {2e9 * lost:.0f} mm3, or a position range that keeps away from this end",
                "enlarge it, stiffen end_stop_stiffness_npmm, or narrow the position range",
            )
