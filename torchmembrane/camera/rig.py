"""Several views of one scene, by cameras and mirrors, in the frame of the first view."""

import copy
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ..pose import ViewPose
from ..torch_modes import on_cpu
from .model import Camera, Rays
from .motion import ImageMotion


@on_cpu
class Rig(ImageMotion, nn.Module):
    """Cameras that see the same markers; pixels and points are listed view by view, those of the first view first.

    Args:
        cameras: the W cameras.
        poses: poses of their frames in the first camera's frame; they are reflections for mirrors.
        outside: whether each camera looks at the membrane's outer side; default: none does.

    Attributes:
        rotation: rotations of the poses, `[W, 3, 3]`.
        translation: centres of projection, `[W, 3]`, length unit.

    Example:
        >>> import numpy as np
        >>> camera = Camera("pinhole", (640, 480), (400, 400), (320, 240))
        >>> beside = ViewPose(np.eye(3), np.array([20.0, 0.0, 0.0]))
        >>> rig = Rig([camera, camera], [ViewPose(np.eye(3), np.zeros(3)), beside])
        >>> point = torch.tensor([[20.0, 0.0, 100.0]], dtype=torch.float64)
        >>> rig.point_to_pixel(point.repeat(2, 1)).tolist()
        [[400.0, 240.0], [320.0, 240.0]]
    """

    rotation: Tensor
    translation: Tensor
    inwards: Tensor

    def __init__(self, cameras: Sequence[Camera], poses: Sequence[ViewPose], outside: Sequence[bool] = ()) -> None:
        super().__init__()
        signs = [-1.0 if is_outside else 1.0 for is_outside in outside or [False] * len(poses)]
        self.register_buffer("inwards", torch.tensor(signs).double())
        self.cameras = nn.ModuleList([copy.deepcopy(camera) for camera in cameras])
        self.register_buffer("rotation", torch.stack([torch.tensor(pose.rotation).double() for pose in poses]))
        self.register_buffer("translation", torch.stack([torch.tensor(pose.translation).double() for pose in poses]))

    @property
    def image_sizes(self) -> list[tuple[int, int]]:  # type: ignore[override]
        """Return the image sizes of all views."""
        return [camera.image_size for camera in self.cameras]  # type: ignore[misc]

    @property
    def focal(self) -> Tensor:
        """Return the focal lengths of all views, `[W, 2]` px."""
        return torch.stack([camera.focal for camera in self.cameras])  # type: ignore[misc]

    def pixel_to_ray(self, pixels: Tensor) -> Rays:
        """Return the rays `[..., N, 3]` of pixels `[..., N, 2]` in the first view's frame; see `Camera.pixel_to_ray`."""
        origins, directions = [], []
        for w, part in enumerate(self._each(pixels)):
            ray = self.cameras[w].pixel_to_ray(part)  # type: ignore[operator]
            turned = self.rotation[w].mT.to(ray.direction)
            origins.append(ray.origin @ turned + self.translation[w])
            directions.append(ray.direction @ turned)
        return Rays(torch.cat(origins, -2), torch.cat(directions, -2))

    def point_to_pixel(self, points: Tensor) -> Tensor:
        """Return the pixels `[..., N, 2]` at which points `[..., N, 3]` are seen; see `Camera.point_to_pixel`."""
        each = enumerate(self._each(points - self.centres(points)))
        return torch.cat([self.cameras[w].point_to_pixel(part @ self.rotation[w].to(part)) for w, part in each], -2)  # type: ignore[operator]

    def lines_of_sight(self, points: Tensor) -> Tensor:
        """Return the vectors from the centres of projection to points `[..., N, 3]`; reversed for views from outside."""
        return (points - self.centres(points)) * self.inwards.repeat_interleave(points.shape[-2] // len(self.inwards))[:, None]

    def centres(self, points: Tensor) -> Tensor:
        """Return the centres of projection of the views that see points `[..., N, 3]`, `[N, 3]`."""
        return self.translation.repeat_interleave(points.shape[-2] // len(self.translation), 0)

    def _each(self, values: Tensor) -> tuple[Tensor, ...]:
        """Split pixels or points by view."""
        each: tuple[Tensor, ...] = values.unflatten(-2, (len(self.cameras), -1)).unbind(-3)
        return each


def turns_by_noise(camera: Camera | Rig, pixels: Tensor, points: Tensor, covariance: Tensor) -> Tensor:
    """Return the rotations of the viewing rays that pixel noise causes, about the points on the rays.

    Args:
        camera: the camera, or the rig of several views.
        pixels: pixels of the rays, `[B, N, 2]`.
        points: points on the rays, `[B, N, 3]`; behind a port the noise moves a ray's origin too, so that it turns about a
            point.
        covariance: covariance of the pixels, `[N, 2, 2]` px^2.

    Returns:
        `[B, N, 2, 3]`, the rotations by one standard deviation of two independent noise components.
    """
    distance = torch.linalg.vector_norm(points - camera.pixel_to_ray(pixels).origin, dim=-1)[:, None, :, None]
    half = 0.5 * torch.eye(2, dtype=pixels.dtype, device=pixels.device)
    after, before = (camera.pixel_to_ray(pixels[:, None] + step[:, None]) for step in (half, -half))
    turn = (after.origin - before.origin) / distance + after.direction - before.direction
    turned: Tensor = torch.linalg.cholesky(covariance).mT @ turn.movedim(1, 2)
    return turned
