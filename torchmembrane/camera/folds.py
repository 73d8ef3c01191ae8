"""Detection of lens distortion that folds back within the image, beyond which pixels would show other points again."""

import math

import torch
from torch import Tensor

from ..errors import MembraneError
from .distortion import fisheye_direction, fisheye_fold, pinhole_direction
from .model import Camera

DIRECTIONS, STEPS = 32, 256  # directions searched from the centre to each side of the image, and steps along each


def fold_in_image(camera: Camera) -> float:
    """Find the radius at which a camera's distortion folds back within its image.

    Args:
        camera: any camera; its ports are ignored.

    Returns:
        The smallest distance from the centre, accurate to one or two px, at which a pixel shows nothing; inf if all pixels show
        something.

    Example:
        >>> lens = "pinhole", (640, 480), (400, 400), (320, 240)
        >>> [200 < fold_in_image(Camera(*lens, distortion)) < 230 for distortion in ([-0.5], [-0.25, 0.09])]
        [True, False]
    """
    distortion, (width, height) = camera.distortion, camera.image_size
    if not len(distortion) or (camera.model == "fisheye" and float(fisheye_fold(distortion)) >= math.pi):
        return math.inf
    u, v = (torch.linspace(-0.5, side - 0.5, DIRECTIONS, device="cpu").to(camera.centre) for side in (width, height))
    sides = [torch.cartesian_prod(u, v[[0, -1]]), torch.cartesian_prod(u[[0, -1]], v)]
    steps = torch.linspace(0, 1, STEPS + 1, device="cpu").to(camera.centre)[1:, None, None]
    pixels = camera.centre + steps * (torch.cat(sides) - camera.centre)
    direction = pinhole_direction if camera.model == "pinhole" else fisheye_direction
    lost = direction((pixels - camera.centre) / camera.focal, distortion).isnan().any(-1)
    within = ((pixels >= -0.5) & (pixels <= pixels.new_tensor([width, height]) - 0.5)).all(-1)
    return float(torch.where(lost & within, (pixels - camera.centre).norm(dim=-1), math.inf).min())


def refuse_folds(camera: Camera, points: Tensor) -> None:
    """Refuse a lens whose distortion folds back within the image.

    A fisheye's image may be a circle within the image. Outside the largest circle about its centre that fits into the image,
    its distortion may fold back, provided that all of the membrane is imaged.

    Args:
        camera: the camera.
        points: points of the membrane at rest, `[V, 3]`, camera frame.

    Raises:
        MembraneError: the distortion folds back; the message contains the radius.
    """
    radius = fold_in_image(camera)
    (u, v), (width, height) = camera.centre.tolist(), camera.image_size
    circle = min(u, v, width - 1 - u, height - 1 - v)
    if radius == math.inf or (camera.model == "fisheye" and radius > circle and bool(camera(points).isfinite().all())):
        return
    raise MembraneError(
        f"the distortion folds back {radius:.0f} px from the centre, within the image: pixels farther out would show once more "
        "what those within show; expected coefficients that hold up to the image's corners: check their order and signs, "
        "calibrate with views that fill the image, or crop it"
    )
