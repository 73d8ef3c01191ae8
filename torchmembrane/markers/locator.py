"""The interface of locators, which find a sensor's markers (dots or texture) in images."""

from typing import NamedTuple, Protocol

import torch
from torch import Tensor


class LocatedMarkers(NamedTuple):
    """A sensor's markers in a batch of frames.

    Attributes:
        pixels: `[B, D, 2]` (u right, v down); for a lost marker, the position that its neighbours predict.
        confidence: `[B, D]` in 0..1, 0 for a lost marker.
        covariance: covariance of the pixels over repeated images of the same markers, `[B, D, 2, 2]` px^2.
    """

    pixels: Tensor
    confidence: Tensor
    covariance: Tensor


def isotropic(like: Tensor, noise: float) -> Tensor:
    """Return the covariance `[..., 2, 2]` of pixels with standard deviation `noise` in u and v, for every entry of `like`.

    Example:
        >>> isotropic(torch.zeros(1), 0.5).tolist()
        [[[0.25, 0.0], [0.0, 0.25]]]
    """
    one = torch.eye(2, dtype=like.dtype, device=like.device)
    return (noise**2 * one).expand(*like.shape, 2, 2)


class Locator(Protocol):
    """The interface of a locator: a `torch.nn.Module` that returns the pixels of a sensor's markers with a confidence.

    It is implemented by `DotLocator` and `TextureLocator`; pass markers found by other means to `Reconstructor.from_pixels`.

    Attributes:
        follows: whether `previous` is used, so that markers are followed from frame to frame.
    """

    follows: bool

    def __call__(self, images: Tensor, previous: Tensor | None = None) -> LocatedMarkers:
        """Locate the markers.

        Args:
            images: `[B, 1, H, W]`, grey in 0..1.
            previous: `[B, D, 2]` pixels in the preceding frames, NaN where lost; without it, or if `follows` is false, the
                search starts from rest.
        """
        ...

    def be_exact(self) -> None:
        """Return pixels in double precision from now on, if the locator supports that; in other runtimes they are the same."""
        ...
