"""Images of a deformed membrane as its camera sees them: the pattern on the material, light, lens and chip.

The surface is refined by bicubic splines until its facets are about the size of pixels, projected, and sampled at `s x s`
points per pixel. For each sample, the visible triangle is found; the position on the material and the brightness are linear in
it.
"""

import copy
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.interpolate import make_interp_spline
from torch import Tensor, nn

from ..errors import MembraneError, check_arguments
from ..sensor.sensor import Sensor
from ..surface.tangent import tangent_frame
from ..torch_modes import on_cpu, without_autocast
from .appearance import BRIGHT, DEFAULT_APPEARANCE, Appearance, blurred, diffuse_light, specular_light, vignette
from .discs import draw_discs
from .pattern import Canvas, Dots, Painted, Speckle, dot_coordinates, inside_unit_disc, pattern_of
from .raster import LinearOnTriangles, visible_triangles

FINEST_GRID = 513


class RenderedDots(NamedTuple):
    """The dots of a deformed membrane.

    Attributes:
        positions: positions of the centres, `[..., D, 3]`; for pins, of their tips.
        pixels: pixels of the centres, `[..., D, 2]`.
        visible: `[..., D]` bool, whether each is inside the image and not occluded.
    """

    positions: Tensor
    pixels: Tensor
    visible: Tensor


@check_arguments
@on_cpu
class Renderer(nn.Module):
    """Renders images of one sensor.

    Args:
        sensor: sensor with camera, rest surface, and the markers that define the default pattern.
        grid: grid `(m, n)` of the vertices to be rendered; default: the sensor's solver grid.
        pattern: `Dots`, `Speckle` or `Painted`; default: `pattern_of(sensor)`.
        appearance: lighting, lens and image sensor; noise is not added here (see `noisy`).
        samples: number of samples s along a pixel's side.

    Raises:
        MembraneError: no part of the rest surface lies in the image.

    Example:
        >>> from torchmembrane.presets import preset
        >>> sensor = preset("fingertip")
        >>> Renderer(sensor, samples=1)(sensor.membrane.rest).shape
        torch.Size([480, 640])
    """

    coarse_rest: Tensor
    spline_0: Tensor
    spline_1: Tensor
    lights: Tensor
    unit_light: Tensor
    rest_pixels: Tensor
    albedo: Tensor
    dot_vertices: Tensor
    dot_weights: Tensor
    dot_rest: Tensor
    heights: Tensor
    pin_radii: Tensor
    inked: Tensor
    dot_place: Tensor
    dot_row: Tensor

    def __init__(
        self,
        sensor: Sensor,
        grid: Sequence[int] | None = None,
        pattern: Dots | Speckle | Painted | None = None,
        appearance: Appearance = DEFAULT_APPEARANCE,
        samples: int = 4,
    ) -> None:
        super().__init__()
        self.camera, self.appearance, self.samples = copy.deepcopy(sensor.camera), appearance, samples
        m, n = grid or sensor.membrane.grid
        coarse = sensor.surface.membrane((m, n))
        pattern = pattern or pattern_of(sensor)
        self.grid = coarse.grid
        self.surface = sensor.surface.membrane(_fine_grid(sensor, pattern.cell))
        self.register_buffer("coarse_rest", coarse.rest)
        for axis in (0, 1):
            self.register_buffer(f"spline_{axis}", _spline_matrix(coarse.grid[axis], self.surface.grid[axis]))
        self.register_buffer("lights", appearance.lights_for(coarse))
        self._expose()
        self._paint(pattern)

    def _expose(self) -> None:
        """Scale the light so that the white membrane at rest has the requested grey value."""
        X, pixels = self.surface.rest, self.camera.point_to_pixel(self.surface.rest)
        visible = ((pixels > -0.5) & (pixels < pixels.new_tensor(self.camera.image_size) - 0.5)).all(-1)
        if not visible.any():
            raise MembraneError(
                "Renderer: no part of the rest surface lies in the image; check the camera and the rest surface"
            )
        light = diffuse_light(X, -self.surface.rest_normals, self.lights)
        self.register_buffer("unit_light", light[visible].quantile(BRIGHT).clamp_min(1e-12))
        self.register_buffer("rest_pixels", pixels)

    def _paint(self, pattern: Dots | Speckle | Painted) -> None:
        """Set the reflectances of the ground, and mark the triangles that contain ink."""
        X, corners = self.surface.rest, self.surface.rest[self.surface.triangles]
        white = self._light(X)[..., 0] * vignette(self.rest_pixels, self.camera, self.appearance.vignetting)
        self.register_buffer("albedo", pattern.albedo(Canvas(X, self.rest_pixels, white)))
        self.ink, dots = 1.0, pattern if isinstance(pattern, Dots) else Dots(np.zeros((0, 3)), np.zeros(0))
        positions, missing = dots.positions, set(dots.missing)
        points = self.surface.closest_points(positions)
        self.register_buffer("dot_vertices", torch.from_numpy(points.vertices))
        self.register_buffer("dot_weights", torch.from_numpy(points.weights))
        self.register_buffer("dot_rest", torch.from_numpy(positions))
        self.register_buffer("heights", torch.from_numpy(np.array(dots.heights, float)))
        there = [d for d in range(len(positions)) if d not in missing]
        painted, self.pins = ([d for d in there if bool(self.heights[d]) == stands] for stands in (False, True))
        self.register_buffer("pin_radii", torch.from_numpy(dots.radii[self.pins]))
        self.pin_ink = dots.ink
        inked, place = torch.zeros(len(corners), dtype=torch.bool), torch.zeros(0, 3, 2, dtype=torch.float64)
        if painted:
            self.ink = dots.ink / dots.ground
            normals = (self.surface.rest_normals[self.dot_vertices] * self.dot_weights[..., None]).sum(1).numpy()
            inked, place = dot_coordinates(corners.numpy(), positions[painted], normals[painted], dots.radii[painted])
        self.register_buffer("inked", inked)
        self.register_buffer("dot_place", place)
        self.register_buffer("dot_row", inked.cumsum(0) - 1)

    def fine_vertices(self, vertices: Tensor) -> Tensor:
        """Return the refined surface to be drawn: displacements by bicubic splines, `[..., V, 3]` to `[..., W, 3]`.

        Raises:
            MembraneError: the vertices are not on the renderer's grid.
        """
        if vertices.shape[-2:] != self.coarse_rest.shape:
            raise MembraneError(
                f"Renderer: vertices {list(vertices.shape)}; expected [..., {len(self.coarse_rest)}, 3], on the grid "
                f"{self.grid[0]} x {self.grid[1]}"
            )
        displacement = (vertices.to(self.coarse_rest) - self.coarse_rest).unflatten(-2, self.grid).movedim(-1, -3)
        fine = (self.spline_0 @ displacement @ self.spline_1.mT).movedim(-3, -1)
        return self.surface.rest + fine.flatten(-3, -2)

    def dots(self, vertices: Tensor) -> RenderedDots:
        """Return the centres of the pattern's dots on the membrane at `[..., V, 3]`, and which of them are visible."""
        x = self.fine_vertices(vertices)
        positions, inward = self._standing(x)
        pixels = self.camera.point_to_pixel(positions)
        hidden = [self._visible_range(*pair) < 0.99 * p.norm(dim=-1) for *pair, p in _each(x, pixels, positions)]
        size = pixels.new_tensor(self.camera.image_size)
        visible = ((pixels > -0.5) & (pixels < size - 0.5)).all(-1) & ~torch.stack(hidden).view(pixels.shape[:-1])
        turned = (self.heights != 0) & ((inward * positions).sum(-1) >= 0)
        return RenderedDots(positions, pixels, visible & ~turned)

    def _standing(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the centres of the dots, or of their tips, on the refined surface `x [..., W, 3]`, and the inward normals
        under them, `[..., D, 3]` each."""
        fields = x - self.surface.rest, self.surface.normals(x)
        displacement, outward = ((a[..., self.dot_vertices, :] * self.dot_weights[..., None]).sum(-2) for a in fields)
        inward = -F.normalize(outward, dim=-1)
        return self.dot_rest + displacement + self.heights[:, None] * inward, inward

    def forward(self, vertices: Tensor) -> Tensor:
        """Render images without noise.

        Args:
            vertices: vertices of the membrane on the grid, `[..., V, 3]`.

        Returns:
            Images, `[..., H, W]`, float32 in 0..1.
        """
        with without_autocast(vertices.device.type):
            return self._rendered(vertices)

    def _rendered(self, vertices: Tensor) -> Tensor:
        x = self.fine_vertices(vertices)
        light = self._light(x)
        images = torch.stack([self._sharp(*pair) for pair in _each(x, light)])
        images = images.view(*vertices.shape[:-2], *images.shape[-2:])
        width, height = self.camera.image_size
        v, u = torch.meshgrid(*(torch.arange(size, device=images.device) for size in (height, width)), indexing="ij")
        images = images * vignette(torch.stack([u, v], -1).to(images), self.camera, self.appearance.vignetting)
        return blurred(images, self.appearance.blur).clamp(0, 1)

    def depth(self, vertices: Tensor) -> Tensor:
        """Render depth images of the membrane: z along the optical axis of what is visible at each pixel's centre.

        Args:
            vertices: vertices of the membrane on the grid, `[..., V, 3]`.

        Returns:
            Depths, length unit, `[..., H, W]`; NaN outside the membrane.
        """
        with without_autocast(vertices.device.type):
            images = [self._depth(x) for (x,) in _each(self.fine_vertices(vertices))]
        return torch.stack(images).view(*vertices.shape[:-2], *images[0].shape)

    def _depth(self, x: Tensor) -> Tensor:
        corners, visible = self._visible(x, samples=1)
        sample = torch.nonzero(visible.view(-1) >= 0).squeeze(-1)
        place = torch.stack([sample % visible.shape[1], sample // visible.shape[1]], -1).float()
        linear = LinearOnTriangles.from_corners(corners, x[self.surface.triangles][..., 2:])
        depth = linear.at(visible.view(-1)[sample], place).squeeze(-1)
        image = torch.full(visible.shape, torch.nan, dtype=depth.dtype, device=visible.device)
        image.view(-1)[sample] = depth
        return image

    def _light(self, x: Tensor) -> Tensor:
        """Return the grey value of a white membrane and of the highlights on it, `[..., W, 2]`."""
        appearance, inward = self.appearance, -self.surface.normals(x)
        direct = diffuse_light(x, inward, self.lights) / self.unit_light
        shine = torch.zeros_like(direct)
        if appearance.highlight:
            shine = specular_light(x, inward, self.lights, appearance.shininess) / self.unit_light
        return appearance.exposure * torch.stack(
            [appearance.ambient + (1 - appearance.ambient) * direct, appearance.highlight * shine], -1
        )

    def _visible(self, x: Tensor, samples: int) -> tuple[Tensor, Tensor]:
        """Return the corners `[T, 3, 2]` of the projected triangles in samples, and the visible one at each sample,
        `[H s, W s]`."""
        width, height = self.camera.image_size
        corners = ((self.camera.point_to_pixel(x) + 0.5) * samples - 0.5)[self.surface.triangles]
        depth = x.norm(dim=-1)[self.surface.triangles].mean(-1)
        return corners, visible_triangles(corners, depth, samples * width, samples * height)

    def _visible_range(self, x: Tensor, pixels: Tensor) -> Tensor:
        """Return the range of what is visible at `pixels [D, 2]`: the farthest of the 3 x 3 pixels around each, `[D]`."""
        _, visible = self._visible(x, samples=1)
        ranges = F.pad(x.norm(dim=-1)[self.surface.triangles].mean(-1), (0, 1), value=torch.inf)[visible]
        last = torch.tensor(visible.shape[::-1], device=visible.device) - 1
        steps = torch.cartesian_prod(*2 * [torch.arange(-1, 2, device=visible.device)])
        around = pixels.nan_to_num(0.0).round().long() + steps[:, None]
        u, v = around.clamp_min(0).minimum(last).unbind(-1)
        return ranges[v, u].amax(0)

    def _sharp(self, x: Tensor, light: Tensor) -> Tensor:
        """Return one image `[H, W]` before blur and noise: the mean of the samples of each pixel."""
        corners, visible = self._visible(x, self.samples)
        sample = torch.nonzero(visible.view(-1) >= 0).squeeze(-1)
        triangle = visible.view(-1).index_select(0, sample)
        place = torch.stack([sample % visible.shape[1], sample // visible.shape[1]], -1).float()
        brightness = torch.stack([self.albedo * light[:, 0], light[:, 1]], -1)[self.surface.triangles]
        grey, shine = LinearOnTriangles.from_corners(corners, brightness).at(triangle, place).unbind(-1)
        near = torch.nonzero(self.inked.index_select(0, triangle)).squeeze(-1)
        if len(near):
            linear = LinearOnTriangles.from_corners(corners[self.inked], self.dot_place)
            row = self.dot_row.index_select(0, triangle.index_select(0, near))
            covered = inside_unit_disc(linear.at(row, place.index_select(0, near)), linear.slope.index_select(0, row))
            grey[near] *= 1 + (self.ink - 1) * covered
        image = torch.full(visible.shape, self.appearance.outside, dtype=grey.dtype, device=visible.device)
        image.view(-1)[sample] = grey + shine
        if self.pins:
            self._draw_pins(image, x, light)
        return F.avg_pool2d(image[None, None], self.samples)[0, 0]

    def _draw_pins(self, image: Tensor, x: Tensor, light: Tensor) -> None:
        """Draw the tips of pins into the samples of an image, the nearest last."""
        feet, weights = self.dot_vertices[self.pins], self.dot_weights[self.pins, :, None]
        tips, inward = (each[self.pins] for each in self._standing(x))
        across = self.pin_radii[:, None, None] * tangent_frame(inward)
        centres, (ahead, behind) = self.camera.point_to_pixel(tips), (tips[:, None] + sign * across for sign in (1, -1))
        radii = (self.camera.point_to_pixel(ahead) - self.camera.point_to_pixel(behind)) / 2
        hidden = self._visible_range(x, centres) < 0.99 * tips.norm(dim=-1)
        order = torch.nonzero(~hidden & ((inward * tips).sum(-1) < 0) & radii.isfinite().all((1, 2))).squeeze(-1)
        order = order[tips[order].norm(dim=-1).argsort(descending=True)]
        grey = self.pin_ink * (light[feet, :1] * weights).sum((1, 2))
        draw_discs(image, ((centres + 0.5) * self.samples - 0.5)[order], self.samples * radii[order], grey[order])


def render(
    sensor: Sensor,
    vertices: Tensor,
    grid: Sequence[int] | None = None,
    pattern: Dots | Speckle | Painted | None = None,
    appearance: Appearance = DEFAULT_APPEARANCE,
    samples: int = 4,
) -> Tensor:
    """Render images of a sensor's membrane.

    Args:
        sensor: the sensor; all arguments are those of `Renderer`.
        vertices: vertices of the membrane on the grid, `[..., V, 3]`.
        grid: grid of the vertices.
        pattern: pattern on the membrane.
        appearance: lighting, lens and image sensor.
        samples: number of samples along a pixel's side.

    Returns:
        Images, `[..., H, W]`, float32 in 0..1.
    """
    return Renderer(sensor, grid, pattern, appearance, samples)(vertices)


def _fine_grid(sensor: Sensor, cell: float) -> tuple[int, int]:
    """Return the grid whose lines at rest are crossed at most `cell` px apart, where they are longest."""
    m, n = sensor.membrane.grid
    pixels = sensor.camera.point_to_pixel(sensor.membrane.rest).unflatten(0, (m, n))
    steps = [pixels.diff(dim=axis).norm(dim=-1).nan_to_num(0.0).amax(1 - axis).sum() for axis in (0, 1)]
    fine = [int(np.clip(float(length) / cell, size, FINEST_GRID)) + 1 for length, size in zip(steps, (m, n), strict=True)]
    return fine[0], fine[1]


def _spline_matrix(coarse: int, fine: int) -> Tensor:
    """Return weights `[fine, coarse]` of cubic interpolation between uniformly spaced values and finer, uniform ones."""
    spline = make_interp_spline(np.arange(coarse), np.eye(coarse), k=3)
    return torch.from_numpy(spline(np.linspace(0, coarse - 1, fine)))


def _each(*batches: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Yield the images of a batch one by one: one image has some million samples, enough to keep any device busy."""
    return zip(*(batch[None].flatten(0, -3) for batch in batches), strict=True)
