"""Images of several views, each of which has its own, as one grey batch."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import MembraneError
from ..files.grayscale import Channels, to_grayscale_batch
from ..files.images import read_image
from .views import View


def grey_views(images: Any, views: Sequence[View], channels: Channels, like: Tensor) -> Tensor:
    """Grey images `[B, W, height, width]` in 0..1; the image of a smaller view is dark beyond its own size.

    Args:
        images: images of W views, those of the first view first: a list of W batches, each as `to_grayscale_batch` takes them;
            or stacked, `[W, height, width]` or `[B, W, height, width]`, colour with its three channels last.
        views: views of the sensor.
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
        if not has_colours:  # a stack may be as large as the largest view
            sizes = [view.camera.image_size for view in views]
            images = [batch[..., :height, :width] for batch, (width, height) in zip(images, sizes, strict=True)]
    if len(images) != count:
        raise MembraneError(f"images of {len(images)} views; expected {count}: {', '.join(view.name for view in views)}")
    each = [
        to_grayscale_batch(_as_batch(batch), view.camera.image_size, channels, like, view.camera.bits)
        for batch, view in zip(images, views, strict=True)
    ]
    frames = [len(batch) for batch in each]
    if len(set(frames)) > 1:
        raise MembraneError(f"images: {frames} frames of the views; expected the same number of each")
    height, width = (max(batch.shape[axis] for batch in each) for axis in (-2, -1))
    return torch.cat([F.pad(batch, (0, width - batch.shape[-1], 0, height - batch.shape[-2])) for batch in each], 1)


def read_views(path: Path, views: Sequence[View], like: Tensor) -> Tensor:
    """A frame's images of all views, `[1, W, height, width]`, as of `grey_views`.

    Args:
        path: path of the first view's image, as of `view_files`.
        views: views of the sensor.
        like: a tensor of the precision and device.

    Raises:
        MembraneError: the file is not named after the first view, or a view's cannot be read.
    """
    files = view_files(path, [view.name for view in views])
    images = [read_image(file, view.camera.image_size, view.camera.bits) for file, view in zip(files, views, strict=True)]
    return grey_views(images, views, "rgb", like)


def view_files(path: Path, names: Sequence[str]) -> list[Path]:
    """The image files of a frame, of all views.

    Args:
        path: path of the first view's image, NAME_VIEW and an ending; the others have the same name and ending with the name of
            their view.
        names: names of the views that have images of their own; none of one view, or of regions of one image.

    Raises:
        MembraneError: the file is not named after the first view.

    Example:
        >>> [file.name for file in view_files(Path("press_left.png"), ["left", "right"])]
        ['press_left.png', 'press_right.png']
    """
    if not names:
        return [path]
    first = f"_{names[0]}"
    if not path.stem.endswith(first):
        raise MembraneError(f"{path}: expected the first view's image, NAME{first}{path.suffix}, beside those of the others")
    stem = path.stem.removesuffix(first)
    return [path.with_name(f"{stem}_{name}{path.suffix}") for name in names]


def first_view_image(grey: Tensor, views: Sequence[View]) -> Tensor:
    """The first view's image `[height, width]` of the grey image `[1, C, ...]` of a frame; that of a sensor with one view."""
    left, top = (views[0].region or (0, 0))[:2] if views else (0, 0)
    width, height = views[0].camera.image_size if views else (grey.shape[-1], grey.shape[-2])
    return grey[0, 0, top : top + height, left : left + width]


def _as_batch(images: Any) -> Any:
    """Three grey frames `[3, H, W]` as such, which are no colours here."""
    return images[:, None] if images.ndim == 3 and images.shape[-1] != 3 else images
