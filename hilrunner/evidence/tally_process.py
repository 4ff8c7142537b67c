"""`python -m hilrunner.evidence.tally_process`: the recorder of a run that keeps no log but has limits to be judged by."""

import sys

from hilrunner.evidence.tally import Tally
from hilrunner.record import process
from hilrunner.record.config import RecorderConfig


def make_tally(settings: RecorderConfig) -> Tally:
    """What takes the records of a run in place of its log."""
    return Tally(settings.axis_names, settings.metadata, process.read_attachments(settings))


def main() -> int:
    """The recorder process with a tally in place of its log."""
    return process.main(make_tally)


if __name__ == "__main__":
    sys.exit(main())
