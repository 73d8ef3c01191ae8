"""Worker processes with one thread each, which end with this process."""

import os
import pickle
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from pathlib import Path
from tempfile import mkdtemp
from threading import Thread
from typing import Any

import torch

from .files.atomic import writing
from .interruption import starting_processes, unfinished


@contextmanager
def spawned_pool(jobs: int, begin: Callable[[Path], None], shared: Any) -> Iterator[Any]:
    """A `multiprocessing.Pool` of new processes; they are ended with the block.

    Args:
        jobs: number of processes.
        begin: function that each process calls at its start with the path of a file; it calls `begin_worker`.
        shared: object that this file holds, pickled.
    """
    with handed_over(shared) as path:
        with starting_processes():
            pool = get_context("spawn").Pool(jobs, begin, (path,))
        with pool:
            yield pool


@contextmanager
def handed_over(shared: Any) -> Iterator[Path]:
    """A file with a pickled object for new processes.

    Through a pipe, one process would have to be running before the next one starts. Plain pickle is used, because torch's would
    move tensors to shared memory, away from arrays that share theirs.
    """
    folder = Path(mkdtemp())
    with unfinished(folder):
        path = folder / "shared"
        with writing(path):
            path.write_bytes(pickle.dumps(shared))
        yield path


def begin_worker(path: Path) -> Any:
    """Set up a worker process: it uses one thread, and only its parent interrupts and ends it.

    Args:
        path: as for `handed_over` gave it.

    Returns:
        What was handed over.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    torch.set_num_threads(1)
    Thread(target=_end_with_parent, name="parent", daemon=True).start()
    return pickle.loads(path.read_bytes())


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
