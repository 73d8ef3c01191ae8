"""Initial poses of a board relative to a camera, by OpenCV: together with an initial lens, or through the designed ports."""

import numpy as np
import torch
from torch import Tensor
from torch.func import jacfwd

from ..camera.model import COEFFICIENTS, RATIONAL, Camera
from ..camera.targets import Checkerboard, DotBoard
from ..errors import MembraneError
from ..files.optional import load_opencv
from .fit import Fit, fit, rotations


def lens_and_poses(camera: Camera, board: Checkerboard, pixels: np.ndarray) -> tuple[Camera, np.ndarray]:
    """Find an initial lens, and poses `[P, 6]` (rotation vectors and translations), from the board's `pixels [P, D, 2]` in air.

    The lens has as many distortion coefficients as the camera, but at least those of its model.

    Raises:
        MembraneError: there are fewer than 3 images, or OpenCV finds no lens of the camera's model.
    """
    cv2 = load_opencv()
    if len(pixels) < 3:
        raise MembraneError(f"calibrate camera: {len(pixels)} images; expected at least 3, better 10, in different poses")
    (fx, fy), (cx, cy) = camera.focal.tolist(), camera.centre.tolist()
    K, size = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), camera.image_size
    points = [board.points[:, None].astype(np.float32)] * len(pixels)
    imaged = [p[:, None].astype(np.float32) for p in pixels]
    count = max(COEFFICIENTS[camera.model], len(camera.distortion))
    try:
        if camera.model == "pinhole":
            flags = cv2.CALIB_USE_INTRINSIC_GUESS | (cv2.CALIB_RATIONAL_MODEL if count == RATIONAL else 0)
            _, K, k, rotation_vectors, translations = cv2.calibrateCamera(points, imaged, size, K, np.zeros(count), flags=flags)
        else:
            flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW | cv2.fisheye.CALIB_USE_INTRINSIC_GUESS
            exact = [[a.astype(np.float64) for a in arrays] for arrays in (points, imaged)]
            _, K, k, rotation_vectors, translations = cv2.fisheye.calibrate(*exact, size, K, np.zeros(4), flags=flags)
    except cv2.error as error:
        raise MembraneError(
            f"calibrate camera: OpenCV cannot fit a {camera.model} lens to these images ({error}); expected some ten sharp "
            "images with the board tilted in different ways, right --corners, and a first focal length near the true one"
        ) from error
    poses = np.concatenate([np.reshape(rotation_vectors, (-1, 3)), np.reshape(translations, (-1, 3))], 1)
    k = np.ravel(k)[:count]
    return Camera(camera.model, size, (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]), k.tolist()), poses


def port_pose(camera: Camera, board: DotBoard, pixels: np.ndarray) -> np.ndarray:
    """Find an initial pose `[6]` of the board seen through the designed ports: the better of the two planar solutions.

    Args:
        camera: the camera with its ports; its medium is what is behind the last one.
        board: the board.
        pixels: positions of its dots, `[D, 2]`, px; NaN where a dot is not visible.

    Raises:
        MembraneError: fewer than 6 dots are visible.
    """
    cv2 = load_opencv()
    visible = np.isfinite(pixels).all(1)
    origin, direction = camera.pixel_to_ray(torch.from_numpy(pixels[visible]))
    usable = (direction[:, 2] > 0.2).numpy()
    flat = (direction[:, :2] / direction[:, 2:]).numpy()[usable]
    points = board.points[visible][usable]
    if len(points) < 6:
        raise MembraneError(f"calibrate ports: {len(points)} dots of the board seen in an image; expected at least 6")
    _, rotation_vectors, translations, _ = cv2.solvePnPGeneric(points, flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    behind, face = float(origin[:, 2].mean()), camera.ports[-1].distance + camera.ports[-1].thickness
    fits = []
    for rotation, translation in zip(rotation_vectors, translations, strict=True):
        depth = (board.outlines[visible] @ cv2.Rodrigues(rotation)[0].T)[..., 2].min() + translation[2, 0] + behind
        start = np.concatenate([rotation.ravel(), translation.ravel() + [0, 0, behind + max(0.0, 1.05 * face - depth)]])
        fits.append(_pose(camera, board.points[visible], pixels[visible], start))
    return min(fits, key=lambda found: found.noise).values


def _pose(camera: Camera, points: np.ndarray, pixels: np.ndarray, start: np.ndarray) -> Fit:
    at, imaged = torch.from_numpy(points), torch.from_numpy(pixels)

    def modelled(pose: Tensor) -> Tensor:
        return camera.point_to_pixel(at @ rotations(pose[:3]).mT + pose[3:])

    def residuals(pose: np.ndarray) -> np.ndarray:
        return (modelled(torch.from_numpy(pose)) - imaged).numpy().ravel()

    def jacobian(pose: np.ndarray) -> np.ndarray:
        return jacfwd(modelled)(torch.from_numpy(pose)).flatten(0, 1).numpy()

    return fit(residuals, jacobian, start, "calibrate ports")
