"""Computation of frames in this process, with decoding one batch ahead, or by worker processes with one thread each."""

import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch

from ..errors import MembraneError
from ..files.atomic import remove_partials
from ..interruption import frame_in_work, starting_processes
from ..machine_code import using
from ..processes import begin_worker, handed_over
from ..results.store import Mesh
from ..sensor.view_images import first_view_image
from .decode import DecodedFrame, Loaded, Source, decoded, read_ahead
from .frame_reconstructor import FrameReconstructor, Outcome

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor

FRAMES_EACH = 200
"""Number of frames per worker process that justifies its start-up time."""
AHEAD = 3
"""Number of batches that a worker process may have been given and not yet returned."""
LARGEST_BATCH = 16
"""Largest batch on a CPU; larger batches are no faster."""
LARGEST_GPU_BATCH = 256
CONTAINER = Path("/sys/fs/cgroup/memory.max")
PIXEL_BYTES = 600
VERTEX_BYTES = 25000
"""Memory used by the computation of a frame, in bytes per image pixel and per vertex of the surface."""
MEMORY_SHARE = 0.25
"""Share of the machine's memory for all frames that are computed at the same time."""


DRAWS = "reconstruct"
"""The command named in the figure files."""


class Work(NamedTuple):
    """The work to do with each batch of frames.

    Attributes:
        reconstructor: computes the results.
        figures: folder of the figures of all frames, and the mesh of the results; None: no figures.
        machine_code: whether the solver takes its steps in machine code, or all of them by tensor operations.
    """

    reconstructor: FrameReconstructor
    figures: tuple[Path, Mesh] | None = None
    machine_code: bool = True

    def outcomes(self, group: list[DecodedFrame]) -> list[Outcome]:
        """Return the outcomes of decoded frames."""
        with using(self.machine_code), frame_in_work():
            found = self.reconstructor.outcomes(group)
        if self.figures:
            from ..plot.files import save
            from ..plot.frames import figure

            folder, mesh = self.figures
            for outcome, frame in zip(found, group, strict=True):
                if outcome.stored is not None and frame.image is not None:
                    image = first_view_image(frame.image, self.reconstructor.reconstructor.sensor.views).cpu().numpy()
                    save(figure(outcome.stored.frame, mesh, image, frame.name), folder / f"{frame.name}.png", DRAWS)
        return found


def outcomes_here(work: Work, sources: Iterator[Source], batch: int) -> Iterator[list[Outcome]]:
    """Yield the outcomes of all frames, batch by batch, computed in this process while the next batch is decoded."""
    for group in read_ahead(sources, work.reconstructor.reconstructor, batch):
        yield work.outcomes(group)


def outcomes_by(workers: int, work: Work, sources: Iterator[Source], batch: int) -> Iterator[list[Outcome]]:
    """Yield the outcomes of all frames, one list per batch, in the order of the sources; worker processes compute them.

    Videos are decoded in this process.

    Args:
        workers: number of processes.
        work: what each of them does.
        sources: the frames.
        batch: number of frames in a batch.

    Raises:
        MembraneError: a worker process ended unexpectedly, for example because memory ran out.
    """
    reconstructor = work.reconstructor.reconstructor
    with _pool(workers, work) as pool:
        waiting: deque[Future[list[Outcome]]] = deque()
        try:
            while group := [_portable(source, reconstructor) for source in islice(sources, batch)]:
                with starting_processes():
                    waiting.append(pool.submit(_outcomes, group))
                if len(waiting) >= AHEAD * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool as error:
            raise MembraneError(
                f"one of {workers} worker processes has ended (out of memory?); finished frames are kept: pass fewer "
                "--workers, or a smaller --batch"
            ) from error


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def workers_for(frames: int, device: str) -> int:
    """Return the number of worker processes that are worth their start-up time; 1 means this process."""
    return max(1, min(cores(), frames // FRAMES_EACH)) if device == "cpu" else 1


def batch_for(image_size: tuple[int, int], vertices: int, workers: int, device: str) -> int:
    """Return the number of frames to compute at once, given the available memory."""
    if device == "cuda":
        memory, largest = torch.cuda.mem_get_info()[0], LARGEST_GPU_BATCH
    else:
        memory, largest = memory_here(), LARGEST_BATCH
    return max(1, min(largest, int(MEMORY_SHARE * memory / (workers * frame_bytes(image_size, vertices)))))


def memory_here() -> int:
    """Return the memory of the machine in bytes, or the limit of its container if there is one."""
    known = hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if known else 2**32
    try:
        return min(machine, int(CONTAINER.read_text()))
    except (OSError, ValueError):  # there is none, or it says "max"
        return machine


def frame_bytes(image_size: tuple[int, int], vertices: int) -> int:
    """Return an upper bound of the memory that the computation of a frame takes, in bytes."""
    width, height = image_size
    return width * height * PIXEL_BYTES + vertices * VERTEX_BYTES


def _portable(source: Source, reconstructor: "Reconstructor") -> Source:
    """Return a source that another process can load."""
    if source.origin is None:
        return source
    frame = decoded(source, reconstructor)
    image = None if frame.image is None else frame.image.numpy()
    return source._replace(load=partial(_given, frame.reason, image, dict(frame.lacking)))


def _given(reason: str, image: object, lacking: dict[str, str], reconstructor: "Reconstructor") -> Loaded:
    if image is None:
        raise MembraneError(reason)
    return Loaded(torch.as_tensor(image, device="cpu"), lacking)


@contextmanager
def _pool(workers: int, work: Work) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of worker processes; if the block ends early, their work is abandoned."""
    with handed_over(work) as path:
        pool = ProcessPoolExecutor(workers, get_context("spawn"), _start, (path,))
        try:
            yield pool
        except BaseException:
            ended = list((pool._processes or {}).values())
            for process in ended:
                process.terminate()
            pool.shutdown(wait=True, cancel_futures=True)
            if work.figures:
                remove_partials(work.figures[0], [process.pid for process in ended])
            raise
        pool.shutdown()


_work: Work
"""The work assigned to this worker process."""


def _start(path: Path) -> None:
    """Initialise a worker process with its work."""
    global _work
    _work = begin_worker(path)


def _outcomes(group: list[Source]) -> list[Outcome]:
    return _work.outcomes([_work.reconstructor.decoded(source) for source in group])
