"""Verify a log: its own checksums and hashes, and the signature beside it (extra: sign)."""

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner verify`."""
    parser.add_argument("log", type=Path, metavar="RUN.mcap")
    parser.add_argument(
        "--signed-by", type=Path, metavar="FILE", help="public key that must have signed it, PEM or OpenSSH"
    )


def main(args: argparse.Namespace) -> int:
    """0: undamaged, and signed by the key given, if one is; 7: it is not what was written or signed; 1: not that key's."""
    from hilrunner.evidence.reader import read_run
    from hilrunner.evidence.signature import signature_judgements
    from hilrunner.evidence.verdict import Verdict, damage_judgement

    run = read_run(args.log, {})
    verdict = Verdict([damage_judgement(run.mismatches), *signature_judgements(args.log, args.signed_by)])
    for one in verdict.judgements:
        print(f"{one.outcome}: {one.doc}" + (f" ({one.detail})" if one.detail else ""))
    for text in run.damage:
        if text not in run.mismatches:
            print(f"  {text}")
    return verdict.exit_code
