"""The fields of a reconstruction."""

from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ..errors import MembraneError, expect, is_number
from ..pose import Pose

Frame: TypeAlias = dict[str, np.ndarray]
"""The arrays of one frame, as returned by `Reconstruction.frame`."""


class RestSurface(Protocol):
    """A rest surface, such as `sensor.membrane`: outward normals `[V, 3]`, vertex areas `[V]`, and the lines of the grid."""

    @property
    def rest_normals(self) -> Tensor: ...
    @property
    def rest_area(self) -> Tensor: ...
    @property
    def grid(self) -> tuple[int, int]: ...


class TactileFields(NamedTuple):
    """The output of a visuotactile sensor of Isaac Lab, under its names; the points are the vertices.

    penetration_depth      [B, V]     `indentation`, zero where the membrane is not pushed in
    tactile_normal_force   [B, V]     compressive force on a vertex
    tactile_shear_force    [B, V, 2]  along the camera's x projected onto the rest surface, and along the normal times that
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
    traction          [B, V, 3]  contact force per rest area (zero for minimum energy, which assumes that there is none)
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
    coverage          [B]        area around the markers found, over the area around those seen at rest
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
        """Return one frame as numpy arrays by field name, float32 (status int32).

        Raises:
            MembraneError: the index is out of range.

        Example:
            >>> batch = Reconstruction(*torch.zeros(26, 2, 3))  # two frames; arrays of other shapes in a real one
            >>> frame = batch.frame(1)
            >>> frame["force"].tolist(), str(frame["status"].dtype)
            ([0.0, 0.0, 0.0], 'int32')
        """
        count = len(self.status)
        is_there = is_number(index) and hasattr(index, "__index__") and -count <= index < count
        expect(is_there, "Reconstruction.frame: index", index, f"the number of one of {count} frames, from 0")
        arrays = {key: value[index].detach().cpu().numpy() for key, value in self._asdict().items()}
        return {key: value.astype(np.int32 if key == "status" else np.float32) for key, value in arrays.items()}

    def split_traction(self) -> tuple[Tensor, Tensor]:
        """Return the push `[B, V]`, the compressive normal traction, and the shear `[B, V, 3]`:
        `traction = shear - push normals`."""
        push = -(self.traction * self.normals).sum(-1)
        return push, self.traction + push[..., None] * self.normals

    def indentation(self, rest: RestSurface) -> Tensor:
        """Return the displacement of the vertices along the inward rest normals, `-displacement . rest_normals`: `[B, m, n]`,
        length.

        Args:
            rest: the sensor's `membrane`, on the grid of this result.

        Raises:
            MembraneError: the number of vertices differs.

        Limitations:
            This is not the depth of an object below the rest surface: vertices also move where the membrane slides along
            itself, or bulges beside a contact (negative values).
        """
        expect(hasattr(rest, "rest_normals"), "Reconstruction: rest", rest, "the sensor's `membrane`, on this result's grid")
        count, expected = len(rest.rest_normals), self.displacement.shape[-2]
        expect(count == expected, "Reconstruction.indentation: vertices of rest", count, f"{expected}, the result's")
        moved = -(self.displacement * rest.rest_normals.to(self.displacement)).sum(-1)
        depth: Tensor = moved.unflatten(-1, rest.grid)
        return depth

    def tactile_fields(self, rest: RestSurface) -> TactileFields:
        """Return depths and forces at the vertices under the names of Isaac Lab.

        Args:
            rest: the sensor's `membrane`, on the grid of this result.

        Raises:
            MembraneError: the number of vertices differs.

        Limitations:
            In Isaac Lab, penetration is that of a rigid object into an undeformed pad; here it is the membrane's own
            indentation.
        """
        depth = self.indentation(rest).flatten(-2)
        normals, area = (part.to(self.displacement) for part in (rest.rest_normals, rest.rest_area))
        along = torch.nn.functional.normalize(normals.new_tensor([1.0, 0.0, 0.0]) - normals[:, :1] * normals, dim=-1)
        axes = torch.stack([along, torch.linalg.cross(normals, along)], -2)
        push = -(self.traction * normals).sum(-1)
        shear = (axes * self.traction[..., None, :]).sum(-1)
        return TactileFields(depth.clamp_min(0), push * area, shear * area[:, None])

    def wrench_in(self, pose: Pose) -> Tensor:
        """Return the wrench `[B, 6]` in a tool's frame: total contact force, and its moment about that frame's origin.

        Args:
            pose: pose of the camera's frame in that frame: `sensor.tool`, or `results.mesh.tool` for stored results.

        Raises:
            MembraneError: it is not a pose; for a sensor file without `[tool]` it is None.

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
        """Return all arrays on another device or in another precision, as `torch.Tensor.to`; the status stays an integer.

        Raises:
            MembraneError: the device or precision does not exist.
        """
        try:
            moved = {key: value.to(*args, **kwargs) for key, value in self._asdict().items()}
        except (TypeError, ValueError, RuntimeError, AssertionError, OverflowError) as error:
            said = ", ".join(map(repr, (*args, *kwargs.values())))
            raise MembraneError(
                f"Reconstruction.to: {said}; expected an existing device, such as 'cpu', or a torch.dtype"
            ) from error
        return Reconstruction(**(moved | {"status": moved["status"].to(self.status.dtype)}))

    def cpu(self) -> "Reconstruction":
        """Return all arrays on the CPU."""
        return self.to("cpu")

    def numpy(self) -> "Reconstruction":
        """Return all arrays as numpy arrays on the CPU, without gradients."""
        return Reconstruction(**{key: value.detach().cpu().numpy() for key, value in self._asdict().items()})
