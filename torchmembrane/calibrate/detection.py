"""Detection of calibration targets: corners of a checkerboard by OpenCV, dots of a board by this package's detector."""

import heapq
from typing import Any

import numpy as np

from ..camera.targets import LARGE, MARKS, Checkerboard, DotBoard
from ..errors import MembraneError, check_arguments
from ..files.grayscale import check_image
from ..files.levels import too_few_bits
from ..files.optional import load_opencv
from ..markers.dots.pattern import find_dots

WINDOW = 0.35  # half width of the window in which a corner is refined, over the shortest side of a square
FAR_OFF = 10**6
FEWEST_CORNERS = 3  # in a row and in a column
STEP_ERROR = 0.35  # largest distance of a neighbour from its prediction, over the lattice step


@check_arguments
def find_target(image: np.ndarray, board: Checkerboard | DotBoard) -> np.ndarray:
    """Find the board's points in an image.

    Args:
        image: the grey image, `[H, W]`, in 0..1.
        board: the board that the image shows.

    Returns:
        Pixels `[D, 2]` in the order of `board.points`; NaN for dots that are not visible. A checkerboard must be visible
        completely.

    Raises:
        MembraneError: the image does not show the board, or OpenCV is not installed (needed for checkerboards).

    Example:
        >>> from torchmembrane.camera.model import Camera
        >>> from torchmembrane.simulate.target_renderer import TargetRenderer
        >>> board, camera = DotBoard(8, 6, 2.0), Camera("pinhole", (200, 150), (112.0, 112.0), (100.0, 75.0))
        >>> image = TargetRenderer.for_camera(camera).image(board, np.eye(3), np.array([-1.0, -1.0, 16.0]))
        >>> find_target(image / 255, board)[board.large].round(0)  # the three dots that mark the board's place and turn
        array([[ 93.,  68.],
               [135.,  68.],
               [ 93.,  96.]])
    """
    image = check_image("find_target: image", image)
    return _find_corners(image, board) if isinstance(board, Checkerboard) else _find_board_dots(image, board)


def _find_corners(image: np.ndarray, board: Checkerboard) -> np.ndarray:
    cv2 = load_opencv()
    grey, flags = np.rint(255 * image).astype(np.uint8), cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
    found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=flags)
    if not found:
        raise MembraneError(
            f"no checkerboard of {board.columns} x {board.rows} inner corners found; expected all of it in the image, sharp, "
            f"with a light margin{_other_board(grey, board)}{too_few_bits(image)}"
        )
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    lattice = corners.reshape(board.rows, board.columns, 2)
    gap = min(np.linalg.norm(np.diff(lattice, axis=axis), axis=-1).min() for axis in (0, 1))
    reach = int(np.clip(WINDOW * gap, 2, 10))
    corners = cv2.cornerSubPix(grey, np.ascontiguousarray(corners), (reach, reach), (-1, -1), criteria)
    return corners[:, 0].astype(float)


def _other_board(grey: np.ndarray, board: Checkerboard) -> str:
    """Return a hint for the message if the image shows another board, of at least one corner less per row and column than
    `board`: the user may have counted squares, not corners. Else return an empty text."""
    cv2, columns, rows = load_opencv(), board.columns - 1, board.rows - 1
    if min(columns, rows) < FEWEST_CORNERS:
        return ""
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_LARGER
    found, _, lattice = cv2.findChessboardCornersSBWithMeta(grey, (columns, rows), flags)
    if not found:
        return ""
    seen = lattice.shape[::-1] if lattice.shape == (rows, columns) else lattice.shape
    squares = f", that is {board.columns} x {board.rows} squares," if sorted(seen) == sorted((columns, rows)) else ""
    return (
        f"; one of {seen[0]} x {seen[1]} inner corners{squares} is there: count corners at which four squares meet, --corners "
        f"{seen[0]},{seen[1]}"
    )


def _find_board_dots(image: np.ndarray, board: DotBoard) -> np.ndarray:
    dots = find_dots(image, "dark")
    radius = np.sqrt(np.abs(np.linalg.det(dots.shapes)))
    steps = _lattice_steps(dots.pixels)
    large = _larger_than_neighbours(steps, radius)
    steps = _turned_to_marks(steps, large)
    pixels = np.full((len(board.points), 2), np.nan)
    row = {tuple(step): d for d, step in enumerate(board.steps)}
    for step, pixel in zip(steps, dots.pixels, strict=True):
        if tuple(step) in row:
            pixels[row[tuple(step)]] = pixel
    return pixels


def _lattice_steps(pixels: np.ndarray) -> np.ndarray:
    """Return the lattice steps `[N, 2]` of dots `[N, 2]` from the central one, best matches first; `FAR_OFF`: not reached."""
    start = int(np.linalg.norm(pixels - np.median(pixels, 0), axis=1).argmin())
    steps = np.full(pixels.shape, FAR_OFF)
    placed: set[int] = set()
    taken: set[tuple[int, int]] = set()
    front: list[tuple[Any, ...]] = [(0.0, start, (0, 0), _first_basis(pixels, start))]  # gap, dot, its steps, local basis
    while front:
        _, here, step, basis = heapq.heappop(front)
        if here in placed or step in taken:
            continue
        steps[here] = step
        placed.add(here)
        taken.add(step)
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            stride = sign * np.array(basis[axis])
            gap = np.linalg.norm(pixels - pixels[here] - stride, axis=1) / np.linalg.norm(stride)
            there = int(gap.argmin())
            if gap[there] < STEP_ERROR and there not in placed:
                turned = tuple(tuple(sign * (pixels[there] - pixels[here])) if k == axis else tuple(basis[k]) for k in (0, 1))
                next_step = (step[0] + sign * (axis == 0), step[1] + sign * (axis == 1))
                heapq.heappush(front, (float(gap[there]), there, next_step, turned))
    return steps


def _first_basis(pixels: np.ndarray, start: int) -> tuple[tuple[float, float], ...]:
    """Return the steps to two neighbours; in the image, the second is a clockwise quarter turn from the first."""
    offset = np.delete(pixels - pixels[start], start, 0)
    near = offset[np.linalg.norm(offset, axis=1).argsort()[:4]]
    first = near[0]
    cross = first[0] * near[:, 1] - first[1] * near[:, 0]
    return tuple(first), tuple(near[cross.argmax()])


def _larger_than_neighbours(steps: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return which dots are larger than those within two lattice steps by about the ratio of large dots, `[N]` bool."""
    near = np.abs(steps[:, None] - steps).max(-1) <= 2
    usual = np.array([np.median(radius[row]) for row in near])
    return (radius > LARGE**0.5 * usual) & (near.sum(1) > 3)


def _turned_to_marks(steps: np.ndarray, large: np.ndarray) -> np.ndarray:
    """Return the steps rotated and shifted such that the large dots are the board's marks."""
    quarter = np.array([[0, 1], [-1, 0]])
    for turn in range(4):
        turned = steps @ np.linalg.matrix_power(quarter, turn)
        marks = {tuple(step) for step in turned[large]}
        for origin in marks:
            if all((origin[0] + a, origin[1] + b) in marks for a, b in MARKS):
                return turned - np.array(origin)
    raise MembraneError(
        f"the board's three large dots are not recognised ({large.sum()} large dots found); expected all three in the image"
    )
