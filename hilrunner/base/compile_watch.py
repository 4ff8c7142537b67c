"""What is being compiled, for whoever wants to tell it. Known without numba: a listener is there before anything heavy is imported."""

from collections.abc import Callable

# each is called with (name, True) before a function of ours is compiled, and with (name, False) after it; on any thread
observers: list[Callable[[str, bool], None]] = []
defined_names: set[str] = set()  # every function that would be compiled if it were called


def name_of(function) -> str:
    """Room, file and name, as a person is told: `plant.rk4.integrate`."""
    return f"{function.__module__.removeprefix('hilrunner.')}.{function.__name__}"
