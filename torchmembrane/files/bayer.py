"""Demosaicing of Bayer images, in which each pixel measures one colour of a 2 x 2 pattern."""

import numpy as np
from scipy.ndimage import correlate

PATTERNS = ("rggb", "bggr", "gbrg", "grbg")
CROSS = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4
"""Bilinear weights for green: the pixel's own value, or the mean of four neighbours."""
SQUARE = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4
"""Bilinear weights for red or blue: the pixel's own value, or the mean of two or four neighbours."""


def demosaiced(mosaic: np.ndarray, pattern: str) -> np.ndarray:
    """Return red, green and blue for every pixel; the two missing colours are interpolated bilinearly, which shifts no edge.

    Args:
        mosaic: raw image `[height, width]`, at least 2 x 2 pixels, floating point.
        pattern: one of `PATTERNS`: the colours of the first two pixels of the image and of the two pixels below them.

    Returns:
        Colour image `[height, width, 3]` in the value range of the mosaic.

    Example:
        >>> demosaiced(np.array([[0.8, 0.4], [0.4, 0.2]]), "rggb")[0, 0].tolist()
        [0.8, 0.4, 0.2]
    """
    padded = np.pad(mosaic, 1, mode="reflect")  # keeps the pattern across the border
    planes = []
    for colour in "rgb":
        own = np.zeros_like(padded)
        for k in (k for k in range(4) if pattern[k] == colour):
            pixels = np.s_[1 - k // 2 :: 2, 1 - k % 2 :: 2]
            own[pixels] = padded[pixels]
        planes.append(correlate(own, CROSS if colour == "g" else SQUARE))
    return np.stack(planes, -1)[1:-1, 1:-1]
