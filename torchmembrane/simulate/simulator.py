"""Simulation of a sensor: presses on its membrane, on a grid finer than its solver's, their images, and the ground truth."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from math import gcd
from typing import Any, NamedTuple

import numpy as np
import torch

from ..errors import MembraneError, check_arguments
from ..files.images import to_grey
from ..sensor.camera_tables import shared_image
from ..sensor.factories import cavity_filling, elastic_energy
from ..sensor.sensor import Sensor
from ..torch_modes import on_cpu
from .appearance import DEFAULT_APPEARANCE, Appearance, noisy
from .indenters import Indenter
from .pattern import pattern_of
from .quasi_static import Press, presses
from .render import RenderedDots, Renderer

LEGS = ("push", "slide", "release")
REST_NOISE = 2**31 - 1  # seed of the rest image's noise, different from those of frames
BEHIND = "the press takes the membrane behind the camera"
LIFT = 0.05  # height above the first contact where a release ends, over the surface's size


class Stroke(NamedTuple):
    """The motion of one indenter from its first contact, lengths in the sensor's unit.

    Attributes:
        indenter: the indenter at its first contact.
        travel: unit vector of the press, `[3]`.
        depth: distance of the press.
        slide: displacement after the press, `[3]`.
        friction: Coulomb's coefficient.

    Example:
        >>> from torchmembrane.simulate import Sphere
        >>> stroke = Stroke(Sphere(4.0), np.array([0.0, 0.0, -1.0]), 2.0)
        >>> [pose.translation[2].item() for pose in stroke.poses(["push", "release"], frames=2, lift=1.0)]
        [-1.0, -2.0, -0.5, 1.0]
    """

    indenter: Indenter
    travel: np.ndarray
    depth: float
    slide: np.ndarray = np.zeros(3)
    friction: float = 0.0

    def poses(self, legs: Sequence[str], frames: int, lift: float) -> list[Indenter]:
        """Return `frames` equidistant poses on each of the `legs`, "push", "slide", "release"; the release ends `lift` (length
        unit) beyond the first contact, off the membrane."""
        offsets: list[np.ndarray] = []
        here = np.zeros(3)
        motion = {"push": self.depth * self.travel, "slide": self.slide, "release": -(self.depth + lift) * self.travel}
        for leg in legs:
            offsets += [here + motion[leg] * k / frames for k in range(1, frames + 1)]
            here = offsets[-1]
        return [self.indenter.moved(offset) for offset in offsets]

    def described(self) -> dict[str, Any]:
        """Return the description of the stroke that a frame's truth stores."""
        sizes = {
            key: np.asarray(value).tolist()
            for key, value in vars(self.indenter).items()
            if key in ("radius", "axis", "length", "opening", "sides")
        }
        return {
            "indenter": self.indenter.kind,
            **sizes,
            "travel": self.travel.tolist(),
            "depth": self.depth,
            "slide": self.slide.tolist(),
            "friction": self.friction,
            "touch": self.indenter.translation.tolist(),
            "rotation": self.indenter.rotation.tolist(),
        }


class SimulatedFrame(NamedTuple):
    """An image with its ground truth.

    Attributes:
        image: `[H, W]` uint8; with several views the first view's image, or, if they are regions of one image, that image.
        truth: arrays by name, see `Simulator.frame`.
        further: images of the other views, if views have separate images.
    """

    image: np.ndarray
    truth: dict[str, np.ndarray]
    further: tuple[np.ndarray, ...] = ()


@check_arguments
@on_cpu
class Simulator:
    """Simulates presses and images of one sensor.

    A gas without a modulus is treated as a liquid.

    Args:
        sensor: the sensor.
        grid: grid of the equilibrium; default: about 38 per side, finer than the solver's and sharing no line with it but the
            rim.
        appearance: lighting, lens and image sensor.
        radii: radii of small and large dots, length unit; default: as in `Dots.from_sensor`.
        missing: indices of dots that are not painted.

    Raises:
        MembraneError: the grid is not finer than the sensor's own.

    Example:
        >>> from torchmembrane.presets import preset
        >>> Simulator(preset("fingertip")).grid
        (38, 38)
    """

    def __init__(
        self,
        sensor: Sensor,
        grid: Sequence[int] | None = None,
        appearance: Appearance = DEFAULT_APPEARANCE,
        radii: Sequence[float] | None = None,
        missing: Sequence[int] = (),
    ) -> None:
        self.sensor, self.appearance = sensor, appearance
        m, n = grid or map(_finer, sensor.membrane.grid)
        self.grid = (m, n)
        if any(mine <= solver for mine, solver in zip(self.grid, sensor.membrane.grid, strict=True)):
            raise MembraneError(
                f"Simulator: grid {list(self.grid)}; expected a finer one than the sensor's, {list(sensor.membrane.grid)}: "
                "data simulated on the estimator's own grid flatter it"
            )
        self.membrane = sensor.surface.membrane(self.grid)
        self.elasticity = elastic_energy(sensor, self.membrane)
        self.cavity = cavity_filling(sensor, self.membrane)._asdict()
        self.pattern = pattern_of(sensor, radii, missing)
        self.renderer = Renderer(sensor.in_view(0), self.grid, self.pattern, appearance)
        self.renderers = [self.renderer]
        for number in range(1, len(sensor.views)):
            alone = sensor.in_view(number)
            self.renderers.append(Renderer(alone, self.grid, pattern_of(alone, radii, missing), appearance))
        self.rest_dots = self.dots(self.membrane.rest)

    def image(self, vertices: torch.Tensor, rng: np.random.Generator) -> np.ndarray:
        """Return the image of the membrane at `vertices [V, 3]`, uint8 `[H, W]`; `rng` generates the noise. With several views,
        it is the first view's image, or, if the views are regions of one image, that image."""
        return self.images(vertices, rng)[0]

    def images(self, vertices: torch.Tensor, rng: np.random.Generator) -> list[np.ndarray]:
        """Return the images of all views that have separate images; if views are regions, the image that they share."""
        views = self.view_images(vertices, rng)
        shared = shared_image(views, self.sensor.views) if self.sensor.views else None
        return views if shared is None else [shared]

    def view_images(self, vertices: torch.Tensor, rng: np.random.Generator) -> list[np.ndarray]:
        """Return the image of each view, uint8 `[H, W]`."""
        with torch.no_grad():
            clean = [renderer(x) for renderer, x in zip(self.renderers, self._in_views(vertices), strict=True)]
            return [(255 * noisy(image, self.appearance.noise, rng)).round().byte().cpu().numpy() for image in clean]

    def dots(self, vertices: torch.Tensor) -> RenderedDots:
        """Return the pattern's dots on the membrane at `vertices [V, 3]`; with several views, pixels `[W, D, 2]` and visibility
        `[W, D]` in each."""
        each = [renderer.dots(x) for renderer, x in zip(self.renderers, self._in_views(vertices), strict=True)]
        if len(each) == 1:
            return each[0]
        return RenderedDots(
            each[0].positions, *(torch.stack([getattr(dots, key) for dots in each]) for key in ("pixels", "visible"))
        )

    def _in_views(self, vertices: torch.Tensor) -> list[torch.Tensor]:
        """Return the vertices in the frame of each view."""
        return [vertices, *(view.pose.inverse.points(vertices) for view in self.sensor.views[1:])]

    def rest_image(self) -> np.ndarray:
        """Return the image at rest, float32 `[H, W]`, as a sensor stores it; with several views, the first one's."""
        return to_grey(self.view_images(self.membrane.rest, np.random.default_rng(REST_NOISE))[0])

    def at_rest(self) -> Sensor:
        """Return the sensor with rest images rendered by this simulator."""
        sensor = self.sensor
        images = [to_grey(image) for image in self.view_images(self.membrane.rest, np.random.default_rng(REST_NOISE))]
        views = tuple(replace(view, rest_image=image) for view, image in zip(sensor.views, images, strict=False))
        return replace(sensor, markers=replace(sensor.markers, rest_image=images[0]), views=views)

    def presses(self, stroke: Stroke, legs: Sequence[str], frames: int = 1, increment: float | None = None) -> Iterator[Press]:
        """Compute the equilibria along a stroke.

        The motion starts at the first contact, which is not a frame: with friction the force depends on the path from there.

        Args:
            stroke: the motion of the indenter.
            legs: legs of the stroke, some of "push", "slide", "release".
            frames: number of frames on each leg.
            increment: longest travel in one step; default: that of `presses`.

        Yields:
            The equilibrium at each frame.

        Raises:
            MembraneError: the indenter never touches the membrane, or the membrane cannot follow it.
        """
        poses = [stroke.indenter, *stroke.poses(legs, frames, LIFT * self.membrane.size)]
        states = presses(self.membrane, self.elasticity, [poses], friction=stroke.friction, increment=increment, **self.cavity)
        touched = False
        for state in islice(states, 1, None):
            touched = touched or bool(state.contact.any())
            if self.leaves_camera(state.vertices):
                raise MembraneError(f"simulate: {BEHIND} (depth {stroke.depth:g}); expected a smaller depth or slide")
            yield state
        if not touched:
            raise MembraneError("simulate: the indenter never touches the membrane; expected a depth that presses it in")

    def leaves_camera(self, vertices: torch.Tensor) -> bool:
        """Return whether the membrane is no longer in front of its camera: the lens does not image some vertices, or the
        membrane has passed the centre of projection, which changes the solid angle that it subtends there (otherwise fixed by
        the rim).

        Args:
            vertices: vertices on the grid, `[V, 3]`.
        """
        camera, membrane = self.sensor.camera, self.membrane
        lost = camera.can_image(membrane.rest) & ~camera.can_image(vertices)
        angles = [solid_angle(x[membrane.triangles]) for x in (membrane.rest, vertices)]
        return bool(lost.any()) or abs(angles[1] - angles[0]) > 2 * math.pi

    def frame(self, state: Press, stroke: Stroke, rng: np.random.Generator) -> SimulatedFrame:
        """Render the image of an equilibrium and return it with its ground truth.

        Args:
            state: the equilibrium.
            stroke: motion of the indenters that led to it.
            rng: random generator of the image's noise.

        Returns:
            The image with its truth: dots_nominal, dots_deformed `[D, 3]`, uv_nominal, uv_deformed `[D, 2]` px (of the dots'
            centres: the centre of the outline lies some 0.1 px from it), visible_nominal, visible_deformed `[D]`, of W views
            `[W, D, 2]` and `[W, D]`;
            vertices_nominal, vertices_deformed `[V, 3]`, triangles `[T, 3]`, contact_mask `[V]`, traction `[V, 3]`; p, p0
            pressure difference now and at rest; force `[3]` on the membrane, force_each `[I, 3]`, contact_centroid_each
            `[I, 3]`; stroke: JSON.
        """
        dots, rest = self.dots(state.vertices), self.rest_dots
        truth = {
            "dots_nominal": rest.positions,
            "dots_deformed": dots.positions,
            "uv_nominal": rest.pixels,
            "uv_deformed": dots.pixels,
            "visible_nominal": rest.visible,
            "visible_deformed": dots.visible,
            "vertices_nominal": self.membrane.rest,
            "vertices_deformed": state.vertices,
            "triangles": self.membrane.triangles.int(),
            "contact_mask": state.contact,
            "traction": state.traction,
            "p": state.pressure,
            "p0": state.rest_pressure,
            "force": state.force,
            "force_each": state.forces,
            "contact_centroid_each": state.contact_points,
        }
        arrays = {key: np.asarray(value) for key, value in truth.items()}
        arrays = {key: a.astype(np.float32) if a.dtype.kind == "f" else a for key, a in arrays.items()}
        first, *further = self.images(state.vertices, rng)
        return SimulatedFrame(first, arrays | {"stroke": np.array(json.dumps(stroke.described()))}, tuple(further))


def solid_angle(corners: torch.Tensor) -> float:
    """Return the solid angle of triangles seen from the origin, positive if their outer sides face away from it.

    With a, b, c a triangle's corners, `tan(W / 2) = det(a b c) / (|a||b||c| + a.b |c| + b.c |a| + c.a |b|)`.

    Args:
        corners: corners of the triangles, `[T, 3, 3]`.

    Returns:
        The sum over the triangles, sr.

    Example:
        >>> round(solid_angle(torch.eye(3)[None]) / (4 * math.pi), 6)  # one of eight octants
        0.125
    """
    a, b, c = corners.unbind(1)
    A, B, C = (corner.norm(dim=-1) for corner in (a, b, c))
    below = A * B * C + (a * b).sum(-1) * C + (b * c).sum(-1) * A + (c * a).sum(-1) * B
    return float(2 * torch.atan2(torch.linalg.det(corners), below).sum())


def _finer(count: int) -> int:
    """Return a number of grid lines, equidistant as the solver's `count`, that share only the first and the last with it."""
    finer = min(2 * count + 3, max(38, count + 4))
    while gcd(count - 1, finer - 1) > 1:
        finer += 1
    return finer
