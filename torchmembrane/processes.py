"""Worker processes with one thread each, which end together with this process."""

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
    """Provide a `multiprocessing.Pool` of new processes that end with the block.

    Args:
        jobs: number of processes.
        begin: function that each process calls when it starts, with the path of a file; it calls `begin_worker`.
        shared: object that is pickled into this file.
    """
    with handed_over(shared) as path:
        with starting_processes():
            pool = get_context("spawn").Pool(jobs, begin, (path,))
        with pool:
            yield pool


@contextmanager
def handed_over(shared: Any) -> Iterator[Path]:
    """Provide a file with a pickled object for new processes.

    With a pipe, each process would have to be running before the next one starts. Plain pickle is used because torch's version
    would move tensors to shared memory and separate them from the arrays that share their data.
    """
    folder = Path(mkdtemp())
    with unfinished(folder):
        path = folder / "shared"
        with writing(path):
            path.write_bytes(pickle.dumps(shared))
        yield path


def begin_worker(path: Path) -> Any:
    """Set up a worker process: it uses one thread, and only its parent can interrupt and end it.

    Args:
        path: the file that `handed_over` provided.

    Returns:
        The object in the file.
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
