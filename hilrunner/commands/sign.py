"""Sign a log: RUN.mcap.sig beside it says whose key vouches for these bytes (extra: sign)."""

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner sign`."""
    parser.add_argument("log", type=Path, metavar="RUN.mcap")
    parser.add_argument("--key", type=Path, required=True, metavar="FILE", help="ed25519 private key, PEM or OpenSSH")
    parser.add_argument("--overwrite", action="store_true", help="replace a signature that exists")


def main(args: argparse.Namespace) -> int:
    """Check that the log is what was written, sign it, tell by which key."""
    from hilrunner.base.errors import UsageError
    from hilrunner.evidence import signature
    from hilrunner.evidence.damaged import DamagedLogError
    from hilrunner.evidence.reader import read_run

    key = signature.load_private_key(args.key)
    target = signature.signature_path(args.log)
    if target.exists() and not args.overwrite:
        raise UsageError(str(target), "exists", remedy="give --overwrite, or keep that signature")
    run = read_run(args.log, {})
    if run.mismatches:
        raise DamagedLogError(str(args.log), f"damaged, so it is not signed: {run.mismatches[0]}")
    print(write_signature(args.log, key))
    return 0


def write_signature(log: Path, key) -> str:
    """Write RUN.mcap.sig, whole or not at all; what to tell of it."""
    from hilrunner.commands.targets import write_text
    from hilrunner.evidence import signature

    target = write_text(signature.signature_path(log), signature.sign(log, key))
    return f"signed: {target}, key {signature.read_signature(log).fingerprint}"


def renew_signature(log: Path, key) -> str:
    """Sign a log that was just written; without a key, take away the signature of the log whose place it took."""
    from hilrunner.evidence.signature import signature_path

    if key is not None:
        return write_signature(log, key)
    signature_path(log).unlink(missing_ok=True)
    return ""
