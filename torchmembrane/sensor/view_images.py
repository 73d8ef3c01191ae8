"""Images of several views, each of which has its own, as one grey batch."""

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import MembraneError
from ..files.grayscale import Channels, grey_batch
from .views import View


def grey_views(images: Any, views: Sequence[View], channels: Channels, like: Tensor) -> Tensor:
    """Grey images `[B, W, height, width]` in 0..1; a smaller view's are dark beyond its own size.

    Args:
        images: of W views, the first view's first: a list of W batches, each as `grey_batch` takes them; or stacked,
            `[W, height, width]` or `[B, W, height, width]`, colour with its three channels last.
        views: of the sensor.
        channels: order of the channels of colour images.
        like: a tensor of the precision and device.

    Raises:
        MembraneError: another number of views, or of frames in one of them.
    """
    count = len(views)
    if not isinstance(images, list | tuple):
        given = torch.as_tensor(images) if not isinstance(images, Tensor) else images
        has_colours = given.ndim >= 4 and given.shape[-1] == 3
        axis = given.ndim - 3 - has_colours
        if axis not in (0, 1) or given.shape[axis] != count:
            expected = (
                f"a list of {count} batches, or [B, {count}, H, W], for the views {', '.join(view.name for view in views)}"
            )
            raise MembraneError(f"images {list(given.shape)}; expected {expected}")
        images = given.unbind(axis)
    if len(images) != count:
        raise MembraneError(f"images of {len(images)} views; expected {count}: {', '.join(view.name for view in views)}")
    each = [
        grey_batch(_as_batch(batch), view.camera.image_size, channels, like, view.camera.bits)
        for batch, view in zip(images, views, strict=True)
    ]
    frames = [len(batch) for batch in each]
    if len(set(frames)) > 1:
        raise MembraneError(f"images: {frames} frames of the views; expected the same number of each")
    height, width = (max(batch.shape[axis] for batch in each) for axis in (-2, -1))
    return torch.cat([F.pad(batch, (0, width - batch.shape[-1], 0, height - batch.shape[-2])) for batch in each], 1)


def _as_batch(images: Any) -> Any:
    """Three grey frames `[3, H, W]` as such, which are no colours here."""
    return images[:, None] if images.ndim == 3 and images.shape[-1] != 3 else images
