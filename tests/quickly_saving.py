"""A command that saves each result at once, for a process of its own."""

import os
import sys
from multiprocessing import get_context
from pathlib import Path

from torchmembrane.cli.main import main
from torchmembrane.jobs import workers
from torchmembrane.results import frame_table


def command(arguments: list[str], said: Path) -> None:
    """Run it, with what it says in a file; its worker processes are copies of this one, which has imported torch."""
    os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT), sys.stderr.fileno())
    frame_table.SAVE_SECONDS = 0.0
    workers.get_context = lambda _: get_context("fork")
    sys.exit(main(arguments))
