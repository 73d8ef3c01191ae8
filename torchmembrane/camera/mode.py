"""Camera modes: a cropped part of the image that was calibrated, with its pixels binned in blocks."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..errors import expect


class Mode(NamedTuple):
    """How a camera's images are obtained from those it was calibrated with: cropped, then binned.

    A block of `b x c` pixels of the crop becomes one pixel, their mean. With pixel centres at integers, the position `u`
    becomes `(u - left - (b - 1) / 2) / b`. Distortion, ports and all quantities that are angles do not change.

    Attributes:
        image_size: width and height of the calibrated image, px.
        focal: calibrated focal lengths along u and v, px (fisheye: px / rad).
        centre: calibrated principal point, px.
        crop: left, top, width and height of the part that is kept, px of the calibrated image.
        binning: width and height of a block, px.

    Limitations:
        A chip that skips lines instead of averaging them shows the block's first pixel, `(b - 1) / (2 b)` px beside its middle.

    Example:
        >>> mode = Mode((640, 480), (400.0, 400.0), (320.0, 240.0), (80, 0, 480, 480), (2, 2))
        >>> mode.size, mode.binned_focal, mode.binned_centre
        ((240, 240), (200.0, 200.0), (119.75, 119.75))
    """

    image_size: tuple[int, int]
    focal: tuple[float, float]
    centre: tuple[float, float]
    crop: tuple[int, int, int, int]
    binning: tuple[int, int]

    @classmethod
    def from_camera(
        cls,
        image_size: tuple[int, int],
        focal: Sequence[float],
        centre: Sequence[float],
        crop: Sequence[float],
        binning: Sequence[float],
    ) -> "Mode":
        """Return the mode with these values after checking them.

        Raises:
            MembraneError: the crop exceeds the image, or the blocks do not fill it.

        Example:
            >>> Mode.from_camera((640, 480), (400.0, 400.0), (320.0, 240.0), (0, 0, 640, 480), (3, 3))
            Traceback (most recent call last):
            ...
            torchmembrane.errors.MembraneError: Camera: binning is [3, 3]; expected whole numbers of 1 or more that divide the \
width and height of the crop, 640 x 480: crop = [0, 0, 639, 480] would do
        """
        crop, binning, (width, height) = list(crop), list(binning), image_size
        inside = _is_whole(crop, 4) and min(crop[:2]) >= 0 and min(crop[2:]) >= 1
        inside = inside and crop[0] + crop[2] <= width and crop[1] + crop[3] <= height
        expected = f"left, top, width, height in whole px, within the calibrated image of {width} x {height}"
        expect(inside, "Camera: crop", crop, expected)
        whole = _is_whole(binning, 2) and min(binning) >= 1
        filled = [size // b * b for size, b in zip(crop[2:], binning, strict=True)] if whole else []
        remedy = f": crop = {crop[:2] + filled} would do" if whole and min(filled) >= 1 else ""
        expected = f"whole numbers of 1 or more that divide the width and height of the crop, {crop[2]} x {crop[3]}{remedy}"
        expect(filled == crop[2:], "Camera: binning", binning, expected)
        left, top, width, height = map(int, crop)
        return cls(
            image_size,
            (focal[0], focal[1]),
            (centre[0], centre[1]),
            (left, top, width, height),
            (int(binning[0]), int(binning[1])),
        )

    @property
    def size(self) -> tuple[int, int]:
        """Return the width and height of the mode's images, px."""
        return self.crop[2] // self.binning[0], self.crop[3] // self.binning[1]

    @property
    def binned_focal(self) -> tuple[float, float]:
        """Return the focal lengths along u and v, px of the mode (fisheye: px / rad)."""
        return self.focal[0] / self.binning[0], self.focal[1] / self.binning[1]

    @property
    def binned_centre(self) -> tuple[float, float]:
        """Return the principal point, px of the mode."""
        u, v = ((c - first - (b - 1) / 2) / b for c, first, b in zip(self.centre, self.crop[:2], self.binning, strict=True))
        return u, v

    def image(self, image: np.ndarray) -> np.ndarray:
        """Crop and bin an image of the calibrated size as this mode does.

        Args:
            image: grey image, `[height, width]`.

        Returns:
            The image in this mode, `[height, width]`, float32.

        Raises:
            MembraneError: the image has another size.

        Example:
            >>> mode = Mode((4, 2), (1.0, 1.0), (0.0, 0.0), (2, 0, 2, 2), (2, 2))
            >>> mode.image(np.array([[9.0, 9, 1, 2], [9, 9, 3, 4]])).tolist()
            [[2.5]]
        """
        expected = f"the calibrated [{self.image_size[1]}, {self.image_size[0]}], height and width"
        expect(image.shape == self.image_size[::-1], "Mode.image: shape", list(image.shape), expected)
        left, top, width, height = self.crop
        part = image[top : top + height, left : left + width].astype(np.float64)
        blocks = part.reshape(self.size[1], self.binning[1], self.size[0], self.binning[0])
        return np.asarray(blocks.mean((1, 3))).astype(np.float32)


def _is_whole(values: Sequence[float], count: int) -> bool:
    return len(values) == count and all(float(value).is_integer() for value in values)
