"""Lens and ports from images of a flat target in several poses (section 5.2)."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call, jacfwd, vmap

from ..camera.model import Camera
from ..camera.targets import Checkerboard, DotBoard
from ..errors import MembraneError, check_arguments
from .fit import Fit, fit, outliers, outline_centres, rotations
from .poses import lens_and_poses, port_pose

LENS = ("focal", "centre", "distortion")
PORTS = ("port_distance", "port_thickness", "port_index", "medium_index")

DESIGN = {"port_distance": 0.2, "port_thickness": 0.2, "port_index": 0.1, "medium_index": 0.1}
"""Relative standard deviation of the sensor file's values: what views leave open stays near them, with this uncertainty."""
LOCATION_NOISE = 0.05  # px, of a point found in an image, before it is known
ROUNDS = 2  # of leaving out mistakes


class Views(NamedTuple):
    """A board in P poses before the camera.

    Attributes:
        pixels: `[P, D, 2]` where its points are in the images, px, NaN where not visible.
        filled: `[P]` bool: with the medium behind the last port; else with air.
    """

    pixels: np.ndarray
    filled: np.ndarray


class CameraFit(NamedTuple):
    """A fitted camera.

    Attributes:
        camera: the camera.
        names: names of the n numbers that were fitted.
        fit: fit of these numbers, which come first, and then of 6 of each pose.
        poses: `[P, 6]` rotation vectors (rad) and translations (length unit) of the board.
        residuals: `[P, D, 2]` px, measured less modelled, NaN where not used.
    """

    camera: Camera
    names: list[str]
    fit: Fit
    poses: np.ndarray
    residuals: np.ndarray


@check_arguments
def lens_from_views(camera: Camera, board: Checkerboard, views: Views) -> CameraFit:
    """Focal lengths, centre and distortion, all coefficients of the camera's model, from views of a board in air.

    Of a pinhole these are five, or eight where the first guess has eight, zeros for example.

    OpenCV gives the start, Gauss-Newton on this package's own camera the answer and its uncertainty. Ports of `camera` are
    taken as not yet mounted; they are in the camera that is returned.

    Args:
        camera: a first guess: model, image size, focal lengths, centre.
        board: the board.
        views: at least three, better ten, in different poses.

    Returns:
        The camera with its lens, and the fit.

    Raises:
        MembraneError: too few views, or no lens fits them; OpenCV is not installed.

    Example:
        >>> board, true = Checkerboard(6, 5, 3.0), Camera("pinhole", (320, 240), (150.0, 151.0), (161.0, 119.0))
        >>> turns = torch.tensor([[0.3, 0.0, 0.0], [0.0, 0.4, 0.2], [-0.3, 0.2, 0.0], [0.1, -0.4, 0.1]], dtype=torch.float64)
        >>> middle, distance = torch.tensor([7.5, 6.0, 0.0]), torch.tensor([0.0, 0.0, 22.0])
        >>> points = (torch.from_numpy(board.points) - middle) @ rotations(turns).mT + distance
        >>> guess = Camera("pinhole", (320, 240), (140.0, 140.0), (160.0, 120.0))
        >>> views = Views(true.point_to_pixel(points).numpy(), np.zeros(4, bool))
        >>> lens_from_views(guess, board, views).camera.focal.numpy().round(3)
        array([150., 151.])
    """
    none = [0.0] * len(camera.distortion)
    bare = Camera(camera.model, camera.image_size, camera.focal.tolist(), camera.centre.tolist(), none)
    start, poses = lens_and_poses(bare, board, views.pixels)
    found = _fit_camera(_BoardProblem(start, board, views, LENS, {}), poses, "calibrate camera")
    values = {name: getattr(found.camera, name).tolist() for name in LENS}
    known: dict[str, Any] = dict(ports=camera.ports, medium_index=float(camera.medium_index), bits=camera.bits)
    return found._replace(camera=Camera(camera.model, camera.image_size, **values, **known))


@check_arguments
def ports_from_views(camera: Camera, board: DotBoard, views: Views, held: Sequence[str] = ()) -> CameraFit:
    """Distance, thickness and index of every port, and the medium's index, from views of a dot board through them.

    Args:
        camera: a first guess of ports and medium, with a lens that is taken as known.
        board: the board.
        views: in air, in the medium, best both.
        held: those of `PORTS` that stay as they are in `camera`.

    Returns:
        The camera with its ports, and the fit.

    Raises:
        MembraneError: the camera has no ports, `held` names something else, or a view shows too few dots.

    Limitations:
        In air a plate shifts every ray by a length that depends neither on its distance nor on the medium; in a medium its
        thickness and index are not identifiable one by one (docs/calibration.md). Give views of both.

    Example:
        >>> lens = "pinhole", (320, 240), (150.0, 150.0), (160.0, 120.0)
        >>> true, guess = (Camera(*lens, ports=[(d, 3.0, 1.49)], medium_index=1.33) for d in (4.0, 4.2))
        >>> board = DotBoard(9, 7, 2.0)
        >>> points = torch.from_numpy(board.points) @ rotations(torch.tensor([0.4, 0.3, 0.0]).double()).mT
        >>> pixels = true.point_to_pixel(points + torch.tensor([0.0, 0.0, 20.0])).numpy()
        >>> found = ports_from_views(guess, board, Views(pixels[None], np.ones(1, bool)), PORTS[1:])
        >>> found.names, round(found.camera.ports[0].distance, 1)
        (['port_distance'], 4.0)
    """
    if not camera.ports:
        raise MembraneError("calibrate ports: the sensor has no ports; expected [[camera.ports]] with design values")
    if unknown := set(held) - set(PORTS):
        raise MembraneError(f"calibrate ports: {sorted(unknown)[0]!r} cannot be held; expected some of {', '.join(PORTS)}")
    free = [name for name in PORTS if name not in held and (name != "medium_index" or views.filled.any())]
    in_air = _with(camera, {"medium_index": torch.ones(())})
    cameras = [camera if filled else in_air for filled in views.filled]
    poses = np.stack([port_pose(seen_by, board, pixels) for seen_by, pixels in zip(cameras, views.pixels, strict=True)])
    return _fit_camera(_BoardProblem(camera, board, views, free, DESIGN), poses, "calibrate ports")


def _fit_camera(problem: "_BoardProblem", poses: np.ndarray, what: str) -> CameraFit:
    """The problem's least squares from its own camera and `poses [P, 6]`, mistaken points left out."""
    theta = np.concatenate([problem.start, poses.ravel()])
    problem.leave_out_unseen(theta)
    for _ in range(ROUNDS):
        theta = fit(problem.residuals, problem.jacobian, theta, what).values
        problem.leave_out_outliers(theta)
    found = fit(problem.residuals, problem.jacobian, theta, what)
    _, found_poses, _ = problem.parts(found.values)
    return CameraFit(
        problem.camera_of(found.values), problem.names, found, found_poses.numpy(), problem.pixel_residuals(found.values)
    )


class _BoardProblem:
    """Least squares for numbers of a camera and the poses of a board, `theta = (numbers [n], poses [P, 6])`.

    Residuals: pixels of all points used, modelled less measured, and before them the numbers' distance from the first guess,
    weighted as pixels, for those whose standard deviation is given.

    Args:
        camera: the first guess.
        board: the board.
        views: what was measured.
        free: names of the camera's buffers that are unknown.
        spread: relative standard deviation of the first guess of some of them, one more datum each.
    """

    def __init__(
        self, camera: Camera, board: Checkerboard | DotBoard, views: Views, free: Sequence[str], spread: Mapping[str, float]
    ):
        self.camera = camera
        self.shapes = {name: getattr(camera, name).shape for name in free}
        self.lengths = [max(1, shape.numel()) for shape in self.shapes.values()]
        guess = {name: getattr(camera, name).numpy().ravel() for name in free}
        self.start = np.concatenate(list(guess.values()))
        self.design_precision = np.concatenate([1 / (values * spread.get(name, np.inf)) for name, values in guess.items()])
        self.design_weight = self.design_precision * LOCATION_NOISE
        self.count = len(self.start)
        self.outlines, self.pixels = torch.from_numpy(board.outlines), torch.from_numpy(views.pixels)
        self.filled = torch.from_numpy(views.filled)
        self.visible = torch.from_numpy(np.isfinite(views.pixels).all(-1))
        self.used = self.visible.clone()
        self._all_views = vmap(self._modelled, (None, 0, 0))
        self._derivatives = vmap(jacfwd(self._modelled, (0, 1)), (None, 0, 0))

    @property
    def names(self) -> list[str]:
        """Names of the camera's numbers, `[n]`."""
        return [
            name if shape.numel() == 1 else f"{name}[{i}]" for name, shape in self.shapes.items() for i in range(shape.numel())
        ]

    def camera_of(self, theta: np.ndarray) -> Camera:
        """The camera with these numbers."""
        shared, _, _ = self.parts(theta)
        return _with(self.camera, dict(zip(self.shapes, shared.split(self.lengths), strict=True)))

    def parts(self, theta: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """Numbers of the camera `[n]`, poses `[P, 6]`, and which views are filled `[P]`."""
        values = torch.from_numpy(theta)
        return values[: self.count], values[self.count :].view(-1, 6), self.filled

    def pixel_residuals(self, theta: np.ndarray) -> np.ndarray:
        """Measured less modelled, `[P, D, 2]`, NaN where not used."""
        left = self.pixels - self._all_views(*self.parts(theta))
        return torch.where(self.used[..., None], left, torch.nan).numpy()

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        apart = (theta[: self.count] - self.start) * self.design_weight
        return np.concatenate([apart, (self._all_views(*self.parts(theta)) - self.pixels)[self.used].numpy().ravel()])

    def jacobian(self, theta: np.ndarray) -> np.ndarray:
        by_shared, by_pose = self._derivatives(*self.parts(theta))
        count, (P, D) = self.count, self.used.shape
        J = torch.zeros(P, D, 2, count + 6 * P, dtype=torch.float64)
        J[..., :count] = by_shared
        for view in range(P):
            J[view, ..., count + 6 * view : count + 6 * view + 6] = by_pose[view]
        rows = np.zeros((count, J.shape[-1]))
        rows[:, :count] = np.diag(self.design_weight)
        return np.concatenate([rows, J[self.used].flatten(0, 1).numpy()])

    def leave_out_unseen(self, theta: np.ndarray) -> None:
        """Leave out points that the camera of the first guess cannot image."""
        self.used &= self._all_views(*self.parts(theta)).isfinite().all(-1)

    def leave_out_outliers(self, theta: np.ndarray) -> None:
        """Leave out points that are mistakes, take in those that are none, and weight the first guess by the noise found."""
        left = (self._all_views(*self.parts(theta)) - self.pixels)[self.visible].numpy()
        mistaken = outliers(left)
        self.design_weight = self.design_precision * np.median(np.abs(left[~mistaken])) / 0.6745
        self.used[self.visible] = torch.from_numpy(~mistaken)

    def _modelled(self, shared: Tensor, pose: Tensor, filled: Tensor) -> Tensor:
        """Where one view has the board's points, `[D, 2]`."""
        parts = zip(self.shapes.items(), shared.split(self.lengths), strict=True)
        buffers = {name: part.view(shape) for (name, shape), part in parts}
        n = buffers.get("medium_index", self.camera.medium_index)
        buffers["medium_index"] = torch.where(filled, n, torch.ones_like(n))
        points = self.outlines @ rotations(pose[:3]).mT + pose[3:]
        return outline_centres(functional_call(self.camera, buffers, (points,)))


def _with(camera: Camera, values: Mapping[str, Tensor]) -> Camera:
    """The camera with other values of some buffers; raises `MembraneError` where they make none."""

    def get(name: str) -> list[float]:
        return values.get(name, getattr(camera, name)).reshape(-1).tolist()

    ports = list(zip(get("port_distance"), get("port_thickness"), get("port_index"), strict=True))
    lens = get("focal"), get("centre"), get("distortion")
    medium = get("medium_index")[0]
    return Camera(camera.model, camera.image_size, *lens, ports=ports, medium_index=medium, bits=camera.bits)
