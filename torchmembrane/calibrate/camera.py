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
from ..torch_modes import on_cpu
from .fit import LARGEST_NOISE, Fit, fit, outliers, outline_centres, rotations
from .poses import lens_and_poses, port_pose

LENS = ("focal", "centre", "distortion")
PORTS = ("port_distance", "port_thickness", "port_index", "medium_index")

DESIGN = {"port_distance": 0.2, "port_thickness": 0.2, "port_index": 0.1, "medium_index": 0.1}
"""Relative standard deviation of the sensor file's values: values that views do not determine stay near these."""
LOCATION_NOISE = 0.05  # px, initial guess of the noise of a point found in an image
ROUNDS = 2  # of outlier rejection
FARTHEST_DESIGN = 4.0  # of a value from the file's, in its standard deviations


class Views(NamedTuple):
    """Images of a board in P poses.

    Attributes:
        pixels: positions of the board's D points in the images, `[P, D, 2]`, px; NaN where a point is not visible.
        filled: whether the medium, rather than air, is behind the last port, `[P]` bool.
    """

    pixels: np.ndarray
    filled: np.ndarray


class CameraFit(NamedTuple):
    """A fitted camera.

    Attributes:
        camera: the camera.
        names: names of the n camera parameters that were fitted.
        fit: fit of these parameters, followed by the 6 numbers of each pose.
        poses: rotation vectors (rad) and translations (length unit) of the board, `[P, 6]`.
        residuals: measured minus modelled pixels, `[P, D, 2]`; NaN where not used.
    """

    camera: Camera
    names: list[str]
    fit: Fit
    poses: np.ndarray
    residuals: np.ndarray


@check_arguments
@on_cpu
def lens_from_views(camera: Camera, board: Checkerboard, views: Views) -> CameraFit:
    """Fit focal lengths, centre and all distortion coefficients of the camera's model to views of a board in air.

    A pinhole camera has five distortion coefficients, or eight if the first guess has eight (they may be zeros).

    OpenCV gives the start; least squares with this package's camera model gives the result and its uncertainty. The fit assumes
    that the ports of `camera` are not mounted yet; the returned camera has them.

    Args:
        camera: a first guess: model, image size, focal lengths, centre.
        board: the board.
        views: at least three views, better ten, in different poses.

    Returns:
        The camera with its lens, and the fit.

    Raises:
        MembraneError: there are too few views, no lens fits them to `LARGEST_NOISE`, or OpenCV is not installed.

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
@on_cpu
def ports_from_views(camera: Camera, board: DotBoard, views: Views, held: Sequence[str] = ()) -> CameraFit:
    """Fit distance, thickness and refractive index of every port, and the medium's index, to views of a dot board.

    Args:
        camera: a first guess of ports and medium, with a calibrated lens.
        board: the board.
        views: views in air, in the medium, or best in both.
        held: names from `PORTS` whose values stay as in `camera`.

    Returns:
        The camera with its ports, and the fit.

    Raises:
        MembraneError: the camera has no ports, `held` has an unknown name, a view shows too few dots, no ports fit the views to
            `LARGEST_NOISE`, or those that fit are more than `FARTHEST_DESIGN` standard deviations from the first guess.

    Limitations:
        In air, the shift of a ray by a plate depends neither on the plate's distance nor on the medium; in a medium, thickness
        and index of a plate cannot be identified separately (docs/calibration.md). Use views of both.

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
    """Solve the least-squares problem, starting from its camera and from `poses [P, 6]`; outliers are left out."""
    theta = np.concatenate([problem.start, poses.ravel()])
    problem.leave_out_unseen(theta)
    for _ in range(ROUNDS):
        theta = fit(problem.residuals, problem.jacobian, theta, what).values
        problem.leave_out_outliers(theta)
    found = fit(problem.residuals, problem.jacobian, theta, what)
    problem.refuse_unlike(found.values, what)
    _, found_poses, _ = problem.parts(found.values)
    return CameraFit(
        problem.camera_of(found.values), problem.names, found, found_poses.numpy(), problem.pixel_residuals(found.values)
    )


class _BoardProblem:
    """Least-squares problem for parameters of a camera and the poses of a board, `theta = (parameters [n], poses [P, 6])`.

    Its residuals are the deviations of the parameters from the first guess, weighted as pixels (zero for those without a
    standard deviation), and then the modelled minus the measured pixels of all points used.

    Args:
        camera: the first guess.
        board: the board.
        views: the measured points.
        free: names of the camera's buffers that are fitted.
        spread: relative standard deviation of the first guess of some of these buffers.
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
        """Names of the camera's n parameters."""
        return [
            name if shape.numel() == 1 else f"{name}[{i}]" for name, shape in self.shapes.items() for i in range(shape.numel())
        ]

    def camera_of(self, theta: np.ndarray) -> Camera:
        """Return the camera with the parameters in `theta`."""
        shared, _, _ = self.parts(theta)
        return _with(self.camera, dict(zip(self.shapes, shared.split(self.lengths), strict=True)))

    def parts(self, theta: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """Return the camera's parameters `[n]` and the poses `[P, 6]` in `theta`, and the mask of filled views `[P]`."""
        values = torch.from_numpy(theta)
        return values[: self.count], values[self.count :].view(-1, 6), self.filled

    def pixel_residuals(self, theta: np.ndarray) -> np.ndarray:
        """Return measured minus modelled pixels, `[P, D, 2]`; NaN where not used."""
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
        """Exclude points that the camera of the first guess cannot image."""
        self.used &= self._all_views(*self.parts(theta)).isfinite().all(-1)

    def leave_out_outliers(self, theta: np.ndarray) -> None:
        """Exclude outliers, include all other visible points, and weight the first guess by the estimated noise."""
        left = (self._all_views(*self.parts(theta)) - self.pixels)[self.visible].numpy()
        mistaken = outliers(left)
        self.design_weight = self.design_precision * np.median(np.abs(left[~mistaken])) / 0.6745
        self.used[self.visible] = torch.from_numpy(~mistaken)

    def refuse_unlike(self, theta: np.ndarray, what: str) -> None:
        """Refuse a camera that does not see the board where it is seen, or whose values are far from the file's."""
        off = float(np.sqrt(np.nanmean(self.pixel_residuals(theta) ** 2) * 2))
        limit = LARGEST_NOISE * float(np.hypot(*self.camera.image_size))
        if off > limit:
            exchanged = ", and that the images in air and in the medium are not exchanged" if self.filled.any() else ""
            raise MembraneError(
                f"{what}: the best camera sees the board's points {off:.3g} px (rms) away from where they are; expected at "
                f"most {limit:.2g}: check the numbers and the spacing of the board's points, in the sensor's length unit"
                f"{exchanged}"
            )
        far = np.abs(theta[: self.count] - self.start) * self.design_precision
        if (far > FARTHEST_DESIGN).any():
            k = int(far.argmax())
            raise MembraneError(
                f"{what}: {self.names[k]} = {theta[k]:.4g}, the sensor file has {self.start[k]:.4g}; expected a value less "
                f"than {FARTHEST_DESIGN / self.design_precision[k]:.2g} away: check the spacing of the board's points, which "
                "scales all lengths, or correct the file"
            )

    def _modelled(self, shared: Tensor, pose: Tensor, filled: Tensor) -> Tensor:
        """Return the modelled pixels of the board's points in one view, `[D, 2]`."""
        parts = zip(self.shapes.items(), shared.split(self.lengths), strict=True)
        buffers = {name: part.view(shape) for (name, shape), part in parts}
        n = buffers.get("medium_index", self.camera.medium_index)
        buffers["medium_index"] = torch.where(filled, n, torch.ones_like(n))
        points = self.outlines @ rotations(pose[:3]).mT + pose[3:]
        return outline_centres(functional_call(self.camera, buffers, (points,)))


def _with(camera: Camera, values: Mapping[str, Tensor]) -> Camera:
    """Return the camera with other values of some buffers; raise `MembraneError` if they are not a valid camera."""

    def get(name: str) -> list[float]:
        return values.get(name, getattr(camera, name)).reshape(-1).tolist()

    ports = list(zip(get("port_distance"), get("port_thickness"), get("port_index"), strict=True))
    lens = get("focal"), get("centre"), get("distortion")
    medium = get("medium_index")[0]
    return Camera(camera.model, camera.image_size, *lens, ports=ports, medium_index=medium, bits=camera.bits)
