"""One frame as a file NAME.npz: its arrays, its source image, and its computation time."""

from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ..errors import MembraneError
from ..files.atomic import write_bytes
from ..files.provenance import SourceFile
from ..files.safe_read import DAMAGE, NUMBERS, TEXT, in_one_line, read_arrays
from .frame_shapes import FIELDS, shape_of
from .reconstruction import Frame, Reconstruction
from .status import Status

ADDED = (
    *("wrench", "contact_force", "contact_normal", "contact_area", "contact_slip", "contact_curvature", "contact_at_rim"),
    *("coverage", "camera_motion", "force_deviation", "depth_deviation"),
)
"""Arrays that results of earlier versions lack."""
EXPECTED = "a result NAME.npz, the arrays of Reconstruction"


class Stored(NamedTuple):
    """A stored frame: its arrays, its source image, and its computation time.

    Attributes:
        frame: arrays as returned by `Reconstruction.frame`.
        origin: the image file or the video.
        seconds: computation time, s; NaN if unknown.
    """

    frame: Frame
    origin: SourceFile = SourceFile()
    seconds: float = float("nan")

    @classmethod
    def from_arrays(cls, arrays: dict[str, Any]) -> "Stored":
        """Return the frame that a file's arrays describe; values that the file lacks are unknown.

        Raises:
            KeyError: an array is missing that all versions have written.
        """
        known = {key: arrays[key] for key in SourceFile._fields if key in arrays}
        origin = SourceFile()._replace(
            **{key: value.item() if hasattr(value, "item") else value for key, value in known.items()}
        )
        return cls(completed(arrays), origin, float(arrays.get("seconds", np.nan)))

    def arrays(self) -> Frame:
        """Return all arrays of the file, by name."""
        known = {key: np.asarray(value) for key, value in self.origin._asdict().items()}
        return self.frame | known | {"seconds": np.asarray(self.seconds, np.float64)}


def save_frame(path: str | Path, frame: dict[str, np.ndarray]) -> None:
    """Write one frame atomically.

    Args:
        path: path of the file, `.npz`.
        frame: arrays as returned by `Reconstruction.frame`.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> frame = Reconstruction(*torch.ones(26, 1, 3)).frame(0)
        >>> with TemporaryDirectory() as folder:
        ...     save_frame(f"{folder}/press.npz", frame)
        ...     load_frame(f"{folder}/press.npz")["force"].tolist()
        [1.0, 1.0, 1.0]
    """
    arrays: dict[str, Any] = frame
    content = BytesIO()  # written in one call: each write of a file makes other threads wait for their turn
    try:
        np.savez(content, **arrays)
    except ValueError as error:
        if isinstance(error.__context__, KeyboardInterrupt):  # in the middle of an entry, which zipfile then cannot close
            raise error.__context__ from None
        raise
    write_bytes(path, content.getbuffer())


def load_frame(path: str | Path) -> dict[str, np.ndarray]:
    """Read a frame.

    Args:
        path: a file written by `save_frame`.

    Returns:
        The frame's arrays by name; see `save_frame` for an example.

    Raises:
        MembraneError: the file is missing, or is not a frame.
    """
    return load_stored(Path(path)).frame


def load_stored(path: Path) -> Stored:
    """Read a frame with its source and time.

    Raises:
        MembraneError: as for `load_frame`.
    """
    arrays = read_arrays(path, None, EXPECTED, NUMBERS + TEXT)
    try:
        return Stored.from_arrays({key: np.array(array, array.dtype.newbyteorder("=")) for key, array in arrays.items()})
    except DAMAGE as error:
        raise MembraneError(f"{path}: not a result of torchmembrane ({in_one_line(error)}); expected {EXPECTED}") from error


def completed(frame: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Fill the arrays that a frame of an earlier version lacks with NaN.

    Raises:
        KeyError: an array is missing that all versions have written.
        MembraneError: this version does not know the status.
    """
    if unknown := set(np.ravel(frame["status"]).tolist()) - set(Status):
        known = f"one from {min(Status):d} to {max(Status):d}"
        raise MembraneError(f"status is {unknown.pop()}; expected {known}: it is damaged, or of a later version")
    sizes = {"P": len(frame["contact_points"])}
    added = {key: np.full(shape_of(key, sizes), np.nan, np.float32) for key in ADDED if key not in frame}
    fields = [key for key in FIELDS if key in frame]
    return {key: added[key] if key in added else frame[key] for key in (*Reconstruction._fields, *fields)}


def stack_frames(frames: list[dict[str, np.ndarray]]) -> Reconstruction:
    """Stack frames of one sensor to a batch.

    Args:
        frames: frames as returned by `Reconstruction.frame`.

    Returns:
        The batch on the CPU, in the order of the frames.

    Example:
        >>> first, second = (Reconstruction(*torch.full((26, 1, 3), value)).frame(0) for value in (1.0, 2.0))
        >>> stack_frames([first, second]).force.tolist()
        [[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]]
    """
    return Reconstruction(**{k: torch.from_numpy(np.stack([f[k] for f in frames])) for k in Reconstruction._fields})
