"""The command `torchmembrane`. Exit codes: 0 all well, 1 some frames failed, 2 wrong usage, 130 interrupted.

Each command has a module of its own, with its parser, which loads nothing heavy, and `run`, which loads what it needs.
"""

import signal
import sys
import warnings
from argparse import ArgumentParser
from collections.abc import Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread

from .. import __version__
from ..errors import MembraneError
from . import calibrate, check, export, init, live, reconstruct, simulate, view
from .parser import CommandParser

COMMANDS = (init, check, reconstruct, live, view, calibrate, simulate, export)


def main(argv: list[str] | None = None) -> int:
    """Run the command with these arguments (default: the process's); returns the exit code."""
    arguments = command_parser().parse_args(argv)
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: print(f"torchmembrane: warning: {message}", file=sys.stderr)
        try:
            with _terminated_as_interrupted():
                return int(arguments.run(arguments))
        except (MembraneError, OSError) as error:
            nameless = isinstance(error, OSError) and error.filename is None and error.errno is not None
            print(f"torchmembrane: error: {'standard output: ' if nameless else ''}{error}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("torchmembrane: interrupted; what is done so far is kept", file=sys.stderr)
            return 130


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """SIGTERM, as schedulers send it, ends the command as Ctrl-C does."""
    if current_thread() is not main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def command_parser() -> ArgumentParser:
    """The parser of the whole command."""
    parser = CommandParser(
        prog="torchmembrane", description="3-D shape of a deformable membrane from one image of its markings."
    )
    parser.add_argument("--version", action="version", version=f"torchmembrane {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in COMMANDS:
        command.add_parser(commands)
    return parser
