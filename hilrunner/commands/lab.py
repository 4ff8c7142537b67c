"""Run a command beside a real CAN bus, vcan0 and vcan1, on any machine: hilrunner lab -- COMMAND [ARGUMENT ...]"""

import argparse

from hilrunner.labs import command

__doc__ += "\n\n" + command.__doc__.partition("\n\n")[2]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `hilrunner lab`."""
    command.add_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """The exit code of the command, or of the lab where none could start."""
    return command.run(args)
