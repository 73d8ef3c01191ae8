"""What turns a stream's images into results, one after another: torch, or an exported model."""

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
    """Called with an image, RGB or grey, or with one of each view, and its time, seconds; gives the frame's arrays.

    Attributes:
        mesh: what the frames share.
    """

    mesh: Mesh

    def __call__(self, image: Captured, time: float) -> Frame: ...

    def rezero(self) -> None:
        """Take the latest frame for rest."""

    def weigh(self, force: float) -> str:
        """Compare the latest frame with a weight, N, that stands on the membrane; says what came of it."""

    def gauge(self, pressure_change: float) -> str:
        """Compare the latest frame with the change since rest, force unit / length unit^2, that a gauge reads; likewise."""


class TrackedStream:
    """By a `Tracker`.

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
            MembraneError: there is none, or it does not show the markers.
        """
        self.tracker.rezero()

    def weigh(self, force: float) -> str:
        """As `Tracker.weigh`, in words."""
        return self._compared("force", self.tracker.weigh(force))

    def gauge(self, pressure_change: float) -> str:
        """As `Tracker.gauge`, in words."""
        return self._compared("change of pressure", self.tracker.gauge(pressure_change))

    def _compared(self, what: str, ratio: float) -> str:
        watch = self.tracker.stiffness
        due = "a calibration is due" if watch.is_due else "no change of the modulus is certain"
        together = f"the latest comparisons together {watch.ratio:.3f}, {watch.deviation:.0%} uncertain"
        return f"the {what} is found {ratio:.3f} times as large as known; {together}: {due}"


class ModelStream:
    """By a model of `torchmembrane export`, run by onnxruntime; one that tracks follows dots from frame to frame.

    Args:
        path: path of the model.
        sensor: the fingerprint that it must have been exported from.
        threads: number of threads of onnxruntime.

    Raises:
        MembraneError: torchmembrane-edge is missing; no model, or that of another sensor; of a call: an image that the
            model does not take, such as one with values beyond the camera's bits.
    """

    def __init__(self, path: Path, sensor: str, threads: int = 1):
        self._edge = edge = load_edge()
        try:
            self._session = edge.Session(path, threads)
        except edge.EdgeError as error:
            raise MembraneError(f"--model {error}") from error
        known = self._session.mesh
        if known["sensor"] != sensor:
            raise MembraneError(
                f"--model {path}: of another sensor, {known['name']!r} ({known['sensor'][:12]}, here {sensor[:12]}); expected "
                "one that `torchmembrane export` made of this sensor file, grid included"
            )
        self.mesh = Mesh(**{key: value for key, value in known.items() if key in Mesh._fields})
        self._before: dict[str, np.ndarray] | None = None

    def __call__(self, image: Captured, time: float) -> Frame:
        try:
            self._before = self._session.run(self._batch(image), self._before)
        except self._edge.EdgeError as error:
            raise MembraneError(f"--model: {error}") from error
        return completed({key: values[0] for key, values in self._before.items()})

    def _batch(self, image: Captured) -> Any:
        """A batch of one as the model takes it; a view without an image is left out."""
        return image[None] if isinstance(image, np.ndarray) else [each if each is None else each[None] for each in image]

    def rezero(self) -> None:
        """Refused.

        Raises:
            MembraneError: always: the rest state is baked into a model.
        """
        raise MembraneError("rezero: an exported model has its rest state baked in; leave --model out, or export it again")

    def weigh(self, force: float) -> str:
        """Refused, as `gauge`.

        Raises:
            MembraneError: always: loads are compared where torch computes.
        """
        raise MembraneError("a known load is not compared with an exported model's results; leave --model out")

    gauge = weigh
