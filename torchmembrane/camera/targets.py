"""Flat calibration targets: checkerboards and dot boards. Frame: x right, y down as printed, z away from the viewer."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..errors import MembraneError, check_arguments

OUTLINE = 8  # number of points on a dot's outline
MARKS = ((0, 0), (3, 0), (0, 2))  # large dots, in steps from the middle one; they show position and rotation of a part too
LARGE = 1.7  # radius of a large dot over that of a small one


@check_arguments
@dataclass(frozen=True)
class Checkerboard:
    """A checkerboard; the corner before the first inner one belongs to a dark square.

    Args:
        columns: number of columns of inner corners.
        rows: number of rows of inner corners.
        square: side of a square, length unit.

    Raises:
        MembraneError: there are fewer than 3 x 3 inner corners, or the length is not positive.

    Example:
        >>> Checkerboard(3, 3, 5.0).points[:2].tolist()
        [[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]
    """

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        _expect(
            self, self.columns >= 3 and self.rows >= 3 and self.square > 0, "3 x 3 inner corners or more, a positive length"
        )

    @cached_property
    def points(self) -> np.ndarray:
        """Return the inner corners row by row, `[D, 3]`, the first one at the origin."""
        return self.square * _lattice(self.columns, self.rows)

    @property
    def outlines(self) -> np.ndarray:
        """Return each point as an outline of one point, `[D, 1, 3]`."""
        return self.points[:, None]

    def reflectance(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the printed reflectance at `x, y`: 0.1 on dark squares, 0.9 on light ones and the margin."""
        i, j = np.floor(x / self.square), np.floor(y / self.square)
        inside = (i >= -1) & (i < self.columns) & (j >= -1) & (j < self.rows)
        return np.where(inside & ((i + j) % 2 == 0), 0.1, 0.9)

    @property
    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper corners of the printed page, `[2]` each."""
        return np.full(2, -2.0 * self.square), self.square * np.array([self.columns + 1, self.rows + 1.0])


@check_arguments
@dataclass(frozen=True)
class DotBoard:
    """A board of dots, three of which are larger and show its position and rotation.

    Args:
        columns: number of columns of dots.
        rows: number of rows of dots.
        pitch: distance between the centres of neighbouring dots, length unit.
        radius: radius of the small dots, length unit; default: 0.22 pitches.

    Raises:
        MembraneError: there are fewer than 8 x 6 dots, the pitch is not positive, or dots touch.

    Example:
        >>> board = DotBoard(9, 7, 2.0)
        >>> board.points[board.large].tolist()
        [[0.0, 0.0, 0.0], [6.0, 0.0, 0.0], [0.0, 4.0, 0.0]]
    """

    columns: int
    rows: int
    pitch: float
    radius: float = None  # type: ignore[assignment]  # 0.22 pitches once constructed

    def __post_init__(self) -> None:
        right = self.columns >= 8 and self.rows >= 6 and self.pitch > 0
        _expect(self, right, "8 x 6 dots or more, a positive pitch")
        if self.radius is None:
            object.__setattr__(self, "radius", 0.22 * self.pitch)
        _expect(self, 0 < LARGE * self.radius < 0.45 * self.pitch, "a radius below 0.26 pitches, so that no dots touch")

    @cached_property
    def steps(self) -> np.ndarray:
        """Return the integer steps `[D, 2]` from the middle dot to each dot, row by row."""
        return _lattice(self.columns, self.rows)[:, :2].astype(int) - [(self.columns - 1) // 2, (self.rows - 1) // 2]

    @cached_property
    def points(self) -> np.ndarray:
        """Return the dots' centres, `[D, 3]`; the origin is the middle dot, the first of the large ones."""
        return np.pad(self.pitch * self.steps, ((0, 0), (0, 1))).astype(float)

    @cached_property
    def large(self) -> np.ndarray:
        """Return which dots are large, `[D]` bool."""
        large: np.ndarray = (self.steps[:, None] == np.array(MARKS)).all(-1).any(1)
        return large

    @property
    def radii(self) -> np.ndarray:
        """Return the radii of the dots, `[D]`."""
        return self.radius * np.where(self.large, LARGE, 1.0)

    @cached_property
    def outlines(self) -> np.ndarray:
        """Return points around each dot, `[D, 8, 3]`; the centre of the imaged outline is not the image of the dot's centre."""
        angle = 2 * np.pi * np.arange(OUTLINE) / OUTLINE
        circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
        outlines: np.ndarray = self.points[:, None] + self.radii[:, None, None] * circle
        return outlines

    def reflectance(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the printed reflectance at `x, y`: 0.1 on dots, 0.9 elsewhere."""
        i, j = np.rint(x / self.pitch), np.rint(y / self.pitch)
        first, last = self.steps.min(0), self.steps.max(0)
        here = (i >= first[0]) & (i <= last[0]) & (j >= first[1]) & (j <= last[1])
        marked = np.any([(i == a) & (j == b) for a, b in MARKS], 0)
        radius = self.radius * np.where(marked, LARGE, 1.0)
        return np.where(here & (np.hypot(x - i * self.pitch, y - j * self.pitch) < radius), 0.1, 0.9)

    @property
    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper corners of the printed page, `[2]` each."""
        return self.pitch * (self.steps.min(0) - 1.0), self.pitch * (self.steps.max(0) + 1.0)


def _lattice(columns: int, rows: int) -> np.ndarray:
    """Return integer coordinates `[D, 3]` of a lattice in the plane z = 0, row by row."""
    j, i = np.mgrid[:rows, :columns]
    return np.stack([i.ravel(), j.ravel(), 0 * i.ravel()], -1).astype(float)


def _expect(board: Checkerboard | DotBoard, right: bool, expected: str) -> None:
    if not right:
        raise MembraneError(f"{board}; expected {expected}")
