"""What one frame's reconstruction holds, its status codes, and how it is stored."""

from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor

from ..errors import MembraneError
from .atomic import whole_file

OK, TOO_FEW_MARKERS, UNLIKE_REST, NOT_CONVERGED, BLANK, BAD_VALUES, NO_SOLUTION = range(7)

STATUS_TEXTS = {
    OK: "ok",
    TOO_FEW_MARKERS: "too few markers found: check light, focus and polarity; no surface",
    UNLIKE_REST: "image unlike the rest image (most markers not found): is it this sensor's? no surface",
    NOT_CONVERGED: "the solve has not converged: the answer is kept, do not rely on it",
    BLANK: "blank or saturated image: no contrast; no surface",
    BAD_VALUES: "image holds NaN, infinity or values outside 0..1; no surface",
    NO_SOLUTION: "the solve broke down: the flow folds the surface or is far too large; no surface",
}
CONTACT_POINTS = 4


class Reconstruction(NamedTuple):
    """A batch of reconstructed frames: camera frame, length unit and force unit of the sensor.

    vertices          [B, V, 3]  deformed surface
    displacement      [B, V, 3]  vertices minus rest
    normals           [B, V, 3]  unit, outward
    markers           [B, D, 3]  3-D positions of the markers, in the sensor file's order (always on the surface)
    pixels            [B, D, 2]  the model's rest pixel plus the measured displacement; NaN if lost
    confidence        [B, D]     0..1, 0 = lost
    traction          [B, V, 3]  contact force per area (zero for minimum energy, which assumes that there is none)
    contact           [B, V]     contact indicator, 0..1
    contact_points    [B, 4, 3]  centroids of the contact patches, NaN-padded
    force             [B, 3]     total contact force, the integral of traction
    pressure          [B]        pressure difference across the membrane (force / length^2)
    pressure_change   [B]        the same minus its rest value
    volume_error      [B]        (V - V_target) / V_rest
    residual          [B]        rms distance of measured from modelled marker pixels, px
    status            [B] int32  0 ok; texts in `STATUS_TEXTS`

    A frame without a surface has NaN in every floating array but `pixels` and `confidence`, which keep what was found.
    """

    vertices: Tensor
    displacement: Tensor
    normals: Tensor
    markers: Tensor
    pixels: Tensor
    confidence: Tensor
    traction: Tensor
    contact: Tensor
    contact_points: Tensor
    force: Tensor
    pressure: Tensor
    pressure_change: Tensor
    volume_error: Tensor
    residual: Tensor
    status: Tensor

    def frame(self, index: int) -> dict[str, np.ndarray]:
        """One frame as numpy arrays, float32 (status int32)."""
        arrays = {k: v[index].detach().cpu().numpy() for k, v in self._asdict().items()}
        return {k: v.astype(np.int32 if k == "status" else np.float32) for k, v in arrays.items()}


def save_frame(path: str | Path, frame: dict[str, np.ndarray]) -> None:
    """Write one frame (`Reconstruction.frame`) to `path` (.npz), whole or not at all."""
    arrays: dict[str, Any] = frame
    with whole_file(path) as partial, open(partial, "wb") as file:
        np.savez(file, **arrays)


def load_frame(path: str | Path) -> dict[str, np.ndarray]:
    """Read a frame written by `save_frame`; raises `MembraneError` if it is not one."""
    try:
        with np.load(path) as data:
            frame = {k: data[k] for k in Reconstruction._fields}
    except FileNotFoundError as error:
        raise MembraneError(f"{path}: no such file; expected a result NAME.npz") from error
    except (KeyError, OSError, ValueError, TypeError, EOFError, BadZipFile) as error:
        raise MembraneError(
            f"{path}: not a result of torchmembrane ({error}); expected the arrays of Reconstruction"
        ) from error
    return frame


def stack_frames(frames: list[dict[str, np.ndarray]]) -> Reconstruction:
    """Frames of one sensor as a batch."""
    return Reconstruction(**{k: torch.from_numpy(np.stack([f[k] for f in frames])) for k in Reconstruction._fields})
