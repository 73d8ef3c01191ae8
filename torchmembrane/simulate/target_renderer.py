"""Rendering of flat calibration targets, also through ports: each sample's ray is traced to the plane. Light is uniform."""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from ..camera.model import Camera
from ..camera.targets import Checkerboard, DotBoard
from .appearance import blurred, noisy

SAMPLES = 4  # number of samples along a pixel's side
GROUND = 0.4  # reflectance outside the board


class TargetRenderer(NamedTuple):
    """Renders one camera's images of flat targets.

    Attributes:
        origin: origins of the rays through all samples of the image, `[H s, W s, 3]`.
        direction: directions of these rays, `[H s, W s, 3]`.

    Example:
        >>> renderer = TargetRenderer.for_camera(Camera("pinhole", (32, 24), (30.0, 30.0), (15.5, 11.5)))
        >>> image = renderer.image(Checkerboard(3, 3, 5.0), np.eye(3), (-5.0, -5.0, 40.0))
        >>> image.shape, int(image.max())
        ((24, 32), 230)
    """

    origin: np.ndarray
    direction: np.ndarray

    @classmethod
    def for_camera(cls, camera: Camera) -> "TargetRenderer":
        """Return the renderer of a camera, with or without ports."""
        width, height = camera.image_size
        u, v = ((np.arange(side * SAMPLES) + 0.5) / SAMPLES - 0.5 for side in (width, height))
        pixels = torch.from_numpy(np.stack(np.meshgrid(u, v), -1))
        return cls(*(ray.numpy() for ray in camera.pixel_to_ray(pixels)))

    def image(
        self,
        board: Checkerboard | DotBoard,
        rotation: np.ndarray,
        translation: np.ndarray,
        noise: float | None = None,
        blur: float = 0.6,
        rng: np.random.Generator | None = None,
    ) -> np.ndarray:
        """Render the board with its point X at `rotation X + translation` in the camera's frame.

        Args:
            board: the target.
            rotation: rotation of the board, `[3, 3]`.
            translation: position of the board's origin, `[3]`, length unit.
            noise: ratio of white to the noise's standard deviation, dB; None: no noise.
            blur: standard deviation of the defocus, px.
            rng: random generator of the noise.

        Returns:
            The grey image, uint8 `[H, W]`.
        """
        rotation, translation = np.asarray(rotation, float), np.asarray(translation, float)
        origin, direction = (self.origin - translation) @ rotation, self.direction @ rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = -origin[..., 2] / direction[..., 2]
            x, y = (origin[..., k] + reach * direction[..., k] for k in (0, 1))
            low, high = board.extent
            on_board = (reach > 0) & (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
        grey = np.full(x.shape, GROUND)
        grey[on_board] = board.reflectance(x[on_board], y[on_board])
        image = F.avg_pool2d(torch.from_numpy(grey)[None], SAMPLES)[0]
        image = noisy(blurred(image, blur), noise, rng or np.random.default_rng(0))
        return (255 * image.clamp(0, 1)).round().byte().numpy()
