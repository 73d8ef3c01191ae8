"""What finds a sensor's markers in images: the contract of dots and texture."""

from typing import NamedTuple, Protocol

import torch
from torch import Tensor


class LocatedMarkers(NamedTuple):
    """A sensor's markers in a batch of frames.

    Attributes:
        pixels: `[B, D, 2]` (u right, v down); of a lost marker what its neighbours predict.
        confidence: `[B, D]` in 0..1; a lost marker has 0.
        covariance: of the pixels, `[B, D, 2, 2]` px^2: what another image of the same markers would change.
    """

    pixels: Tensor
    confidence: Tensor
    covariance: Tensor


def isotropic(like: Tensor, noise: float) -> Tensor:
    """The covariance `[..., 2, 2]` of pixels with the same standard deviation `noise` in u and v, for every entry of `like`.

    Example:
        >>> isotropic(torch.zeros(1), 0.5).tolist()
        [[[0.25, 0.0], [0.0, 0.25]]]
    """
    one = torch.eye(2, dtype=like.dtype, device=like.device)
    return (noise**2 * one).expand(*like.shape, 2, 2)


class Locator(Protocol):
    """Pixels of a sensor's markers in a batch of frames, with a confidence: a `torch.nn.Module` with these members.

    Implemented by `DotLocator` and `TextureLocator`; markers found by other means go to `Reconstructor.from_pixels`.

    Attributes:
        follows: whether `previous` is used, that is, whether markers are followed from frame to frame.
    """

    follows: bool

    def __call__(self, images: Tensor, previous: Tensor | None = None) -> LocatedMarkers:
        """Locate the markers.

        Args:
            images: `[B, 1, H, W]`, grey in 0..1.
            previous: `[B, D, 2]` pixels in the frames before, NaN where lost; without it, or where `follows` is false,
                markers are searched for from rest.
        """
        ...

    def be_exact(self) -> None:
        """From now on, tell pixels in double precision, where that means anything: in other runtimes the same."""
        ...
