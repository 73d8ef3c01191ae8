"""Colours of cameras whose pixels measure one colour each, in a Bayer pattern of 2 x 2 pixels."""

import numpy as np
from scipy.ndimage import correlate

PATTERNS = ("rggb", "bggr", "gbrg", "grbg")
CROSS = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4
"""Weights of the green pixels around one: of its own value, or of four neighbours."""
SQUARE = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4
"""Weights of the red or blue values: of a pixel's own, of two neighbours, or of four."""


def demosaiced(mosaic: np.ndarray, pattern: str) -> np.ndarray:
    """Red, green and blue of every pixel; the two that it did not measure are interpolated bilinearly, which moves no edge.

    Args:
        mosaic: `[height, width]`, 2 x 2 or more, floating point.
        pattern: one of `PATTERNS`, the colours of the image's first two pixels and of the two below them.

    Returns:
        `[height, width, 3]`, the values in the range of the mosaic's.

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
