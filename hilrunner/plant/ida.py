"""Offline truth: SUNDIALS IDA on the residual, everything compiled.

The IDA library is the one scikit-sundae brings; its C functions are called from compiled code and call compiled
residuals back, so that a command which changes every millisecond (IDA restarts at each change) still runs faster than
real time. Reference: Hindmarsh et al., SUNDIALS, ACM TOMS 31(3), 2005.
"""

import ctypes
import time
from collections.abc import Callable

import numpy as np

from hilrunner.base.errors import StateError
from hilrunner.plant.ida_library import ida_library
from hilrunner.plant.residual import ALGEBRAIC_COUNT, PLANT_INPUT, UNKNOWNS

_CHUNK_PERIODS = 250  # at most, between two calls of the progress function
_CHUNK_S = 0.1  # compiled code hears no Ctrl-C: what takes longer is done in smaller pieces
# absolute tolerance = rtol times these, by place of base.state_layout: m, m/s, Pa, spools
_SCALE = np.array([1e-1, 1e-2, 1e5, 1e5, 1e-3, 1e-3, 1e-2, 1e-2, 1e5, 1e5])
_MAX_STEPS = 1_000_000
IDA_FAILED = -1


class IdaSolver:
    """One IDA instance over one axis' residual; owns the C objects and frees them.

    Args:
        axis_plant: plant.model.AxisPlant; `fast` and `engine` are ignored: the full model is solved.
        rtol: relative tolerance; absolute ones follow from it.
    """

    def __init__(self, axis_plant, rtol: float = 1e-9) -> None:
        library = ida_library()
        from hilrunner.plant import ida_calls  # compiled against the library: it must be loaded before

        self._library = library
        self.places = np.array(UNKNOWNS[axis_plant.circuit])
        count = len(self.places)
        self.plant = np.zeros(1, PLANT_INPUT)
        self.plant["circuit"] = axis_plant.circuit
        self.plant["parameters"] = axis_plant.parameters[0]
        self.plant["load"] = axis_plant.load.record()[0]
        self._context = ctypes.c_void_p()
        self._check(library.SUNContext_Create(0, ctypes.byref(self._context)), "SUNContext_Create")
        library.SUNContext_ClearErrHandlers(self._context)  # IDA prints to stderr otherwise; failures are raised here
        self._vectors = [library.N_VNew_Serial(count, self._context) for _ in range(4)]
        views = [_view(library.N_VGetArrayPointer(vector), count) for vector in self._vectors]
        self.y, self.dy, tolerance, is_differential = views
        for view in views:
            view[:] = 0.0
        tolerance[:] = rtol * _SCALE[self.places]
        is_differential[:] = 1.0
        is_differential[count - ALGEBRAIC_COUNT[axis_plant.circuit] :] = 0.0
        self.memory = ctypes.c_void_p(library.IDACreate(self._context))
        y, dy, tolerances, kinds = self._vectors
        callback = ida_calls.residual_callback.address
        self._check(library.IDAInit(self.memory, callback, 0.0, y, dy), "IDAInit")
        self._check(library.IDASetUserData(self.memory, self.plant.ctypes.data), "IDASetUserData")
        self._check(library.IDASVtolerances(self.memory, rtol, tolerances), "IDASVtolerances")
        self._check(library.IDASetId(self.memory, kinds), "IDASetId")
        self._matrix = library.SUNDenseMatrix(count, count, self._context)
        self._solver = library.SUNLinSol_Dense(y, self._matrix, self._context)
        self._check(library.IDASetLinearSolver(self.memory, self._solver, self._matrix), "IDASetLinearSolver")
        self._check(library.IDASetMaxNumSteps(self.memory, _MAX_STEPS), "IDASetMaxNumSteps")
        self._check(library.IDASetMaxErrTestFails(self.memory, 50), "IDASetMaxErrTestFails")
        self._check(library.IDASetMaxConvFails(self.memory, 50), "IDASetMaxConvFails")

    @staticmethod
    def _check(code: int, name: str) -> None:
        if code < 0:
            raise StateError("IDA", f"{name} failed with code {code}", remedy="report it with the profile")

    def run(self, valve_commands, load_scales, period_s: float, state: np.ndarray, states_out, progress=None) -> int:
        """Solve n periods with inputs held over each; returns how many were solved (n, or fewer where IDA gave up).

        Args:
            valve_commands, load_scales: (n,) float64.
            state: (10,) float64, start; not written.
            states_out: (n, 10) float64, state at the end of each period.
            progress: called with the number of periods done.
        """
        from hilrunner.plant.ida_calls import drive

        total = len(valve_commands)
        done, chunk = 0, 1
        self.y[:] = state[self.places]
        elapsed_s = 0.0
        while done < total:
            last = min(done + chunk, total)
            begin_s = time.perf_counter()
            reached, elapsed_s = drive(
                self.memory.value, self._vectors[0], self._vectors[1], self.y, self.dy, self.plant, self.places,
                valve_commands, load_scales, period_s, done, last, elapsed_s, states_out,
            )  # fmt: skip
            done = reached
            quick = time.perf_counter() - begin_s < _CHUNK_S
            chunk = min(2 * chunk, _CHUNK_PERIODS) if quick else max(1, chunk // 2)
            if progress is not None:
                progress(done)
            if reached < last:
                break
        return done

    def step_count(self) -> int:
        """Internal steps since the last restart."""
        value = ctypes.c_long()
        self._library.IDAGetNumSteps(self.memory, ctypes.byref(value))
        return value.value

    def close(self) -> None:
        """Free the C objects."""
        if self._context.value is None:
            return
        library = self._library
        library.IDAFree(ctypes.byref(self.memory))
        library.SUNLinSolFree(self._solver)
        library.SUNMatDestroy(self._matrix)
        for vector in self._vectors:
            library.N_VDestroy(vector)
        library.SUNContext_Free(ctypes.byref(self._context))
        self._context.value = None

    def __enter__(self) -> "IdaSolver":
        return self

    def __exit__(self, *_) -> None:
        self.close()


def _view(address: int, count: int) -> np.ndarray:
    return np.ctypeslib.as_array(ctypes.cast(address, ctypes.POINTER(ctypes.c_double)), (count,))


def solve_ida(
    axis_plant,
    valve_commands: np.ndarray,
    load_scales: np.ndarray,
    period_s: float,
    state0: np.ndarray,
    rtol: float = 1e-9,
    progress: Callable[[int], None] | None = None,
) -> np.ndarray:
    """The full model solved by IDA, inputs held over each period.

    Args:
        axis_plant: plant.model.AxisPlant.
        valve_commands, load_scales: (n,) float64.
        period_s: length of a period.
        state0: (10,) float64, base.state_layout; algebraic places are made consistent.
        rtol: 1e-6 to 1e-12; 1e-11 certifies.
        progress: called now and then with the number of periods done.

    Returns:
        (n, 10) float64, state at the end of each period.

    Raises:
        StateError: IDA gave up, with the time and what it was fed.
    """
    commands = np.ascontiguousarray(valve_commands, dtype=np.float64)
    scales = np.ascontiguousarray(load_scales, dtype=np.float64)
    states = np.zeros((len(commands), 10))
    with IdaSolver(axis_plant, rtol) as solver:
        done = solver.run(commands, scales, float(period_s), np.asarray(state0, dtype=np.float64), states, progress)
    if done < len(commands):
        raise StateError(
            f"IDA at {done * period_s:.4f} s",
            f"gave up with command {commands[done]:g} and load factor {scales[done]:g}",
            remedy="a larger rtol, or a plant nearer to what it is meant for",
        )
    return states
