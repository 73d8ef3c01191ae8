"""Computation of frames by the actors of a Ray cluster; the process of the job distributes paths and writes the results."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from ..errors import MembraneError
from ..files.optional import load_ray
from ..files.provenance import printable
from .decode import Source
from .frame_reconstructor import FrameReconstructor, Outcome, outcomes_of
from .workers import Work, batch_for


class RayEngine:
    """Compute the outcomes of all frames on the cluster that `RAY_ADDRESS` names, or on this machine.

    A worker that dies is replaced, and its frames are computed again.

    Args:
        device: device of each worker: "cpu" with one thread, or "cuda" with a GPU of its own.
        workers: number of workers; default: as many as fit on the cluster.

    Raises:
        MembraneError: Ray is not installed; when called: videos or figures are requested.
    """

    def __init__(self, device: str = "cpu", workers: int | None = None):
        self.ray, self.device, self.workers = load_ray(), device, workers

    def __call__(self, work: Work, waiting: Iterator[Source], batch: int | None) -> Iterator[list[Outcome]]:
        paths = []
        for source in waiting:
            if source.origin is not None:
                raise MembraneError(
                    f"{source.file}: --engine ray reads only image files with a single picture; leave out --engine for others"
                )
            paths.append(printable(str(source.file)))
        if work.figures:
            raise MembraneError("--figures: --engine ray draws no figures; use `torchmembrane view DIR --frame NAME`")
        if paths:
            yield from self._outcomes(work.reconstructor, paths, batch)

    def _outcomes(self, state: FrameReconstructor, paths: list[str], batch: int | None) -> Iterator[list[Outcome]]:
        if not self.ray.is_initialized():
            self.ray.init(log_to_driver=False, logging_level="error")
        gpu = self.device == "cuda"
        room = int(self.ray.cluster_resources().get("GPU" if gpu else "CPU", 1))
        workers = self.workers or max(1, room)
        reconstructor = state.reconstructor
        batch = batch or batch_for(reconstructor.image_size, len(reconstructor.vertex_pixels), workers, "cpu")
        self.ray.data.DataContext.get_current().enable_progress_bars = False
        rows = self.ray.data.from_items([{"path": path} for path in paths], override_num_blocks=-(-len(paths) // batch))
        results = rows.map_batches(
            RayWorker,
            fn_constructor_args=(self.ray.put(state), self.device),
            batch_size=batch,
            concurrency=workers,
            num_cpus=1,
            num_gpus=int(gpu),
        )
        for found in results.iter_batches(batch_size=None, batch_format="numpy"):
            yield outcomes_of(found)


class RayWorker:
    """A `FrameReconstructor` that an actor fetches when it starts."""

    def __init__(self, reference: Any, device: str):
        import ray

        torch.set_num_threads(1)
        self.state: FrameReconstructor = ray.get(reference).on_device(device)

    def __call__(self, rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return self.state(rows)
