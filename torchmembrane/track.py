"""One stream of images: every frame starts from the one before."""

import numpy as np
import torch
from torch import Tensor

from .errors import MembraneError
from .io.results import Reconstruction
from .io.status import Status
from .reconstruct import Reconstructor


class Tracker:
    """Reconstructs the frames of one camera one after another.

    A frame starts from the solution of the frame before, which takes a few steps only; after a frame without a surface the next
    one starts from rest. Estimators that start from rest always are given nothing.

    Args:
        reconstructor: the sensor's.

    Example:
        >>> import torchmembrane as tm
        >>> reconstructor = tm.Reconstructor.from_file("examples/sensor.toml")
        >>> tracker = tm.Tracker(reconstructor)
        >>> rest, press = reconstructor.read("examples/rest.png", "examples/press_on_axis.png")
        >>> [int(tracker(frame).status[0]) for frame in (press, press)]
        [0, 0]
        >>> tracker.rezero(rest)
    """

    def __init__(self, reconstructor: Reconstructor):
        self.reconstructor = reconstructor
        self._before: Reconstruction | None = None
        self._latest: Tensor | None = None
        self._rest_pixels: Tensor | None = None

    def __call__(self, frame: Tensor | np.ndarray, pressure: float | None = None) -> Reconstruction:
        """The frame's result, a batch of one.

        Args:
            frame: `[H, W]`, `[H, W, 3]`, or a batch of one as for `Reconstructor`.
            pressure: that a gauge reads, as for `Reconstructor`.

        Raises:
            MembraneError: more than one frame, another size, shape or type.
        """
        images = self._one(frame)
        with torch.no_grad():
            result: Reconstruction = self.reconstructor(images, self._before, self._rest_pixels, pressure)
        self._latest = images
        follows = self.reconstructor.estimator.takes_start and Status(int(result.status[0])).has_surface
        self._before = result if follows else None
        return result

    def reset(self) -> None:
        """Forget the frames before, and what `rezero` took for rest."""
        self._before = self._latest = self._rest_pixels = None

    def rezero(self, frame: Tensor | np.ndarray | None = None) -> None:
        """Take a frame without contact, default the latest, for the rest state: what drifted since the rest image is nulled.

        Markers that are not found in it keep their places in the sensor's rest image.

        Raises:
            MembraneError: there is no frame yet, or too few of its markers are found.
        """
        images = self._latest if frame is None else self._one(frame)
        if images is None:
            raise MembraneError("Tracker.rezero: no frame yet; pass one without contact")
        self._rest_pixels, self._before = self.reconstructor.observer.rest_of(images), None

    def _one(self, frame: Tensor | np.ndarray) -> Tensor:
        images = self.reconstructor.grey(frame)
        if len(images) != 1:
            raise MembraneError(f"Tracker: {len(images)} frames; expected one, each call is the next one of a stream")
        return images
