"""What one frame's reconstruction holds, and how it is stored."""

from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ..errors import MembraneError, expect
from ..pose import Pose
from .atomic import whole_file
from .bounded import DAMAGE, NUMBERS, TEXT, in_one_line, read_arrays
from .frame_shapes import shape_of
from .origin import Origin

Frame: TypeAlias = dict[str, np.ndarray]
"""One frame's arrays, as `Reconstruction.frame` gives them."""


class RestSurface(Protocol):
    """A rest surface, such as `sensor.membrane`: outward normals `[V, 3]`, areas `[V]` of the vertices, the grid's lines."""

    @property
    def rest_normals(self) -> Tensor: ...
    @property
    def rest_area(self) -> Tensor: ...
    @property
    def grid(self) -> tuple[int, int]: ...


class TactileFields(NamedTuple):
    """What a visuotactile sensor of Isaac Lab gives, under its names; the points are the vertices.

    penetration_depth      [B, V]     `indentation`, zero where the membrane is not pushed in
    tactile_normal_force   [B, V]     compressive force on a vertex
    tactile_shear_force    [B, V, 2]  along the camera's x turned into the rest surface, and along the normal times that
    """

    penetration_depth: Tensor
    tactile_normal_force: Tensor
    tactile_shear_force: Tensor


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
    status            [B] int32  0 ok; texts in `Status`
    wrench            [B, 6]     total contact force, and its moment about the origin of the camera's frame (force x length)
    contact_force     [B, 4, 3]  force of each patch of `contact_points`, in their order, NaN-padded as all of `contact_`; NaN
                                 where no tractions are found
    contact_normal    [B, 4, 3]  mean outward normal of the membrane in the patch
    contact_area      [B, 4]     of the patch, deformed
    contact_slip      [B, 4]     shear force over normal force of the patch
    contact_curvature [B, 4, 2]  principal curvatures of the surface in the patch (1 / length), the larger first, positive where
                                 the object bulges into the membrane; NaN where the patch is too narrow to tell
    contact_at_rim    [B, 4]     1 where the patch reaches the fixed rim, its force is then a lower bound; else 0
    coverage          [B]        share of the membrane's area that found markers see, of what they see at rest
    camera_motion     [B, 4]     of the image against the rim, estimated and taken out: du, dv (px), rotation (degrees, u to v),
                                 scale, about the image's centre; `pixels` stay as measured
    force_deviation   [B, 3]     standard deviation of `force`, with the model's error in it; NaN where no tractions are found
    depth_deviation   [B]        the same of the deepest displacement along the inward rest normals

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
    wrench: Tensor
    contact_force: Tensor
    contact_normal: Tensor
    contact_area: Tensor
    contact_slip: Tensor
    contact_curvature: Tensor
    contact_at_rim: Tensor
    coverage: Tensor
    camera_motion: Tensor
    force_deviation: Tensor
    depth_deviation: Tensor

    def frame(self, index: int) -> dict[str, np.ndarray]:
        """One frame as numpy arrays, float32 (status int32), by the names above.

        Example:
            >>> batch = Reconstruction(*torch.zeros(26, 2, 3))  # two frames; arrays of other shapes in a real one
            >>> frame = batch.frame(1)
            >>> frame["force"].tolist(), str(frame["status"].dtype)
            ([0.0, 0.0, 0.0], 'int32')
        """
        arrays = {key: value[index].detach().cpu().numpy() for key, value in self._asdict().items()}
        return {key: value.astype(np.int32 if key == "status" else np.float32) for key, value in arrays.items()}

    def split_traction(self) -> tuple[Tensor, Tensor]:
        """The push `[B, V]`, compressive normal traction, and the shear `[B, V, 3]`: `traction = shear - push normals`."""
        push = -(self.traction * self.normals).sum(-1)
        return push, self.traction + push[..., None] * self.normals

    def indentation(self, rest: RestSurface) -> Tensor:
        """How far the vertices have moved along the inward rest normals, `-displacement . rest_normals`: `[B, m, n]`, length.

        Args:
            rest: the sensor's `membrane`, on the grid of this result.

        Raises:
            MembraneError: it has another number of vertices.

        Limitations:
            Not the depth of an object below the rest surface: where the membrane slides along itself, or bulges beside a
            contact (negative), it moves without one.
        """
        count, expected = len(rest.rest_normals), self.displacement.shape[-2]
        expect(count == expected, "Reconstruction.indentation: vertices of rest", count, f"{expected}, the result's")
        moved = -(self.displacement * rest.rest_normals.to(self.displacement)).sum(-1)
        depth: Tensor = moved.unflatten(-1, rest.grid)
        return depth

    def tactile_fields(self, rest: RestSurface) -> TactileFields:
        """Depths and forces of the vertices as Isaac Lab names them.

        Args:
            rest: the sensor's `membrane`, on the grid of this result.

        Raises:
            MembraneError: it has another number of vertices.

        Limitations:
            Its penetration is that of a rigid object into an undeformed pad; here it is the membrane's own indentation.
        """
        depth = self.indentation(rest).flatten(-2)
        normals, area = (part.to(self.displacement) for part in (rest.rest_normals, rest.rest_area))
        along = torch.nn.functional.normalize(normals.new_tensor([1.0, 0.0, 0.0]) - normals[:, :1] * normals, dim=-1)
        axes = torch.stack([along, torch.linalg.cross(normals, along)], -2)
        push = -(self.traction * normals).sum(-1)
        shear = (axes * self.traction[..., None, :]).sum(-1)
        return TactileFields(depth.clamp_min(0), push * area, shear * area[:, None])

    def wrench_in(self, pose: Pose) -> Tensor:
        """The wrench `[B, 6]` in a tool's frame: total contact force, and its moment about that frame's origin.

        Args:
            pose: the camera's in that frame: `sensor.tool`, or `results.mesh.tool` of stored results.

        Raises:
            MembraneError: it is none, as of a sensor file without `[tool]`.

        Example:
            >>> nothing = Reconstruction(*torch.zeros(len(Reconstruction._fields), 1))
            >>> pressed = nothing._replace(wrench=torch.tensor([[0.0, 0.0, -1.0, 0.0, 0.0, 0.0]]))
            >>> beside = Pose([0, 0, 0], [5, 0, 0])  # the camera is 5 along the tool's x
            >>> pressed.wrench_in(beside).tolist()
            [[0.0, 0.0, -1.0, 0.0, 5.0, 0.0]]
        """
        expected = "a Pose: `sensor.tool`, or `results.mesh.tool`, of a sensor file with [tool]"
        expect(isinstance(pose, Pose), "Reconstruction.wrench_in: pose", pose, expected)
        return pose.wrench(self.wrench)

    def to(self, *args: Any, **kwargs: Any) -> "Reconstruction":
        """All arrays as `torch.Tensor.to` gives them: another device or precision; the status stays an integer."""
        moved = {key: value.to(*args, **kwargs) for key, value in self._asdict().items()}
        return Reconstruction(**(moved | {"status": moved["status"].to(self.status.dtype)}))

    def cpu(self) -> "Reconstruction":
        """All arrays on the CPU."""
        return self.to("cpu")

    def numpy(self) -> "Reconstruction":
        """All arrays as numpy arrays on the CPU, without gradients."""
        return Reconstruction(**{key: value.detach().cpu().numpy() for key, value in self._asdict().items()})


ADDED = (
    *("wrench", "contact_force", "contact_normal", "contact_area", "contact_slip", "contact_curvature", "contact_at_rim"),
    *("coverage", "camera_motion", "force_deviation", "depth_deviation"),
)
"""Arrays that results did not always hold."""
EXPECTED = "a result NAME.npz, the arrays of Reconstruction"


class Stored(NamedTuple):
    """A frame as it is stored: its arrays, what they were found in, and the seconds that it took.

    Attributes:
        frame: as `Reconstruction.frame` gives it.
        origin: the image file, or the video.
        seconds: NaN where it is not known.
    """

    frame: Frame
    origin: Origin = Origin()
    seconds: float = float("nan")

    @classmethod
    def of(cls, arrays: dict[str, Any]) -> "Stored":
        """From all arrays of a file; those that it lacks are as unknown.

        Raises:
            KeyError: it lacks one that there always was.
        """
        known = {key: arrays[key] for key in Origin._fields if key in arrays}
        origin = Origin()._replace(**{key: value.item() if hasattr(value, "item") else value for key, value in known.items()})
        return cls(completed(arrays), origin, float(arrays.get("seconds", np.nan)))

    def arrays(self) -> Frame:
        """All arrays of a file, by name."""
        known = {key: np.asarray(value) for key, value in self.origin._asdict().items()}
        return self.frame | known | {"seconds": np.asarray(self.seconds, np.float64)}


def save_frame(path: str | Path, frame: dict[str, np.ndarray]) -> None:
    """Write one frame, whole or not at all.

    Args:
        path: the file, `.npz`.
        frame: as `Reconstruction.frame` gives it.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> frame = Reconstruction(*torch.ones(26, 1, 3)).frame(0)
        >>> with TemporaryDirectory() as folder:
        ...     save_frame(f"{folder}/press.npz", frame)
        ...     load_frame(f"{folder}/press.npz")["force"].tolist()
        [1.0, 1.0, 1.0]
    """
    arrays: dict[str, Any] = frame
    content = BytesIO()  # written at once: each write of a file makes other threads wait for their turn
    try:
        np.savez(content, **arrays)
    except ValueError as error:
        if isinstance(error.__context__, KeyboardInterrupt):  # amid an entry, which zipfile then cannot close
            raise error.__context__ from None
        raise
    with whole_file(path) as partial:
        partial.write_bytes(content.getbuffer())


def load_frame(path: str | Path) -> dict[str, np.ndarray]:
    """Read a frame.

    Args:
        path: what `save_frame` wrote.

    Returns:
        Its arrays by name; see `save_frame` for an example.

    Raises:
        MembraneError: the file is missing, or not a frame.
    """
    return load_stored(Path(path)).frame


def load_stored(path: Path) -> Stored:
    """Read a frame, and what it was found in.

    Raises:
        MembraneError: as `load_frame`.
    """
    arrays = read_arrays(path, None, EXPECTED, NUMBERS + TEXT)
    try:
        return Stored.of({key: np.array(array, array.dtype.newbyteorder("=")) for key, array in arrays.items()})
    except DAMAGE as error:
        raise MembraneError(f"{path}: not a result of torchmembrane ({in_one_line(error)}); expected {EXPECTED}") from error


def completed(frame: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A frame that was stored before there were all of these arrays: those that it lacks are NaN.

    Raises:
        KeyError: it lacks one that there always was.
    """
    sizes = {"P": len(frame["contact_points"])}
    added = {key: np.full(shape_of(key, sizes), np.nan, np.float32) for key in ADDED if key not in frame}
    return {key: added[key] if key in added else frame[key] for key in Reconstruction._fields}


def stack_frames(frames: list[dict[str, np.ndarray]]) -> Reconstruction:
    """Frames of one sensor as a batch.

    Args:
        frames: as `Reconstruction.frame` gives them.

    Returns:
        The batch, in their order, on the CPU.

    Example:
        >>> first, second = (Reconstruction(*torch.full((26, 1, 3), value)).frame(0) for value in (1.0, 2.0))
        >>> stack_frames([first, second]).force.tolist()
        [[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]]
    """
    return Reconstruction(**{k: torch.from_numpy(np.stack([f[k] for f in frames])) for k in Reconstruction._fields})
