"""What finds a sensor's markers in images: the contract of dots and texture."""

from typing import Protocol

from torch import Tensor


class Locator(Protocol):
    """Pixels of a sensor's markers in a batch of frames, with a confidence: a `torch.nn.Module` with these members.

    Implemented by `DotLocator` and `TextureLocator`; markers found by other means go to `Reconstructor.from_pixels`.

    Attributes:
        follows: whether `previous` is used, that is, whether markers are followed from frame to frame.
    """

    follows: bool

    def __call__(self, images: Tensor, previous: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Locate the markers.

        Args:
            images: `[B, 1, H, W]`, grey in 0..1.
            previous: `[B, D, 2]` pixels in the frames before, NaN where lost; without it, or where `follows` is false,
                markers are searched for from rest.

        Returns:
            Pixels `[B, D, 2]` (u right, v down) and confidence `[B, D]` in 0..1; a lost marker has confidence 0 and the
            pixel that its neighbours predict.
        """
        ...
