"""The C library of IDA that scikit-sundae brings, found where it is loaded and declared for ctypes."""

import ctypes
from functools import lru_cache

from hilrunner.base.errors import UsageError


@lru_cache(maxsize=1)
def ida_library() -> ctypes.CDLL:
    """The shared library of IDA that scikit-sundae has loaded, its symbols made visible to compiled code."""
    import sksundae.ida  # noqa: F401  (loads the library)

    _make_visible("libsundials_core")
    library = _make_visible("libsundials_ida")
    _declare(library)
    return library


def _make_visible(name: str) -> ctypes.CDLL:
    """Open a library that is already loaded once more, for all to see."""
    with open("/proc/self/maps") as maps:
        paths = {line.split()[-1] for line in maps if name in line}
    if not paths:
        raise UsageError("IDA", f"scikit-sundae has loaded no {name}", remedy="reinstall scikit-sundae >= 1.1")
    return ctypes.CDLL(paths.pop(), mode=ctypes.RTLD_GLOBAL)


def _declare(library: ctypes.CDLL) -> None:
    pointer, number, integer = ctypes.c_void_p, ctypes.c_double, ctypes.c_int
    results = {
        "SUNContext_Create": (integer, [integer, ctypes.POINTER(pointer)]),
        "SUNContext_Free": (integer, [ctypes.POINTER(pointer)]),
        "SUNContext_ClearErrHandlers": (integer, [pointer]),
        "N_VNew_Serial": (pointer, [ctypes.c_int64, pointer]),
        "N_VGetArrayPointer": (pointer, [pointer]),
        "N_VDestroy": (None, [pointer]),
        "SUNDenseMatrix": (pointer, [ctypes.c_int64, ctypes.c_int64, pointer]),
        "SUNMatDestroy": (None, [pointer]),
        "SUNLinSol_Dense": (pointer, [pointer, pointer, pointer]),
        "SUNLinSolFree": (integer, [pointer]),
        "IDACreate": (pointer, [pointer]),
        "IDAFree": (None, [ctypes.POINTER(pointer)]),
        "IDAInit": (integer, [pointer, pointer, number, pointer, pointer]),
        "IDASetUserData": (integer, [pointer, pointer]),
        "IDASVtolerances": (integer, [pointer, number, pointer]),
        "IDASetId": (integer, [pointer, pointer]),
        "IDASetLinearSolver": (integer, [pointer, pointer, pointer]),
        "IDASetMaxNumSteps": (integer, [pointer, ctypes.c_long]),
        "IDASetMaxErrTestFails": (integer, [pointer, integer]),
        "IDASetMaxConvFails": (integer, [pointer, integer]),
        "IDAGetNumSteps": (integer, [pointer, ctypes.POINTER(ctypes.c_long)]),
        "IDAGetNumResEvals": (integer, [pointer, ctypes.POINTER(ctypes.c_long)]),
    }
    for name, (result, arguments) in results.items():
        function = getattr(library, name)
        function.restype = result
        function.argtypes = arguments
