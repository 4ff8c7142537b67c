"""The processor's own counter, for hosts where asking the kernel for the time is dear (no vDSO: user-mode kernels, some hypervisors).

x86-64 only, and only after `calibrate` has found the counter to run at one constant rate against CLOCK_MONOTONIC. Elsewhere the
loop asks the kernel each time.
"""

import platform
import time

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

from hilrunner.base.compiled import entry

SCALE_BITS = 32  # fixed point of the rate: ns = cycles * rate >> SCALE_BITS
_CALIBRATION_S = 0.02
_RATE_TOLERANCE = 2e-4


def read_cycles():
    """The cycle counter; without the compiler, the clock it stands for."""
    return time.monotonic_ns()


@intrinsic
def _read_cycles(typing_context):
    def codegen(context, builder, signature, args):
        kind = ir.FunctionType(ir.IntType(64), [])
        return builder.call(builder.module.declare_intrinsic("llvm.readcyclecounter", fnty=kind), [])

    return types.int64(), codegen


@overload(read_cycles)
def _read_cycles_compiled():
    return lambda: _read_cycles()


@entry
def _counter():
    return read_cycles()


def _pair() -> tuple[int, int]:
    """Cycle counter and CLOCK_MONOTONIC of one moment: of several tries the one with the closest readings around it."""
    best = (1 << 62, 0, 0)
    for _ in range(8):
        before = _counter()
        mono_ns = time.monotonic_ns()
        after = _counter()
        best = min(best, (after - before, (before + after) // 2, mono_ns))
    return best[1], best[2]


def calibrate() -> int:
    """ns per cycle in fixed point, int; 0 where the counter cannot be used."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return 0
    rates = []
    for _ in range(2):
        cycles, mono_ns = _pair()
        time.sleep(_CALIBRATION_S)
        cycles_after, mono_after_ns = _pair()
        if cycles_after <= cycles:
            return 0
        rates.append((mono_after_ns - mono_ns) / (cycles_after - cycles))
    if abs(rates[0] - rates[1]) > _RATE_TOLERANCE * rates[0]:
        return 0
    return int(np.mean(rates) * (1 << SCALE_BITS))
