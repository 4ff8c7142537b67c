"""The plant alone: a valve schedule through the same compiled cycle as the loop, without CAN and without a wall clock."""

import argparse
from pathlib import Path

from hilrunner.commands import options

ENGINES = ("surrogate", "onnx", "reference")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner simulate`."""
    parser.add_argument(
        "--profile", default="amc-lift", metavar="NAME|FILE", help="default: %(default)s; a log: as it ran"
    )
    parser.add_argument(
        "--schedule", metavar="NAME|FILE", help="valve schedule, CAN log, or the log of a run (default: the profile's)"
    )
    options.add_stimulus_channel(parser)
    parser.add_argument("--duration", type=options.seconds, metavar="S", help="default: as long as the schedule")
    parser.add_argument("--engine", choices=ENGINES, help="default: the profile's (bench.engine)")
    parser.add_argument("--compare", choices=ENGINES, metavar="ENGINE", help="a second engine; differences are printed")
    parser.add_argument("--out", type=Path, metavar="RUN.mcap", help="write a log like that of a run")
    parser.add_argument("--overwrite", action="store_true", help="let --out replace a file that exists")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="pressures, position and command as .png or .svg")
    parser.add_argument("--json", action="store_true", help="figures as one JSON object on stdout")


def main(args: argparse.Namespace) -> int:
    """Simulate, compare, write what was asked for; 1 when a state left the finite numbers."""
    import json

    from hilrunner.base import exit_codes, status
    from hilrunner.commands import simulate_output as output
    from hilrunner.commands.again import load_again, stimulus_named
    from hilrunner.commands.targets import check_new_log, check_targets, whole
    from hilrunner.setup.axes import check_duration, engine_named
    from hilrunner.setup.parcel import pack
    from hilrunner.setup.simulate import simulate
    from hilrunner.setup.stimulus import profile_stimulus

    loaded = load_again(args.profile)
    check_duration(args.duration, loaded)
    output.check_format(args.plot)
    check_new_log(args.out, args.overwrite)
    check_targets([args.plot])
    engine = engine_named(loaded, args.engine)
    name = status.ENGINE_NAMES[engine]
    if args.schedule is not None:
        stimulus = stimulus_named(args.schedule, loaded, args.duration, args.stimulus_channel)
    else:
        stimulus = profile_stimulus(loaded, args.duration, args.stimulus_channel)
    parcel = None
    if args.out:
        networks = {name, args.compare} & {"surrogate", "onnx"}
        parcel = pack(loaded, engine, models=bool(networks))
        loaded = parcel.loaded
    first = simulate(loaded, engine, stimulus.commands, output.progress("first"))
    second = None
    if args.compare:
        second = simulate(loaded, status.ENGINE_NAMES.index(args.compare), stimulus.commands, output.progress("second"))
    figures = output.figures(loaded, name, stimulus.facts, first, args.compare, second)
    if args.out:
        with whole(args.out) as part:
            output.write_log(part, parcel, first, stimulus.facts)
    if args.plot:
        with whole(args.plot) as part:
            output.write_plot(part, loaded, first, second, name, args.compare)
    print(json.dumps(figures) if args.json else output.text(figures))
    return exit_codes.PASSED if figures["finite"] else exit_codes.VERDICT_FAILED
