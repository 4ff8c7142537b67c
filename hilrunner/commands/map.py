"""Propose a profile for a database of your own: which signal could be the valve command, which a pressure, and why."""

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner map`."""
    parser.add_argument("database", type=Path, metavar="FILE", help="DBC, KCD, SYM or ARXML; with --dbc: a profile")
    parser.add_argument("--node", metavar="NAME", help="the ECU under test: what it sends are commands")
    parser.add_argument("--out", type=Path, metavar="PROFILE.toml", help="write the profile there (default: print it)")
    parser.add_argument(
        "--dbc",
        type=Path,
        metavar="FILE.dbc",
        help="of a profile: write its mapped messages as the bench understands them",
    )


def main(args: argparse.Namespace) -> int:
    """Propose and print or write; 0. Exit code 2 where the file holds nothing to propose."""
    from hilrunner.commands.targets import check_targets, write_text

    check_targets([args.out, args.dbc])
    if args.dbc is not None:
        from hilrunner.setup.own_dbc import dbc_text
        from hilrunner.setup.profile import load_profile

        print(f"written: {write_text(args.dbc, dbc_text(load_profile(str(args.database))))}", file=sys.stderr)
        return 0
    text, notes = _proposed(args)
    if args.out is None:
        print(text, end="")
    else:
        print(
            f"written: {write_text(args.out, text)}; see what it means with `hilrunner check {args.out}`",
            file=sys.stderr,
        )
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    return 0


def _proposed(args: argparse.Namespace) -> tuple[str, list[str]]:
    """The text of the profile, and what the user should know of it; what a profile's reader refuses is told too."""
    import os
    import re

    from hilrunner.base.errors import HilrunnerError
    from hilrunner.setup.map_proposal import profile_text, propose
    from hilrunner.setup.profile import parse_profile
    from hilrunner.setup.signals import wire

    proposal = propose(args.database, args.node)
    folder = args.out.parent if args.out is not None else Path()
    name = os.path.relpath(args.database, folder)
    profile_name = re.sub(r"[^a-z0-9]+", "-", args.database.stem.lower()).strip("-")[:64] or "bench"
    text = profile_text(proposal, name.replace("\\", "/"), profile_name)
    notes = list(proposal.notes)
    try:
        profile = parse_profile(text, "the proposal")
        wire(args.database, list(profile.can.mapping))
    except HilrunnerError as error:
        notes.append(f"not yet a mapping the bench accepts: {error}")
        text = text.replace("name = ", f"# to be corrected: {' '.join(str(error).split())}\nname = ", 1)
    return text, notes
