"""The log of a run in the place of a profile or a stimulus: that is how a failed case is run again."""

from pathlib import Path

from hilrunner.base.errors import LogError, UsageError
from hilrunner.setup.axes import period_s
from hilrunner.setup.profile import LoadedProfile, load_profile
from hilrunner.setup.stimulus import Stimulus, read_stimulus
from hilrunner.setup.stimulus_facts import StimulusFacts

_LOG_MAGIC = b"\x89MCAP0\r\n"


def is_log(name: str) -> bool:
    """Whether a name on the command line is that of a log: by its first bytes, or a file called .mcap."""
    path = Path(name)
    try:
        if not path.is_file():
            return False
        with open(path, "rb") as file:
            return file.read(len(_LOG_MAGIC)) == _LOG_MAGIC or path.suffix.lower() == ".mcap"
    except (OSError, ValueError):
        return False


def load_again(name: str) -> LoadedProfile:
    """A profile by name or file, or that of a log with its DBC and models out of the log; HilrunnerError."""
    if not is_log(name):
        return load_profile(name)
    from hilrunner.evidence.rebuild import sealed_profile

    return sealed_profile(_whole(name, columns={}))


def stimulus_named(
    name: str, loaded: LoadedProfile, duration_s: float | None = None, channel: str | None = None
) -> Stimulus:
    """Valve commands for every tick from a schedule, a CAN log, or the log of a run; HilrunnerError."""
    if not is_log(name):
        return read_stimulus(name, loaded, duration_s, channel or loaded.profile.stimulus.channel)
    from hilrunner.evidence.rerun import commands_again

    commands = commands_again(_whole(name), loaded, duration_s)
    span_s = len(commands) * period_s(loaded)
    return Stimulus(commands, StimulusFacts(name, "log of a run", span_s, len(commands)))


def _whole(name: str, columns: dict | None = None):
    """A log whose parts are what they were when it was written; what was changed since would be run as if it were evidence."""
    import hashlib

    from hilrunner.evidence.reader import read_run

    run = read_run(name, columns)
    told = run.metadata.get("run", {})
    for attached, one in run.attachments.items():
        hashed = told.get(f"sha256:{attached}")
        if hashed is not None and hashed != hashlib.sha256(one.data).hexdigest():
            raise LogError(
                name, f"its '{attached}' is not what was recorded (sha256 differs)", remedy="name a whole log"
            )
    if not run.attachments:
        raise UsageError(name, "holds no profile and no commands", remedy="name the log of a run")
    return run
