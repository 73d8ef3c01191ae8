"""Comparison of an exported model with its reconstructor on simulated images of the sensor at rest and pressed."""

from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from ..errors import MembraneError
from ..reconstruct import Reconstructor
from ..simulate.dataset import Plan, random_frame
from ..simulate.simulator import REST_NOISE, Simulator

LARGEST = 3e-5  # largest distance between the vertices of both, over the surface's size
ROUNDING = 8.0  # or over torch's own rounding error in float32, which the batch size alone may increase several times
NUDGES = tuple(1 - k * 2.0**-24 for k in range(1, 7))  # factors of images close to 1; fewer may miss discontinuous results


class Agreement(NamedTuple):
    """Comparison of a model's results with torch's.

    Attributes:
        distance: largest distance between their vertices, length unit.
        status: statuses of the model's frames; the first frame is run twice, in the batch and alone.
        expected: statuses of torch's frames in the same order.
    """

    distance: float
    status: list[int]
    expected: list[int]


def checked(model: bytes, reconstructor: Reconstructor) -> Agreement:
    """Run a model and torch on simulated images of the sensor at rest and pressed, and compare the results.

    Raises:
        MembraneError: statuses differ, or vertices differ by more than float32 rounding explains.
    """
    images = check_images(reconstructor)
    found, largest = compare(model, reconstructor, images), LARGEST * reconstructor.estimator.membrane.size
    if found.distance > largest:
        largest = max(largest, ROUNDING * rounding(reconstructor, images))
    if found.status != found.expected or not found.distance <= largest:
        raise MembraneError(
            f"export: on images of the sensor at rest and pressed the model's vertices are {found.distance:.1e} from torch's, "
            f"its statuses {found.status}, torch's {found.expected}; expected at most {largest:.1e} and the same statuses"
        )
    return found


def rounding(reconstructor: Reconstructor, images: Tensor) -> float:
    """Return the effect of rounding on torch's vertices in float32.

    It is the largest distance from the vertices in float64, and from those of images `[B, 1, H, W]` that differ by a rounding
    error. For a nearly unstretched sheet with a contact between markers, which is weakly constrained, it is up to some per cent
    of the displacement.
    """
    with torch.no_grad():
        found = reconstructor.reconstruct_grey(images).vertices
        others = [reconstructor.reconstruct_grey(nudge * images).vertices for nudge in NUDGES]
        others.append(deepcopy(reconstructor).double().reconstruct_grey(images.double()).vertices)
    return max(float((found - other).norm(dim=-1).nan_to_num().max()) for other in others)


def check_images(reconstructor: Reconstructor) -> Tensor:
    """Simulate images of the sensor at rest, pressed, and at rest, `[3, 1, height, width]`; for W views that have separate
    images, `[3, W, height, width]`. If no press can be simulated, return only the first image."""
    simulator = Simulator(reconstructor.sensor)
    rest = simulator.images(simulator.membrane.rest, np.random.default_rng(REST_NOISE))
    frames: list[Any] = [rest]
    try:
        with torch.enable_grad():  # the simulator needs gradients
            pressed = random_frame(simulator, Plan(kinds=("sphere",)), 0)
        frames += [[pressed.image, *pressed.further], rest]
    except MembraneError:
        pass
    return torch.cat([reconstructor.grey(frame if reconstructor.sensor.views_apart else frame[0]) for frame in frames])


def compare(model: bytes, reconstructor: Reconstructor, images: Tensor) -> Agreement:
    """Run torch on `images [B, 1, H, W]`, and a model on the batch and on its first frame alone; compare the results.

    A tracking model is run twice, from rest and from the pixels that torch found.
    """
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # its warnings concern its own optimiser
    options.enable_mem_reuse = False  # planning it takes two thirds of the time for loading a model
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    names = [given.name for given in session.get_inputs()]
    tracks = "previous_pixels" in names
    names = [name for name in names if name != "previous_pixels"]
    status: list[int] = []
    expected_status: list[int] = []
    distances = [0.0]
    before = images.new_full((len(images), *reconstructor.rest_pixels.shape), torch.nan) if tracks else None
    observer: Any = reconstructor.observer
    given = [image.numpy() for image in (observer.images(images) if len(names) > 1 else [images])]
    for _ in range(2 if tracks else 1):
        with torch.no_grad():
            sighted = None if before is None else observer.sighted(before)
            expected = reconstructor.reconstruct_grey(images, sighted)
        feed = dict(zip(names, given, strict=True)) | ({} if before is None else {"previous_pixels": before.numpy()})
        for frames in (len(images), 1):
            vertices, statuses = session.run(["vertices", "status"], {name: value[:frames] for name, value in feed.items()})
            apart = np.linalg.norm(vertices - expected.vertices[:frames].numpy(), axis=-1).max(-1)
            distances += [float(apart[k]) for k, value in enumerate(statuses) if value == 0 == expected.status[k]]
            status, expected_status = status + statuses.tolist(), expected_status + expected.status[:frames].tolist()
        before = expected.pixels
    return Agreement(float(np.max(distances)), status, expected_status)
