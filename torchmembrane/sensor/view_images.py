"""Combine the images of several views, each of which has its own, into one grey batch."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import MembraneError
from ..files.grayscale import Channels, image_tensor, to_grayscale_batch
from ..files.images import IMAGES, VIDEOS, read_image
from .views import View


class MomentImages(NamedTuple):
    """The images of all W views of one frame, `grey` `[1, W, height, width]`, and the reason for each missing one, by view."""

    grey: Tensor
    lacking: dict[str, str]


def grey_views(images: Any, views: Sequence[View], channels: Channels, like: Tensor) -> Tensor:
    """Combine the views' images into one grey batch `[B, W, height, width]` in 0..1.

    Images smaller than the largest are padded with black. The image of a view without an image is NaN, so that the view is
    ignored.

    Args:
        images: images of the W views in the order of `views`: a list of W batches, each as `to_grayscale_batch` takes them, or
            None for a view without images; or stacked, `[W, height, width]` or `[B, W, height, width]`, for colour with the
            three channels last.
        views: views of the sensor.
        channels: order of the channels of colour images.
        like: a tensor of the wanted precision and device.

    Raises:
        MembraneError: the number of views is wrong, the views have different numbers of frames, or none has images.
    """
    count = len(views)
    if not isinstance(images, list | tuple):
        stacked = image_tensor(images)
        has_colours = stacked.ndim >= 4 and stacked.shape[-1] == 3
        axis = stacked.ndim - 3 - has_colours
        if axis not in (0, 1) or stacked.shape[axis] != count:
            expected = (
                f"a list of {count} batches, or [B, {count}, H, W], for the views {', '.join(view.name for view in views)}"
            )
            raise MembraneError(f"images {list(stacked.shape)}; expected {expected}")
        images = stacked.unbind(axis)
        if not has_colours:  # smaller views may be padded in the stack
            sizes = [view.camera.image_size for view in views]
            images = [batch[..., :height, :width] for batch, (width, height) in zip(images, sizes, strict=True)]
    if len(images) != count:
        raise MembraneError(f"images of {len(images)} views; expected {count}: {', '.join(view.name for view in views)}")
    given = {
        w: to_grayscale_batch(_as_batch(batch), view.camera.image_size, channels, like, view.camera.bits)
        for w, (batch, view) in enumerate(zip(images, views, strict=True))
        if batch is not None
    }
    frames = [len(batch) for batch in given.values()]
    if len(set(frames)) != 1:
        raise MembraneError(f"images: {frames} frames of the views; expected the same number of each, of one view at least")
    sizes = [view.camera.image_size for view in views]
    each = [given.get(w, like.new_full((frames[0], 1, *sizes[w][::-1]), torch.nan)) for w in range(count)]
    height, width = (max(batch.shape[axis] for batch in each) for axis in (-2, -1))
    return torch.cat([F.pad(batch, (0, width - batch.shape[-1], 0, height - batch.shape[-2])) for batch in each], 1)


def read_views(path: Path, views: Sequence[View], like: Tensor) -> MomentImages:
    """Read the images of all views of one frame; see `grey_views`.

    Args:
        path: path of the first view's image, named as for `view_files`.
        views: views of the sensor.
        like: a tensor of the wanted precision and device.

    Raises:
        MembraneError: the file is not named after the first view, or no view's image can be read.
    """
    images: list[np.ndarray | None] = []
    lacking: dict[str, str] = {}
    for file, view in zip(view_files(path, [view.name for view in views]), views, strict=True):
        try:
            images.append(read_image(file, view.camera.image_size, view.camera.bits))
        except MembraneError as error:
            images.append(None)
            lacking[view.name] = str(error)
    if len(lacking) == len(views):
        raise MembraneError("; ".join(lacking.values()))
    return MomentImages(grey_views(images, views, "rgb", like), lacking)


def view_files(path: Path, names: Sequence[str]) -> list[Path]:
    """Return the paths of the images of all views of one frame.

    Args:
        path: path of the first view's image, `NAME_VIEW.ENDING`; the images of the other views differ in `VIEW`. A view whose
            file does not exist has the file with another ending, if there is exactly one.
        names: names of the views that have images of their own; empty for one view, or if views are regions of one image.

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
        raise MembraneError(
            f"{path}: the name does not end with {first!r}, the first view's; expected NAME{first}{path.suffix}, with the "
            "images of the other views beside it"
        )
    stem = path.stem.removesuffix(first)
    return [_existing(path.with_name(f"{stem}_{name}{path.suffix}")) for name in names]


def view_of(path: Path, names: Sequence[str]) -> str | None:
    """Return the view that a file NAME_VIEW belongs to, or None.

    Example:
        >>> view_of(Path("press_far_left.png"), ["left", "far_left"])
        'far_left'
    """
    return max((name for name in names if path.stem.endswith(f"_{name}")), key=len, default=None)


def _existing(path: Path) -> Path:
    """Return the path; if there is no such file, the only image or video of this name with another ending."""
    if path.exists() or not path.parent.is_dir():
        return path
    others = [other for ending in (*IMAGES, *VIDEOS) if (other := path.with_suffix(ending)).is_file()]
    return others[0] if len(others) == 1 else path


def first_view_image(grey: Tensor, views: Sequence[View]) -> Tensor:
    """Return the first view's image `[height, width]` from the grey images `[1, C, ...]` of a frame."""
    left, top = (views[0].region or (0, 0))[:2] if views else (0, 0)
    width, height = views[0].camera.image_size if views else (grey.shape[-1], grey.shape[-2])
    return grey[0, 0, top : top + height, left : left + width]


def first_view_picture(picture: np.ndarray | list[np.ndarray | None], views: Sequence[View]) -> np.ndarray | None:
    """Return the first view's region of a picture, or the first of a list of pictures; with one view, the whole picture."""
    if not isinstance(picture, np.ndarray):
        return picture[0]
    left, top, width, height = (views[0].region if views else None) or (0, 0, *picture.shape[1::-1])
    return picture[top : top + height, left : left + width]


def _as_batch(images: Any) -> Any:
    """Add a channel axis to frames `[B, H, W]`, so that three grey frames are not mistaken for one colour image."""
    return images[:, None] if images.ndim == 3 and images.shape[-1] not in (1, 3) else images
