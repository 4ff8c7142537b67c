"""One profile tried: it loads and its bench runs, or it is refused in one line."""

import numpy as np

from hilrunner.base import records, status
from hilrunner.base.errors import HilrunnerError
from hilrunner.realtime.cycle import run_offline
from hilrunner.setup.arm import arm_offline
from hilrunner.setup.axes import reference_plants
from hilrunner.setup.profile import LoadedProfile, parse_profile

TICKS = 20
RAN, LEFT_THE_NUMBERS, REFUSED_AT_READING, REFUSED_AT_BUILDING = (
    "ran",
    "left the numbers",
    "refused",
    "refused when built",
)


def tried(text: str, folder) -> tuple[str, str]:
    """(outcome, the line that refuses); what a profile must not do is raised as AssertionError or as it is."""
    try:
        profile = parse_profile(text, "p.toml")
    except HilrunnerError as error:
        return REFUSED_AT_READING, _one_line(error)
    loaded = LoadedProfile(profile=profile, path=folder / "p.toml", text=text)
    try:
        armed = arm_offline(loaded, status.ENGINE_REFERENCE, _stimulus(profile))
        reference_plants(loaded)
    except HilrunnerError as error:
        return REFUSED_AT_BUILDING, _one_line(error)
    axes = len(profile.axis)
    command = records.allocate(records.COMMAND, TICKS * axes).reshape(TICKS, axes)
    state = records.allocate(records.STATE, TICKS * axes).reshape(TICKS, axes)
    ones = np.ones(TICKS, np.int64)
    frames, sizes = np.zeros((0, 72), np.uint8), np.zeros(0, np.int64)
    done = run_offline(
        armed.bench,
        np.arange(TICKS),
        ones,
        0 * ones,
        0 * ones,
        frames,
        sizes,
        np.zeros(TICKS + 1, np.int64),
        command,
        state,
    )
    return (RAN if done == TICKS else LEFT_THE_NUMBERS), ""


def _stimulus(profile) -> np.ndarray:
    """Up, down, up: every valve of the circuit works."""
    return np.repeat(np.where(np.arange(TICKS) % 10 < 5, 1.0, -1.0)[:, None], len(profile.axis), axis=1)


def _one_line(error: HilrunnerError) -> str:
    text = str(error)
    assert error.exit_code == 2 and len(text) < 4000, text[:5000]
    assert error.place and error.problem, repr(error)
    return text
