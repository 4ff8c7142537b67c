"""Compile everything that a run of a profile needs, and keep it: the run after it starts within seconds.

The loop, its plants and networks, the recorder's cross-check, report and replay. Nothing is compiled twice: where everything is there
already this takes a few seconds. No bus is needed, and nothing is written but the cache of compiled code ($HILRUNNER_CACHE).
"""

import argparse
import contextlib
import subprocess
import time
from pathlib import Path

TICKS = 300  # of the short run that ends it
_PATIENCE_S = 3600.0
CHECK = "from hilrunner.commands.warm_up import compile_check; import sys; compile_check(sys.argv[1])"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner warm-up`."""
    parser.add_argument("profile", nargs="?", default="amc-lift", metavar="NAME|FILE", help="default: %(default)s")
    parser.add_argument(
        "--engine", choices=("surrogate", "reference", "onnx"), help="default: the profile's (bench.engine)"
    )


def main(args: argparse.Namespace) -> int:
    """Compile on two cores, then run, report and replay once for a moment, which compiles what is left."""
    import tempfile

    from hilrunner.base.compiled_cache import cache_place
    from hilrunner.setup.axes import engine_named
    from hilrunner.setup.profile import load_profile

    begun_s = time.monotonic()
    loaded = load_profile(args.profile)
    engine = engine_named(loaded, args.engine)
    with tempfile.TemporaryDirectory(prefix="hilrunner-warm-up-") as folder:
        with _compiling_check(args.profile):
            compile_loop(loaded, engine)
        log = Path(folder) / "warm-up.mcap"
        start_up_s = short_run(loaded, engine, log)
        read_back(log)
    took_s = time.monotonic() - begun_s
    print(
        f"{loaded.path}: warm after {took_s:.0f} s; a run starts in {start_up_s:.1f} s; kept in {cache_place().parent}"
    )
    return 0


def compile_loop(loaded, engine: int) -> None:
    """The loop of a run, and the one of `simulate` and `replay`: each over no ticks."""
    from hilrunner.realtime.loop import NO_BUS, run_loop
    from hilrunner.setup.arm import arm_offline

    run_loop(arm_offline(loaded, engine).bench, NO_BUS, 0, 0)


def compile_check(profile: str) -> None:
    """The recorder's cross-check, in a process beside the one that compiles the loop."""
    from hilrunner.record.check_worker import CheckWorker
    from hilrunner.record.config import CheckConfig
    from hilrunner.record.launch import plants_file
    from hilrunner.setup.axes import period_ns, reference_plants
    from hilrunner.setup.profile import load_profile

    loaded = load_profile(profile)
    plants = reference_plants(loaded)
    settings = CheckConfig(plants_file(plants, None), [[0.0] * 10 for _ in plants])
    worker = CheckWorker(settings, [axis.name for axis in loaded.profile.axis], period_ns(loaded))
    worker.finish(_PATIENCE_S)
    if worker.error:
        raise SystemExit(worker.error)


@contextlib.contextmanager
def _compiling_check(profile: str):
    """`compile_check` in another process until the body has ended and it has as well.

    Raises:
        StateError: it could not.
    """
    from hilrunner.base.compile_watch import observers
    from hilrunner.base.errors import StateError
    from hilrunner.record import child

    process = subprocess.Popen(
        child.code_command(CHECK, profile),
        env=child.environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    name = "the cross-check, in another process"
    try:
        yield
        for observer in observers:
            observer(name, True)
        words = process.communicate()[1].decode(errors="replace").strip().splitlines()
        for observer in observers:
            observer(name, False)
        if process.returncode:
            raise StateError("warm-up: the cross-check", words[-1] if words else f"ended with {process.returncode}")
    finally:
        process.kill()
        process.wait()


def short_run(loaded, engine: int, log: Path) -> float:
    """A run of a few ticks without bus and rights; how long its start took, s."""
    import numpy as np

    from hilrunner.setup import host
    from hilrunner.setup.axes import period_s
    from hilrunner.setup.session import RunOptions, Session

    options = RunOptions(
        engine=engine,
        duration_s=TICKS * period_s(loaded),
        log_path=log,
        stimulus=np.zeros((TICKS, len(loaded.profile.axis))),
        realtime=host.RealtimeOptions(priority=0),
    )
    session = Session(loaded, options)
    session.start()
    while session.running(0.05):
        pass
    return session.finish().start_up_s


def read_back(log: Path) -> None:
    """Report and replay of the short run; that a busy host made it unfit for one of them is no failure here."""
    from hilrunner.base.errors import HilrunnerError
    from hilrunner.evidence.replay import ReplayOptions, build_replay
    from hilrunner.evidence.report import build_report

    with contextlib.suppress(HilrunnerError):
        build_report(log)
        build_replay(log, ReplayOptions())
