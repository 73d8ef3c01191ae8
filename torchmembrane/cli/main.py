"""The command `torchmembrane`. Exit codes: 0 success, 1 some frames failed, 2 wrong usage, 130 interrupted, 143 by SIGTERM.

Each command has its own module, with a parser that loads nothing heavy, and with `run`, which loads what it needs.
"""

import atexit
import sys
import warnings
from argparse import ArgumentParser
from contextlib import suppress
from signal import SIGINT

from .. import __version__
from ..errors import MembraneError
from ..interruption import SAID, end_process, ended_by_signals
from . import calibrate, capture, check, export, init, live, reconstruct, simulate, view
from .parser import CommandParser

COMMANDS = (init, check, capture, reconstruct, live, view, calibrate, simulate, export)


def main(argv: list[str] | None = None) -> int:
    """Run the command with these arguments (default: those of the process); return the exit code."""
    with warnings.catch_warnings(), ended_by_signals() as interrupted_by:
        warnings.showwarning = lambda message, *_: print(f"torchmembrane: warning: {message}", file=sys.stderr)
        try:
            arguments = command_parser().parse_args(argv)
            return int(arguments.run(arguments))
        except KeyboardInterrupt:
            pass
        except Exception as error:
            if interrupted_by():  # the interruption has become another error on its way
                pass
            elif isinstance(error, MembraneError | OSError):
                print(f"torchmembrane: error: {_said(error)}", file=sys.stderr)
                return 2
            else:
                raise
        number = interrupted_by() or SIGINT
        if argv is None:
            with suppress(OSError):
                sys.stdout.flush()
            atexit._run_exitfuncs()
            end_process(number)
        print(SAID, file=sys.stderr)
        return 128 + number


def _said(error: MembraneError | OSError) -> str:
    """Return the message of an error; file errors name their file, so an error without a name is one of the standard output."""
    nameless = isinstance(error, OSError) and error.filename is None and error.errno is not None
    return f"standard output: {error}" if nameless else str(error)


def command_parser() -> ArgumentParser:
    """Return the parser of the whole command."""
    parser = CommandParser(
        prog="torchmembrane", description="3-D shape of a deformable membrane from one image of its markings."
    )
    parser.add_argument("--version", action="version", version=f"torchmembrane {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in COMMANDS:
        command.add_parser(commands)
    return parser
