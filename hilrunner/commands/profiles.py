"""List the profiles that ship."""

import argparse
import json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner profiles`."""
    parser.add_argument("--json", action="store_true", help="names and descriptions as JSON")


def main(args: argparse.Namespace) -> int:
    """Print name, axes and description of every shipped profile."""
    from hilrunner.setup.profile import available_profiles, load_profile

    found = [load_profile(name).profile for name in available_profiles()]
    if args.json:
        print(json.dumps([{"name": one.name, "description": one.description} for one in found]))
        return 0
    for one in found:
        circuits = ", ".join(f"{axis.name}: {axis.circuit}" for axis in one.axis)
        print(f"{one.name:16s} {one.bench.period_us:5d} us  {circuits:20s} {one.description}")
    return 0
