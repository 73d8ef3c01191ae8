"""Locating dots in a batch of frames: blobs at the pattern's scales, matched, then fitted to sub-pixel accuracy."""

import numpy as np
import torch
import torch.nn.functional as F
from kornia.filters import gaussian_blur2d
from scipy import ndimage
from scipy.spatial import Delaunay, cKDTree
from torch import nn

from torchmembrane.errors import MembraneError
from torchmembrane.markers.match import Coherence, DotMatcher, inverse_2x2, spacing

SOFTNESS = 0.6  # px, logistic scale of a dot's blurred outline
RING = 2.5  # widest ring of background around a dot in the fit, pixels of its level
FINEST = 2.0  # a dot's short half axis on its level of the pyramid is at least this, where it can be
LEVELS = 3
RIDGE = [1e-3, 100.0, 100.0, 1e-3, 1e-3, 1e-3, 0.3]  # of the fit: background, its slope, depth, shift, growth
STRAY = 0.5  # from where its neighbours predict it, pitches: a dot so far off is half trusted
FEWEST = 0.2  # mean confidence of a frame that is half trusted
FINEST_SIGMA = 1.4  # of the blob detector on a level of the pyramid, pixels of the level
SCALE_STEP = 1.6  # ratio of neighbouring scales of the blob detector at most


def half_axes(shapes):
    """Long and short half axis `[D, 2]` of the ellipses `shapes [D, 2, 2]`."""
    return np.linalg.svd(shapes, compute_uv=False)


def size_tolerance(shapes, sizes):
    """Standard deviation of a dot's log radius: wide, but less than half of what tells two sizes apart."""
    log_radius = 0.5 * np.log(np.abs(np.linalg.det(shapes)))
    if sizes.min() == sizes.max():
        return 0.45
    return float(np.clip(0.45 * abs(np.median(log_radius[sizes == 1]) - np.median(log_radius[sizes == 0])), 0.2, 0.45))


def pyramid(image):
    """`image [B, 1, H, W]` and its means over 2 x 2 and 4 x 4 pixels."""
    levels = [image]
    for _ in range(LEVELS - 1):
        levels.append(F.avg_pool2d(levels[-1], 2))
    return levels


def solve_positive(matrix, load):
    """`x [..., n]` with `matrix x = load`: Gauss-Jordan without pivoting, for positive definite `[..., n, n]`."""
    system = torch.cat([matrix, load[..., None]], -1)
    unit = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    for i in range(matrix.shape[-1]):
        row = system[..., i : i + 1, :] / system[..., i : i + 1, i : i + 1]
        system = system - (system[..., i : i + 1] - unit[:, i : i + 1]) * row
    return system[..., -1]


class EllipseFit(nn.Module):
    """Least-squares fit of a blurred ellipse on sloping background, `I = b_0 + b . y - a T(x - c)`, to every dot.

    Gauss-Newton steps on windows of the level of the pyramid that suits the dot's size. What is dark outside the
    outline, a neighbour or the world beyond the rim, loses its weight.
    """

    def __init__(self, pixels, shapes, image_size, size_tolerance, steps=3):
        super().__init__()
        width, height = image_size
        long, short = half_axes(shapes).T
        level = np.floor(np.log2(np.maximum(short / FINEST, 1))).astype(int).clip(0, LEVELS - 1)
        stride = 2**level
        sizes = np.array([(height // 2**k, width // 2**k) for k in range(LEVELS)])
        gap = (0.85 * spacing(pixels)[0] - 2 * long) / stride
        ring = np.clip(0.7 * gap, 1.5, RING) * stride
        half = int(np.ceil(((1.25 * long + ring) / stride).max()))
        step = np.arange(-half, half + 1)
        offset = np.stack(np.meshgrid(step, step)).reshape(2, -1)
        self.steps, self.size_tolerance = steps, size_tolerance
        self.register_buffer("offset", torch.as_tensor(offset))
        self.register_buffer("start", torch.as_tensor(np.concatenate([[0], sizes.prod(1).cumsum()])[level]))
        self.register_buffer("limit", torch.as_tensor(sizes[level][:, ::-1].copy() - 1))
        self.register_buffer("stride", torch.as_tensor(stride.astype(float)))
        self.register_buffer("ring", torch.as_tensor(ring))
        self.register_buffer("size", torch.as_tensor(np.linalg.norm(shapes, axis=(1, 2)) / 2**0.5))
        self.register_buffer("softness", torch.as_tensor(SOFTNESS * np.sqrt(stride)))
        self.register_buffer("ridge", torch.diag(torch.tensor(RIDGE, dtype=torch.float64)))

    def windows(self, levels, centre):
        """Values `[B, D, P]` around `centre [B, D, 2]`, their places `[B, D, 2, P]` px, and which lie in the image."""
        stride, limit = self.stride[:, None], self.limit[..., None]
        origin = ((centre.detach() - (stride - 1) / 2) / stride).round().to(torch.int64)
        pixel = origin[..., None] + self.offset
        inside = ((pixel >= 0) & (pixel <= limit)).all(-2)
        u, v = torch.minimum(pixel.clamp_min(0), limit).unbind(-2)
        index = self.start[:, None] + v * (self.limit[:, :1] + 1) + u
        flat = torch.cat([level.flatten(1) for level in levels], 1)
        values = flat.gather(1, index.flatten(1)).unflatten(1, index.shape[1:])
        return values, pixel * stride[..., None] + (stride[..., None] - 1) / 2, inside

    def forward(self, levels, centre, shape):
        """`levels` of `pyramid` with dark dots, `centre [B, D, 2]`, `shape [B, D, 2, 2]` to begin with.

        Returns centre `[B, D, 2]`, growth of the outline `[B, D]` px, and quality `[B, D]` in 0..1, from the share of
        the window's variance explained, the contrast `a / b_0`, and the size against that of `shape` or at rest.
        """
        values, place, inside = self.windows(levels, centre)
        trust = inside.to(values.dtype)
        mean = (values * trust).sum(-1, keepdim=True) / trust.sum(-1, keepdim=True).clamp_min(1)
        values = values - mean
        a, b, c, d = inverse_2x2(shape).flatten(-2)[..., None, :].unbind(-1)  # [B, D, 1]
        size = torch.linalg.vector_norm(shape, dim=(-2, -1)) / 2**0.5
        start, growth, softness = centre, torch.zeros_like(size), self.softness[:, None]
        for _ in range(self.steps):
            u, v = (place - centre[..., None]).unbind(-2)  # [B, D, P]
            y1, y2 = a * u + b * v, c * u + d * v
            normal_u, normal_v = a * y1 + c * y2, b * y1 + d * y2
            slope = (normal_u.square() + normal_v.square()).clamp_min(1e-12).sqrt()
            rho = (y1.square() + y2.square()).clamp_min(1e-12).sqrt()
            depth = (1 - rho) * rho / slope + growth[..., None]  # inside the outline, px
            template = torch.sigmoid(depth / softness)
            edge = template * (1 - template) / softness
            weight = trust * torch.sigmoid((depth + self.ring[:, None]) / (0.5 * self.stride[:, None]))
            shift = -edge / slope
            columns = torch.ones_like(edge), y1, y2, -template, shift * normal_u, shift * normal_v, -edge
            basis = torch.stack(columns, -2)
            weighted = basis * weight[..., None, :]
            fit = solve_positive(weighted @ basis.mT + self.ridge, (weighted @ values[..., None]).squeeze(-1))
            residual = values - (fit[..., None, :] @ basis).squeeze(-2)
            amplitude = fit[..., 3]
            gain = amplitude / (amplitude**2 + 1e-6)
            reach = 0.5 * size + 0.5
            centre = centre + reach[..., None] * torch.tanh(fit[..., 4:6] * (gain / reach)[..., None])
            centre = start + torch.maximum(torch.minimum(centre - start, size[..., None] + 1), -size[..., None] - 1)
            growth = (growth + 0.5 * size * torch.tanh(2 * fit[..., 6] * gain / size)).clamp(-0.5 * size, 0.8 * size)
            intruder = (1 - template) * (-residual * gain[..., None] / 0.35).clamp(0, 10) ** 4
            trust = inside / (1 + intruder)
        background = (weight * values).sum(-1) / weight.sum(-1).clamp_min(1)
        spread = (weight * (values - background[..., None]) ** 2).sum(-1)
        explained = 1 - (weight * residual**2).sum(-1) / (spread + 1e-6)
        contrast = amplitude / (fit[..., 0] + mean[..., 0]).clamp_min(1e-2)
        quality = torch.sigmoid(12 * (explained - 0.6)) * torch.sigmoid(40 * (contrast - 0.12))
        grown = torch.minimum(*(torch.log((size + growth) / usual).square() for usual in (size, self.size)))
        return centre, growth, quality * torch.exp(-grown / (2 * self.size_tolerance) ** 2)


class BlobDetector(nn.Module):
    """The strongest `count` dark blobs: maxima over place and scale of the normalised Hessian's determinant."""

    def __init__(self, radii, pitch, count, inside):
        super().__init__()
        smallest, largest = np.percentile(radii, [5, 95])
        steps = np.log(max(largest / smallest, 1.001)) / np.log(SCALE_STEP)
        radii = np.geomspace(smallest, largest, 1 + int(np.ceil(steps)))
        levels = np.log2(np.maximum(radii / (FINEST_SIGMA * np.sqrt(2)), 1)).astype(int).clip(0, LEVELS - 1)
        self.scales = [(int(k), float(r / np.sqrt(2) / 2**k)) for k, r in zip(levels, radii, strict=True)]
        self.level = int(levels[0])
        self.stride = 2**self.level
        self.reach = max(1, int(0.125 * pitch / self.stride))
        self.count = count
        stencils = [[[0, 0, 0], [1, -2, 1], [0, 0, 0]], [[0, 1, 0], [0, -2, 0], [0, 1, 0]]]
        stencils.append([[0.25, 0, -0.25], [0, 0, 0], [-0.25, 0, 0.25]])
        self.register_buffer("stencils", torch.tensor(stencils, dtype=torch.float64)[:, None])
        self.register_buffer("log_radii", torch.as_tensor(np.log(radii)))
        self.register_buffer("inside", F.avg_pool2d(inside, self.stride) > 0.5)

    def response(self, image, sigma):
        """`sigma^2 sqrt(det Hessian)` where the image is darkest, else 0."""
        side = 2 * int(np.ceil(2.5 * sigma)) + 1
        blurred = gaussian_blur2d(image, (side, side), (sigma, sigma), border_type="replicate")
        uu, vv, uv = F.conv2d(F.pad(blurred, (1, 1, 1, 1), mode="replicate"), self.stencils).split(1, 1)
        return sigma**2 * ((uu * vv - uv**2) * (uu + vv > 0)).clamp_min(1e-16).sqrt()

    def forward(self, levels):
        """`levels` of `pyramid` with dark dots -> blobs `[B, K, 2]` px, log radius `[B, K]`, strength `[B, K]`."""
        size = levels[self.level].shape[-2:]
        responses = [self.response(levels[k], sigma) for k, sigma in self.scales]
        background = gaussian_blur2d(F.avg_pool2d(levels[-1], 2), (7, 7), (2.0, 2.0), border_type="replicate")
        maps = [F.interpolate(x, size, mode="bilinear") for x in (*responses, background)]
        response = torch.cat(maps[:-1], 1) / (maps[-1] + 0.05)
        peak = response.amax(1, keepdim=True) * self.inside
        cells = F.max_pool2d(peak, 2)
        reach = self.reach
        highest = F.max_pool2d(cells, (1, 2 * reach + 1), 1, (0, reach))
        highest = F.max_pool2d(highest, (2 * reach + 1, 1), 1, (reach, 0))
        strength, cell = (cells * (cells == highest)).flatten(1).topk(self.count)
        columns = cells.shape[-1]
        corner = (cell // columns) * 2 * size[1] + (cell % columns) * 2
        four = torch.stack([corner, corner + 1, corner + size[1], corner + size[1] + 1], -1)  # the cell's pixels
        inner = peak.flatten(1).gather(1, four.flatten(1)).unflatten(1, four.shape[1:]).argmax(-1, keepdim=True)
        index = four.gather(-1, inner).squeeze(-1)
        scales = response.flatten(2).gather(2, index[:, None].expand(-1, len(self.scales), -1)) ** 4
        log_radius = (scales * self.log_radii[:, None]).sum(1) / scales.sum(1).clamp_min(1e-20)
        place = torch.stack([index % size[1], index // size[1]], -1).to(strength.dtype)
        return place * self.stride + (self.stride - 1) / 2, log_radius, strength


def membrane_mask(pixels, anchors, image_size):
    """`[1, 1, H, W]` 1 inside the rim and 2 pixels off it, else 0: the short triangles between dots and anchors."""
    width, height = image_size
    if anchors is None:
        return torch.ones(1, 1, height, width, dtype=torch.float64)
    points = np.concatenate([pixels, anchors])
    triangulation = Delaunay(points)
    corners = points[triangulation.simplices]
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max(1)
    pitch = np.append(spacing(pixels)[1], np.zeros(len(anchors)))[triangulation.simplices].max(1)
    kept = np.append(longest < 3 * pitch, False)
    inside = kept[triangulation.find_simplex(np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1))]
    inside = ndimage.binary_erosion(ndimage.binary_closing(inside, iterations=2), iterations=2)
    return torch.as_tensor(inside, dtype=torch.float64)[None, None]


def draw(pixels, shapes, image_size):
    """The pattern as dark dots on white, `[1, 1, H, W]`."""
    width, height = image_size
    image = np.ones((height, width))
    for centre, shape in zip(pixels, shapes, strict=True):
        reach = int(half_axes(shape)[0]) + 4
        low, high = np.round(centre).astype(int) - reach, np.round(centre).astype(int) + reach + 1
        u, v = np.arange(max(low[0], 0), min(high[0], width)), np.arange(max(low[1], 0), min(high[1], height))
        y = (np.stack(np.meshgrid(u, v), -1) - centre) @ np.linalg.inv(shape).T
        depth = (1 - np.linalg.norm(y, axis=-1)) * np.sqrt(abs(np.linalg.det(shape)))
        image[np.ix_(v, u)] -= 0.9 / (1 + np.exp(-depth / SOFTNESS))
    return torch.as_tensor(image.clip(0))[None, None]


class DotLocator(nn.Module):
    """Pixels of the pattern's dots in each frame of a batch, with a confidence.

    Blobs at the pattern's scales, matched along the smooth flow inwards from the rim, then a least-squares fit of a
    blurred ellipse on sloping background. A lost dot has confidence 0 and its predicted pixel.

    pattern: `DotPattern`, the markers in the rest image; image_size: width, height; polarity: "dark" or "light";
    anchors: `[A, 2]` pixels of the rim, where nothing moves, closer together than the dots; without them the pattern's
    own outline has to do.
    Wrong when the flow changes by more than about half a pitch from one dot to the next: spacing below about half of
    that at rest, rotation or shear of more than about 25 degrees, or a flow of more than two pitches. Most such regions
    end in a seam and are lost with all that is near it; what is left is confidently a whole pitch off, one-size patterns
    more often. Without anchors a pattern that moves as a whole by a pitch, two sizes by the pitch of the large ones,
    looks as at rest: that cannot be told at all. A dot that is missing beside a blob of its size may be taken for it.
    Where many dots are missing (20 %) and as many false ones stand among them, right dots are lost as well.
    """

    def __init__(self, pattern, image_size, polarity, anchors=None):
        super().__init__()
        if polarity not in ("dark", "light"):
            raise MembraneError(f'DotLocator: polarity is {polarity!r}, expected "dark" or "light"')
        pixels, shapes = np.asarray(pattern.pixels, float), np.asarray(pattern.shapes, float)
        if len(pixels) < 6 or not (np.isfinite(pixels).all() and np.isfinite(shapes).all()):
            raise MembraneError(
                f"DotLocator: {len(pixels)} dots, {int(np.isnan(pixels).any(1).sum())} of them NaN, expected at least "
                "6, all finite; leave out dots that were not seen in the rest image"
            )
        self.polarity, self.image_size = polarity, tuple(image_size)
        tolerance = size_tolerance(shapes, np.asarray(pattern.sizes))
        self.fit = EllipseFit(pixels, shapes, image_size, tolerance)
        inside = membrane_mask(pixels, anchors, image_size)
        radii = np.sqrt(np.abs(np.linalg.det(shapes)))
        self.detect = BlobDetector(radii, spacing(pixels)[0].min(), int(1.2 * len(pixels)) + 16, inside)
        drawn = pyramid(draw(pixels, shapes, image_size))
        blobs, log_radius, strength = (x[0].numpy() for x in self.detect.double()(drawn))
        own = cKDTree(blobs).query(pixels)[1]
        self.match = DotMatcher(pixels, log_radius[own], tolerance, anchors)
        self.coherence = Coherence(pixels, log_radius[own], tolerance)
        self.register_buffer("strength", torch.as_tensor(strength[own]))
        self.register_buffer("rest", torch.as_tensor(pixels))
        self.register_buffer("shapes", torch.as_tensor(shapes))
        self.float()

    def forward(self, image):
        """`image [B, 1, H, W]` in 0..1 -> pixels `[B, D, 2]`, confidence `[B, D]` in 0..1."""
        levels = pyramid(1 - image if self.polarity == "light" else image)
        blobs, log_radius, strength = self.detect(levels)
        rest = self.rest
        nearest = (blobs[:, :, None] - rest).square().sum(-1).argmin(-1)
        relative = strength / self.strength[nearest]
        level = relative[:, : rest.shape[0] // 2].mean(1, keepdim=True)
        valid = torch.sigmoid(20 * (relative / (level + 1e-3) - 0.4))
        place, certainty, strain = self.match(blobs, log_radius, valid)
        _, gradient, _ = self.match.predict(certainty, place - rest, strain)
        shape = self.shapes + gradient.clamp(-0.6, 0.6) @ self.shapes
        pixels, _, quality = self.fit(levels, place, shape)
        predicted, _, _ = self.match.predict(certainty * quality, pixels - rest, strain)
        stray = (pixels - rest - predicted).square().sum(-1).clamp_min(1e-12).sqrt() / self.match.nearest
        confidence = quality * torch.sigmoid(20 * (STRAY - stray))
        confidence = confidence * self.coherence(pixels, confidence, strain, rest + predicted, blobs, log_radius, valid)
        confidence = confidence * torch.sigmoid(40 * (confidence.mean(-1, keepdim=True) - FEWEST))
        return torch.where(confidence[..., None] > 0.05, pixels, rest + predicted), confidence
