"""Streams turn images into results one by one, with torch or with an exported model."""

from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..errors import MembraneError
from ..files.optional import load_edge
from ..reconstruct import Reconstructor
from ..results.npz import completed
from ..results.reconstruction import Frame
from ..results.store import Mesh, Settings
from ..track import Tracker
from .mailbox import Captured


class Stream(Protocol):
    """Function of an image (RGB or grey, or one image per view) and its time in seconds that returns the frame's arrays.

    Attributes:
        mesh: data that all frames share.
    """

    mesh: Mesh

    def __call__(self, image: Captured, time: float) -> Frame: ...

    def rezero(self) -> None:
        """Take the latest frame for rest."""

    def weigh(self, force: float) -> str:
        """Compare the latest frame with a weight, N, that stands on the membrane; return the comparison in words."""

    def gauge(self, pressure_change: float) -> str:
        """Compare the latest frame with a gauge's pressure change since rest, force unit / length unit^2; return it in
        words."""


class TrackedStream:
    """A stream computed by a `Tracker`.

    Example:
        >>> import torchmembrane as tm
        >>> reconstructor = tm.Reconstructor.from_file("examples/sensor.toml")
        >>> stream = TrackedStream(reconstructor)
        >>> frame = stream(reconstructor.read("examples/press_on_axis.png"), 0.0)
        >>> int(frame["status"]), frame["wrench"].shape
        (0, (6,))
    """

    def __init__(self, reconstructor: Reconstructor):
        self.tracker = Tracker(reconstructor)
        self.mesh = Mesh.from_reconstructor(reconstructor, Settings.from_reconstructor(reconstructor, "npz"))

    def __call__(self, image: Captured, time: float) -> Frame:
        return self.tracker(image, time=time).frame(0)

    def rezero(self) -> None:
        """Take the latest frame for rest.

        Raises:
            MembraneError: there is no frame yet, or it does not show the markers.
        """
        self.tracker.rezero()

    def weigh(self, force: float) -> str:
        """Return the comparison of `Tracker.weigh` in words."""
        return self._compared("force", self.tracker.weigh(force))

    def gauge(self, pressure_change: float) -> str:
        """Return the comparison of `Tracker.gauge` in words."""
        return self._compared("change of pressure", self.tracker.gauge(pressure_change))

    def _compared(self, what: str, ratio: float) -> str:
        watch = self.tracker.stiffness
        due = "a calibration is due" if watch.is_due else "no change of the modulus is certain"
        together = f"the latest comparisons together {watch.ratio:.3f}, {watch.deviation:.0%} uncertain"
        return f"the {what} is found {ratio:.3f} times as large as known; {together}: {due}"


class ModelStream:
    """A stream computed by a model from `torchmembrane export` with onnxruntime; a tracking model follows dots between frames.

    Args:
        path: path of the model.
        sensor: fingerprint of the sensor from which the model must have been exported.
        threads: number of threads of onnxruntime.

    Raises:
        MembraneError: torchmembrane-edge is missing; the file is not a model, or is one of another sensor; when called: the
            model refuses the image, for instance because of values beyond the camera's bit depth.
    """

    def __init__(self, path: Path, sensor: str, threads: int = 1):
        self._edge = edge = load_edge()
        self._path = path
        try:
            self._session = edge.Session(path, threads)
        except edge.EdgeError as error:
            raise MembraneError(f"--model {path}: {str(error).removeprefix(f'{path}: ')}") from error
        known = self._session.mesh
        if known["sensor"] != sensor:
            raise MembraneError(
                f"--model {path}: belongs to another sensor, {known['name']!r} ({known['sensor'][:12]}, here {sensor[:12]}); "
                "expected one that `torchmembrane export` made of this sensor file, grid included"
            )
        self.mesh = Mesh(**{key: value for key, value in known.items() if key in Mesh._fields})
        self._before: dict[str, np.ndarray] | None = None

    def __call__(self, image: Captured, time: float) -> Frame:
        try:
            self._before = self._session.run(self._batch(image), self._before)
        except self._edge.EdgeError as error:
            raise MembraneError(f"--model {self._path}: the model refuses the camera's image: {error}") from error
        return completed({key: values[0] for key, values in self._before.items()})

    def _batch(self, image: Captured) -> Any:
        """Return a batch of one frame in the model's format; a view without an image is left out."""
        return image[None] if isinstance(image, np.ndarray) else [each if each is None else each[None] for each in image]

    def rezero(self) -> None:
        """Raise an error, as a model cannot be rezeroed.

        Raises:
            MembraneError: always, because the rest state is part of the model.
        """
        remedy = "leave --model out, or run `calibrate rest` with new images and export the model again"
        raise MembraneError(f"rezero: an exported model contains a fixed rest state; {remedy}")

    def weigh(self, force: float) -> str:
        """Raise an error, as `gauge` does.

        Raises:
            MembraneError: always, because known loads are compared only in a stream computed by torch.
        """
        raise MembraneError("a known load is not compared with an exported model's results; leave --model out")

    gauge = weigh
