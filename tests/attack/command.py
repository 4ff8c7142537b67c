"""Attacks on the bench and on what reads its logs, each case drawn from a seed, each failure tried again by one command.

    tools/attack                         the campaigns there are
    tools/attack flip --seed 7           all cases of one, the seed told
    tools/attack flip --seed 7 --case 41 one of them again

Exit code 0: nothing was found. 1: something was; the last line of each campaign sums it up.
"""

import argparse
import sys

from tests.attack.campaign import Campaign, try_cases


def campaigns() -> dict[str, Campaign]:
    """All of them, by name."""
    from tests.attack import damage, databases, logs, processes, profiles

    found = [damage.CUT, damage.FLIP, logs.LOGS, databases.DATABASES, profiles.PROFILES, profiles.NETWORKS]
    found += [processes.KILL, processes.SIGNAL, processes.STALL, processes.DISK, processes.SYSCALL]
    return {one.name: one for one in found}


def main() -> int:
    """See the module."""
    known = campaigns()
    parser = argparse.ArgumentParser(
        prog="attack", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("campaign", nargs="*", metavar="CAMPAIGN", help="default: list them; `all`: every one")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="default: 1")
    parser.add_argument("--count", type=int, metavar="N", help="cases (default: as many as make test-long tries)")
    parser.add_argument("--case", type=int, metavar="N", help="only this one")
    parser.add_argument("--verbose", action="store_true", help="say every case")
    options = parser.parse_args()
    names = list(known) if options.campaign == ["all"] else options.campaign
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        print("\n".join(f"{one.name:<10} {one.count:5d} cases: {one.doc}" for one in known.values()))
        return 2 if unknown else 0
    failed = 0
    for name in names:
        count = known[name].count if options.count is None else options.count
        numbers = range(count) if options.case is None else range(options.case, options.case + 1)
        result = try_cases(known[name], options.seed, numbers, options.verbose or options.case is not None)
        print(result.text(), flush=True)
        failed += len(result.failed)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
