"""Lens and ports from images of a flat target in several poses (section 5.2)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call, jacfwd, vmap

from ..camera.model import COEFFICIENTS, Camera
from ..errors import MembraneError
from ..targets import Checkerboard, DotBoard
from .fit import Fit, fit, outline_centres, rotations, strays
from .targets import opencv

LENS = ("focal", "centre", "distortion")
PORTS = ("port_distance", "port_thickness", "port_index", "medium_index")

DESIGN = {"port_distance": 0.2, "port_thickness": 0.2, "port_index": 0.1, "medium_index": 0.1}
"""Relative standard deviation of the sensor file's values: what views leave open stays near them, with this uncertainty."""
NOISE = 0.05  # px, of a point found in an image, before it is known
ROUNDS = 2  # of leaving out mistakes


class Views(NamedTuple):
    """A board seen in P poses: `pixels [P, D, 2]` of its points, NaN where not seen; `filled [P]`: with the medium behind the
    last port; else with air."""

    pixels: np.ndarray
    filled: np.ndarray


class CameraFit(NamedTuple):
    """A fitted camera, the names of its fitted numbers, their fit (they come first, then 6 of each pose), and what is left.

    poses: `[P, 6]` rotation vectors (rad) and translations of the board; residuals: `[P, D, 2]` px, measured less modelled.
    """

    camera: Camera
    names: list[str]
    fit: Fit
    poses: np.ndarray
    residuals: np.ndarray


def lens_from_views(camera: Camera, board: Checkerboard, views: Views) -> CameraFit:
    """Focal lengths, centre and distortion, all coefficients of the camera's model, from views of a board in air.

    OpenCV gives the start, Gauss-Newton on this package's own camera the answer and its uncertainty. Ports of `camera` are
    taken as not yet mounted; they are in the camera that is returned.
    """
    bare = Camera(camera.model, camera.image_size, camera.focal.tolist(), camera.centre.tolist())
    start, poses = _opencv_lens(bare, board, views)
    found = _fit_camera(start, board, views, LENS, poses, "calibrate camera", {})
    values = {name: getattr(found.camera, name).tolist() for name in LENS}
    whole = Camera(camera.model, camera.image_size, **values, ports=camera.ports, medium_index=float(camera.medium_index))
    return found._replace(camera=whole)


def ports_from_views(camera: Camera, board: DotBoard, views: Views, held: Sequence[str] = ()) -> CameraFit:
    """Distance, thickness and index of every port, and the medium's index, from views of a dot board through them.

    `held`: those of `PORTS` that stay as they are in `camera`, whose lens is taken as known. What views in air and views in the
    medium tell: in air a plate shifts every ray by a length that knows neither its distance nor the medium; in a medium its
    thickness and index cannot be told apart (docs/calibration.md). Give both.
    """
    if not camera.ports:
        raise MembraneError("calibrate ports: the sensor has no ports; expected [[camera.ports]] with design values")
    if unknown := set(held) - set(PORTS):
        raise MembraneError(f"calibrate ports: {sorted(unknown)[0]!r} cannot be held; expected some of {', '.join(PORTS)}")
    free = [name for name in PORTS if name not in held and (name != "medium_index" or views.filled.any())]
    poses = np.stack([_start_pose(camera, board, pixels, wet) for pixels, wet in zip(views.pixels, views.filled, strict=True)])
    return _fit_camera(camera, board, views, free, poses, "calibrate ports", DESIGN)


def _fit_camera(
    camera: Camera, board, views: Views, free: Sequence[str], poses: np.ndarray, what: str, spread: dict
) -> CameraFit:
    """`spread`: relative standard deviation of the first guess of some names, one more datum each."""
    shapes = {name: getattr(camera, name).shape for name in free}
    lengths = [max(1, shape.numel()) for shape in shapes.values()]
    start = np.concatenate([getattr(camera, name).numpy().ravel() for name in free])
    design_precision = np.concatenate([1 / (getattr(camera, name).numpy().ravel() * spread.get(name, np.inf)) for name in free])
    outlines, pixels = torch.from_numpy(board.outlines), torch.from_numpy(views.pixels)
    filled, observed = torch.from_numpy(views.filled), torch.from_numpy(np.isfinite(views.pixels).all(-1))
    visible = observed.clone()
    count = len(start)

    def modelled(shared: Tensor, pose: Tensor, filled: Tensor) -> Tensor:
        parts = zip(shapes.items(), shared.split(lengths), strict=True)
        buffers = {name: part.view(shape) for (name, shape), part in parts}
        n = buffers.get("medium_index", camera.medium_index)
        buffers["medium_index"] = torch.where(filled, n, torch.ones_like(n))
        return outline_centres(functional_call(camera, buffers, (outlines @ rotations(pose[:3]).mT + pose[3:],)))

    all_views = vmap(modelled, (None, 0, 0))
    slopes = vmap(jacfwd(modelled, (0, 1)), (None, 0, 0))

    def parts(theta: np.ndarray):
        theta = torch.from_numpy(theta)
        return theta[:count], theta[count:].view(-1, 6), filled

    def residuals(theta):
        apart = (theta[:count] - start) * pull
        return np.concatenate([apart, (all_views(*parts(theta)) - pixels)[visible].numpy().ravel()])

    def jacobian(theta):
        by_shared, by_pose = slopes(*parts(theta))
        P, D = visible.shape
        J = torch.zeros(P, D, 2, count + 6 * P, dtype=torch.float64)
        J[..., :count] = by_shared
        for view in range(P):
            J[view, ..., count + 6 * view : count + 6 * view + 6] = by_pose[view]
        rows = np.zeros((count, J.shape[-1]))
        rows[:, :count] = np.diag(pull)
        return np.concatenate([rows, J[visible].flatten(0, 1).numpy()])

    pull, theta = design_precision * NOISE, np.concatenate([start, poses.ravel()])
    visible &= all_views(*parts(theta)).isfinite().all(-1)
    for _ in range(ROUNDS):
        theta = fit(residuals, jacobian, theta, what).values
        left = (all_views(*parts(theta)) - pixels)[observed].numpy()
        wild = strays(left)
        pull = design_precision * np.median(np.abs(left[~wild])) / 0.6745
        visible[observed] = torch.from_numpy(~wild)
    found = fit(residuals, jacobian, theta, what)
    shared, poses, _ = parts(found.values)
    left = torch.where(visible[..., None], pixels - all_views(shared, poses, filled), torch.nan).numpy()
    values = dict(zip(free, shared.split(lengths), strict=True))
    names = [name if shape.numel() == 1 else f"{name}[{i}]" for name, shape in shapes.items() for i in range(shape.numel())]
    return CameraFit(_with(camera, values), names, found, poses.numpy(), left)


def _with(camera: Camera, values: dict[str, Tensor]) -> Camera:
    """The camera with other values of some buffers; raises `MembraneError` where they make none."""
    get = lambda name: values.get(name, getattr(camera, name)).reshape(-1).tolist()  # noqa: E731
    ports = list(zip(get("port_distance"), get("port_thickness"), get("port_index"), strict=True))
    lens = [get(name) for name in LENS]
    return Camera(camera.model, camera.image_size, *lens, ports, get("medium_index")[0])


def _opencv_lens(camera: Camera, board: Checkerboard, views: Views) -> tuple[Camera, np.ndarray]:
    cv2 = opencv()
    if len(views.pixels) < 3:
        raise MembraneError(f"calibrate camera: {len(views.pixels)} images; expected at least 3, better 10, in different poses")
    (fx, fy), (cx, cy) = camera.focal.tolist(), camera.centre.tolist()
    K, size = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), camera.image_size
    points = [board.points[:, None].astype(np.float32)] * len(views.pixels)
    pixels = [p[:, None].astype(np.float32) for p in views.pixels]
    try:
        if camera.model == "pinhole":
            _, K, k, turns, shifts = cv2.calibrateCamera(
                points, pixels, size, K, np.zeros(5), flags=cv2.CALIB_USE_INTRINSIC_GUESS
            )
        else:
            flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW | cv2.fisheye.CALIB_USE_INTRINSIC_GUESS
            points, pixels = ([a.astype(np.float64) for a in arrays] for arrays in (points, pixels))
            _, K, k, turns, shifts = cv2.fisheye.calibrate(points, pixels, size, K, np.zeros(4), flags=flags)
    except cv2.error as error:
        raise MembraneError(f"calibrate camera: OpenCV finds no {camera.model} lens for these images ({error})") from error
    poses = np.concatenate([np.reshape(turns, (-1, 3)), np.reshape(shifts, (-1, 3))], 1)
    k = np.ravel(k)[: COEFFICIENTS[camera.model]]
    return Camera(camera.model, size, (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]), k.tolist()), poses


def _start_pose(camera: Camera, board: DotBoard, pixels: np.ndarray, filled: bool) -> np.ndarray:
    """A first pose `[6]`, for the design's ports: the better of the two that a central camera allows."""
    cv2 = opencv()
    visible = np.isfinite(pixels).all(1)
    medium = float(camera.medium_index) if filled else 1.0
    camera = Camera(camera.model, camera.image_size, *(getattr(camera, name).tolist() for name in LENS), camera.ports, medium)
    origin, direction = camera.pixel_to_ray(torch.from_numpy(pixels[visible]))
    usable = (direction[:, 2] > 0.2).numpy()
    flat = (direction[:, :2] / direction[:, 2:]).numpy()[usable]
    points = board.points[visible][usable]
    if len(points) < 6:
        raise MembraneError(f"calibrate ports: {len(points)} dots of the board seen in an image; expected at least 6")
    _, turns, shifts, _ = cv2.solvePnPGeneric(points, flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    behind, face = float(origin[:, 2].mean()), camera.ports[-1].distance + camera.ports[-1].thickness
    fits = []
    for turn, shift in zip(turns, shifts, strict=True):
        depth = (board.outlines[visible] @ cv2.Rodrigues(turn)[0].T)[..., 2].min() + shift[2, 0] + behind
        start = np.concatenate([turn.ravel(), shift.ravel() + [0, 0, behind + max(0.0, 1.05 * face - depth)]])
        fits.append(_pose(camera, board.points[visible], pixels[visible], start))
    return min(fits, key=lambda found: found.noise).values


def _pose(camera: Camera, points: np.ndarray, pixels: np.ndarray, start: np.ndarray) -> Fit:
    points, pixels = torch.from_numpy(points), torch.from_numpy(pixels)

    def modelled(pose: Tensor) -> Tensor:
        return camera.point_to_pixel(points @ rotations(pose[:3]).mT + pose[3:])

    return fit(
        lambda pose: (modelled(torch.from_numpy(pose)) - pixels).numpy().ravel(),
        lambda pose: jacfwd(modelled)(torch.from_numpy(pose)).flatten(0, 1).numpy(),
        start, "calibrate ports",
    )  # fmt: skip
