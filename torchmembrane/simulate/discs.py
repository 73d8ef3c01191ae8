"""Draw the tips of pins into an image, as discs in front of everything else."""

import torch
from torch import Tensor

from .pattern import inside_unit_disc


def draw_discs(image: Tensor, centres: Tensor, radii: Tensor, grey: Tensor) -> None:
    """Draw discs one after another.

    Args:
        image: image of samples, `[H, W]`; it is modified.
        centres: centres of the discs, `[T, 2]`, samples.
        radii: two across each other as they are imaged, `[T, 2, 2]`: radius, then u and v; what lies between is linear.
        grey: grey value of the discs, `[T]`.

    Example:
        >>> image = torch.ones(3, 5)
        >>> draw_discs(image, torch.tensor([[1.0, 1.0]]), torch.eye(2)[None], torch.zeros(1))
        >>> image[1].tolist()
        [0.5, 0.0, 0.5, 1.0, 1.0]
    """
    size = centres.new_tensor(image.shape[::-1])
    half = radii.square().sum(1).sqrt() + 1
    starts, ends = (centres - half).floor().clamp_min(0), (centres + half).ceil().minimum(size - 1)
    for centre, radius, tone, start, end in zip(centres, radii, grey, starts, ends, strict=True):
        (left, top), (right, bottom) = start.long().tolist(), end.long().tolist()
        patch = image[top : bottom + 1, left : right + 1]
        v, u = torch.meshgrid(
            *(torch.arange(low, high + 1, device=image.device) for low, high in ((top, bottom), (left, right))), indexing="ij"
        )
        slope = torch.linalg.inv(radius.mT)
        place = (torch.stack([u, v], -1).flatten(0, 1).to(centre) - centre) @ slope.mT
        covered = inside_unit_disc(place, slope.expand(len(place), 2, 2)).view(patch.shape).to(patch)
        patch += covered * (tone.to(patch) - patch)
