"""Locating dots in a batch of frames: blobs at the pattern's scales, matched, then fitted to sub-pixel accuracy."""

from functools import reduce

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from scipy.spatial import Delaunay, cKDTree
from torch import nn

from ..errors import MembraneError
from .match import Coherence, DotMatcher, spacing, square_distance

SOFTNESS = 0.6  # px, logistic scale of a dot's blurred outline
RING = 2.5  # widest ring of background around a dot in the fit, pixels of its level
FINEST = 2.0  # a dot's short half axis on its level of the pyramid is at least this, where it can be
LEVELS = 3
RIDGE = [1e-3, 100.0, 100.0, 1e-3, 1e-3, 1e-3, 0.3]  # of the fit: background, its slope over the dot, depth, shift, growth
STRAY = 0.5  # from where its neighbours predict it, pitches: a dot so far off is half trusted
FEWEST = 0.2  # mean confidence of a frame that is half trusted
FINEST_SIGMA = 0.9  # of the blob detector on a level of the pyramid, pixels of the level
BLOCK = 32  # rows of a band matrix that are multiplied at once
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


def metric_of(shape):
    """`(S S^T)^-1 [2, 2, ...]` of `shape [..., 2, 2]`: `x^T (S S^T)^-1 x = |S^-1 x|^2`."""
    a, b, c, d = shape.flatten(-2).movedim(-1, 0).split(1)
    uv, area = a * c + b * d, a * d - b * c
    return torch.cat([c * c + d * d, -uv, -uv, a * a + b * b]).unflatten(0, (2, 2)) / (area * area)


def solve_positive(system):
    """`x [n, ...]` with `matrix x = load` from `system = [matrix, load] [n, n + 1, ...]`: Gauss-Jordan without pivoting.

    The matrix must be positive definite; the batch comes last, so that each row is one long vector.
    """
    n = system.shape[0]
    unit = torch.eye(n, dtype=system.dtype, device=system.device).reshape(n, n, *(1,) * (system.ndim - 2))
    for i in range(n):
        column, rest = system.split([1, system.shape[1] - 1], 1)
        system = rest - (column - unit[:, i : i + 1]) * (rest[i : i + 1] / column[i : i + 1])
    return system[:, 0]


class EllipseFit(nn.Module):
    """Least-squares fit of a blurred ellipse on sloping background, `I = b_0 + b . y - a T(x - c)`, to every dot.

    Gauss-Newton steps on windows of the level of the pyramid that suits the dot's size, in pixels of that level; the first
    step sees a quarter of the pixels. What is dark outside the outline, a neighbour or the world beyond the rim, loses its
    weight.
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
        half = int(np.round(((long + ring) / stride).max()))
        half = min(half, (min(sizes[level].min(0)) - 1) // 2)
        step = np.arange(-half, half + 1)
        offset = np.stack(np.meshgrid(step, step)).reshape(2, -1)
        offset = offset[:, np.hypot(*offset) <= half + 0.5]
        sparse = (offset % 2 == 0).all(0)
        offset = offset[:, np.argsort(~sparse, kind="stable")]
        self.size_tolerance, self.half = size_tolerance, half
        self.counts = [int(sparse.sum())] + [len(sparse)] * (steps - 1)
        self.levels = [(int(k), torch.as_tensor(np.flatnonzero(level == k))) for k in np.unique(level)]
        order = np.concatenate([dots for _, dots in self.levels])
        self.register_buffer("order", torch.as_tensor(np.argsort(order)))
        u, v = offset.astype(float)
        self.register_buffer("linear", torch.as_tensor(np.stack([np.ones_like(u), u, v])))
        self.register_buffer("moments", torch.as_tensor(np.stack([u**0, u, v, u, u * u, u * v, v, u * v, v * v], -1)))
        for k, dots in self.levels:
            self.register_buffer(f"dots{k}", dots)
            self.register_buffer(f"step{k}", torch.as_tensor(offset[1] * sizes[k, 1] + offset[0]))
        self.register_buffer("pixel_steps", torch.as_tensor(np.stack([np.ones_like(level), sizes[level, 1]], -1)))
        self.register_buffer("limit", torch.as_tensor(sizes[level][:, ::-1].copy() - 1 - half))
        self.register_buffer("stride", torch.as_tensor(stride.astype(float)))
        self.register_buffer("ring", torch.as_tensor(ring / stride))
        self.register_buffer("size", torch.as_tensor(np.linalg.norm(shapes, axis=(1, 2)) / 2**0.5 / stride))
        self.register_buffer("sharpness", torch.as_tensor(np.sqrt(stride) / SOFTNESS))
        ridge = np.diag(RIDGE)[..., None] * np.ones(len(stride))
        ridge[1:3, 1:3] = RIDGE[1] * np.moveaxis(shapes @ shapes.swapaxes(1, 2) / stride[:, None, None] ** 2, 0, -1)
        ridge[4:] *= stride**2
        self.register_buffer("ridge", torch.as_tensor(np.concatenate([ridge, np.zeros((7, 1, len(stride)))], 1))[:, :, None])

    def windows(self, levels, centre):
        """Values `[B, D, P]` of the pixels of a disc about `centre [B, D, 2]`, and the disc's middle `[B, D, 2]` px.

        Near the image's border the disc stops where its last pixel meets the border.
        """
        stride = self.stride[:, None]
        middle = ((centre.detach() - (stride - 1) / 2) / stride).round().to(torch.int64)
        pixel = torch.minimum(middle.clamp_min(self.half), self.limit)  # of integers: also where the centre is NaN
        first, values = (pixel * self.pixel_steps).sum(-1, keepdim=True), []
        for k, _ in self.levels:
            index = first.index_select(1, getattr(self, f"dots{k}")) + getattr(self, f"step{k}")
            values.append(levels[k].flatten(1).gather(1, index.flatten(1)).unflatten(1, index.shape[1:]))
        values = values[0] if len(values) == 1 else torch.cat(values, 1)[:, self.order]
        return values, pixel * stride + (stride - 1) / 2

    def forward(self, levels, centre, shape):
        """`levels` of `pyramid` with dark dots, `centre [B, D, 2]`, `shape [B, D, 2, 2]` to begin with.

        Returns centre `[B, D, 2]`, growth of the outline `[B, D]` px, and quality `[B, D]` in 0..1, from the share of
        the window's variance explained, the contrast `a / b_0`, and the size against that of `shape` or at rest.
        """
        values, middle = self.windows(levels, centre)
        mean = values.mean(-1, keepdim=True)
        values = values - mean
        shape = shape / self.stride[:, None, None]
        size = torch.linalg.vector_norm(shape, dim=(-2, -1)) / 2**0.5
        far = size + 1 / self.stride
        reach = torch.stack([0.5 * far, 0.5 * far, 0.5 * size])  # of a step, in place and growth
        lowest, highest = torch.stack([-far, -far, -0.5 * size]), torch.stack([far, far, 0.8 * size])
        metric = metric_of(shape)
        start = ((middle - centre) / self.stride[:, None]).movedim(-1, 0)
        change, fit, gain = torch.zeros_like(reach), None, None  # of place and growth, [3, B, D]
        for k, count in enumerate(self.counts):
            off, linear, seen = start - change[:2], self.linear[:, :count], values[..., :count]
            normal = torch.cat([(metric * off).sum(1, keepdim=True), metric], 1).movedim(1, -1)
            n_u, n_v = (rows @ linear for rows in normal)
            off_u, off_v, growth = torch.cat([off, change[2:]]).movedim(0, -1).split(1, -1)
            square = (linear[1] + off_u) * n_u + (linear[2] + off_v) * n_v + 1e-12
            slack = 1 / (n_u * n_u + n_v * n_v + 1e-12).sqrt()
            depth = (square.sqrt() - square) * slack + growth  # inside the outline
            template = torch.sigmoid(depth * self.sharpness[:, None])
            outside = 1 - template
            edge = template * outside * self.sharpness[:, None]
            weight = torch.sigmoid(2 * (depth + self.ring[:, None]))
            if k > 0:
                intruder = fit[:3].movedim(0, -1) @ linear + fit[3][..., None] * template - seen
                intruder = (intruder * (-gain / 0.35)[..., None]).clamp(0, 10)
                intruder = intruder * intruder
                weight = weight / (1 + outside * (intruder * intruder))
            shift = edge * slack
            basis = torch.stack([template, shift * n_u, shift * n_v, edge, seen], -2)  # and 1, u, v
            weighed = basis * weight[..., None, :]
            plain, mixed, own = weight @ self.moments[:count], weighed @ linear.mT, weighed @ basis.mT
            gram = torch.cat([torch.cat([plain.unflatten(-1, (3, 3)), mixed.mT], -1), torch.cat([mixed, own], -1)], -2)
            gram = gram.movedim((-2, -1), (0, 1))
            fit = solve_positive(gram[:7] + self.ridge)  # [7, B, D]
            gain = fit[3] / (fit[3] * fit[3] + 1e-6)
            change = change + reach * torch.tanh(fit[4:] * gain / reach)
            change = torch.maximum(torch.minimum(change, highest), lowest)
        moved, growth, amplitude = change[:2].movedim(0, -1), change[2], -fit[3]
        miss = torch.cat([fit, -torch.ones_like(fit[:1])])
        spread = gram[7, 7] - gram[0, 7].square() / gram[0, 0].clamp_min(1)
        explained = 1 - ((gram * miss).sum(1) * miss).sum(0) / (spread.clamp_min(0) + 1e-6)
        background = (fit[1:3] * off).sum(0)
        contrast = amplitude / (fit[0] - background + mean[..., 0]).clamp_min(1e-2)
        quality = torch.sigmoid(12 * (explained - 0.6)) * torch.sigmoid(40 * (contrast - 0.12))
        grown = torch.minimum(*(torch.log((size + growth) / usual).square() for usual in (size, self.size)))
        quality = quality * torch.exp(-grown / (2 * self.size_tolerance) ** 2)
        return centre + self.stride[:, None] * moved, self.stride * growth, quality


def blur_rows(size, sigma, rows):
    """`[len(rows), size]`: a Gaussian about each of `rows` over `size` pixels, the border's repeated beyond it."""
    reach = int(np.ceil(2.5 * sigma))
    step = np.arange(-reach, reach + 1)
    kernel = np.exp(-0.5 * (step / sigma) ** 2)
    matrix = np.zeros((len(rows), size))
    place = (np.clip(rows, 0, size - 1)[:, None] + step).clip(0, size - 1)
    np.add.at(matrix, (np.arange(len(rows))[:, None], place), kernel / kernel.sum())
    return matrix


def linear_rows(size, rows):
    """`[len(rows), size]`: linear interpolation of `size` values at `rows`, which need not be whole."""
    rows = np.clip(rows, 0, size - 1)
    below = np.minimum(rows.astype(int), size - 2)
    matrix = np.zeros((len(rows), size))
    matrix[np.arange(len(rows)), below] = 1 - (rows - below)
    matrix[np.arange(len(rows)), below + 1] = rows - below
    return matrix


def halves(size):
    """`[size // 2, size]`: means of pairs."""
    return np.kron(np.eye(size // 2, dtype=float), [0.5, 0.5]) if size % 2 == 0 else np.pad(halves(size - 1), ((0, 0), (0, 1)))


def bands(matrix):
    """A narrow band `matrix [m, n]` by blocks of rows `[N, BLOCK, width]`, zero beyond `m`, and their columns `[N, width]`."""
    blocks = np.pad(matrix, ((0, -len(matrix) % BLOCK), (0, 0))).reshape(-1, BLOCK, matrix.shape[1])
    ends = np.array([np.flatnonzero(block.any(0))[[0, -1]] for block in blocks])
    width = (ends[:, 1] - ends[:, 0]).max() + 1
    columns = np.minimum(ends[:, :1], matrix.shape[1] - width) + np.arange(width)
    return np.take_along_axis(blocks, columns[:, None], 2), columns


class BlobDetector(nn.Module):
    """The strongest `count` dark blobs: maxima over place and scale of the normalised Hessian's determinant.

    Only the box that holds the membrane is looked at. A Gaussian over it is two products with constant band matrices, on
    the level of the pyramid that suits the scale; maxima are looked for on cells of 2 x 2 pixels of the finest of them.
    """

    def __init__(self, radii, pitch, count, inside):
        super().__init__()
        smallest, largest = np.percentile(radii, [5, 95])
        steps = np.log(max(largest / smallest, 1.001)) / np.log(SCALE_STEP)
        radii = np.geomspace(smallest, largest, 1 + int(np.ceil(steps)))
        levels = np.log2(np.maximum(radii / (FINEST_SIGMA * np.sqrt(2)), 1)).astype(int).clip(0, LEVELS - 1)
        self.scales = [(int(k), float(r / np.sqrt(2) / 2**k)) for k, r in zip(levels, radii, strict=True)]
        self.cell = 2 ** (int(levels[0]) + 1)
        self.reach, self.count = max(1, int(0.25 * pitch / self.cell)), count
        block, sides = max(self.cell, 2 ** (LEVELS - 1)), inside.shape[-2:]
        lit = [np.flatnonzero(inside[0, 0].numpy().any(1 - axis)) for axis in (0, 1)]
        self.box = [
            (int(on[0]) // block * block, min(-(-(int(on[-1]) + 1) // block), side // block) * block)
            for on, side in zip(lit, sides, strict=True)
        ]
        (v0, v1), (u0, u1) = self.box
        self.parts = {}
        self.register_buffer("log_radii", torch.as_tensor(np.log(radii)))
        self.register_buffer("inside", (F.avg_pool2d(inside[..., v0:v1, u0:u1], self.cell) > 0.5).double())
        for axis, ((begin, end), side) in enumerate(zip(self.box, sides, strict=True)):
            cells = (np.arange(begin, end, self.cell) + (self.cell - 1) / 2) / 2 ** (LEVELS - 1)
            for i, (k, sigma) in enumerate(self.scales):
                rows = np.arange(begin // 2**k - 1, end // 2**k + 1)
                blocks, columns = bands(blur_rows(side // 2**k, sigma, rows))
                self.register_buffer(f"blur{i}_{'vu'[axis]}", torch.as_tensor(blocks))
                self.register_buffer(f"seen{i}_{'vu'[axis]}", torch.as_tensor(columns))
                if 2**k > self.cell:
                    places = (np.arange(begin, end, self.cell) + (self.cell - 1) / 2 - (2**k - 1) / 2) / 2**k
                    self._matrix(f"spread{i}", axis, linear_rows(len(rows) - 2, places - begin // 2**k))
            coarse = side // 2 ** (LEVELS - 1)
            places = (cells - (2 ** (LEVELS - 1) - 1) / 2**LEVELS - 0.5) / 2
            smooth = blur_rows(coarse // 2, 2.0, np.arange(coarse // 2)) @ halves(coarse)
            self._matrix("background", axis, linear_rows(coarse // 2, places) @ smooth)

    def _matrix(self, name, axis, matrix):
        """Keep `matrix` for `apply`, without the columns of pixels that it does not look at."""
        used = np.flatnonzero(matrix.any(0))
        part = slice(int(used[0]), int(used[-1]) + 1)
        self.parts.setdefault(name, [])[axis:] = [part]
        matrix = matrix[:, part] if axis == 0 else matrix[:, part].T
        self.register_buffer(f"{name}_{'vu'[axis]}", torch.as_tensor(matrix.copy()))

    def apply(self, name, image):
        v, u = self.parts[name]
        return getattr(self, f"{name}_v") @ image[..., v, u] @ getattr(self, f"{name}_u")

    def response(self, levels, i):
        """`sigma^4 det Hessian` where the image is darkest, else 0, `[B, 1, rows, columns]` of the cells."""
        (k, sigma), blurred = self.scales[i], levels[self.scales[i][0]]
        for axis in "vu":
            seen = getattr(self, f"seen{i}_{axis}")
            blocks = blurred.index_select(-2, seen.flatten()).unflatten(-2, seen.shape)
            blurred = (getattr(self, f"blur{i}_{axis}") @ blocks).flatten(-3, -2).mT
        rows, columns = ((end - begin) // 2**k for begin, end in self.box)
        above, middle, below = (blurred[..., n : n + rows, :] for n in range(3))
        left, centre, right = (slice(n, n + columns) for n in range(3))
        uu = middle[..., right] + middle[..., left] - 2 * middle[..., centre]
        vv = (below + above - 2 * middle)[..., centre]
        along = below - above
        uv = along[..., right] - along[..., left]
        response = (uu.relu() * vv.relu() - uv * uv / 16).relu()  # uu and vv have one sign where the determinant is positive
        if 2**k > self.cell:
            response = self.apply(f"spread{i}", response)
        return sigma**4 * (F.max_pool2d(response, 2) if 2**k < self.cell else response)

    def forward(self, levels):
        """`levels` of `pyramid` with dark dots -> blobs `[B, K, 2]` px, log radius `[B, K]`, strength `[B, K]`."""
        background = self.apply("background", levels[-1]) + 0.05
        scales = [self.response(levels, i) for i in range(len(self.scales))]
        peak = reduce(torch.maximum, scales) / background.square() * self.inside
        reach = self.reach
        highest = F.max_pool2d(peak, (1, 2 * reach + 1), 1, (0, reach))
        highest = F.max_pool2d(highest, (2 * reach + 1, 1), 1, (reach, 0))
        strength, cell = (peak * (peak == highest)).flatten(1).topk(self.count)
        rows, columns = peak.shape[-2:]
        sides = torch.stack([cell - 1, cell + 1, cell - columns, cell + columns], -1).clamp(0, rows * columns - 1)
        beside = (
            peak.flatten(1).gather(1, sides.flatten(1)).unflatten(1, (-1, 2, 2)).clamp_min(1e-12).sqrt()
        )  # [B, K, uv, before or after]
        strength = strength.clamp_min(1e-20).sqrt()
        before, after = beside.unbind(-1)
        shift = 0.5 * (after - before) / (2 * strength[..., None] - after - before).clamp_min(1e-12)
        place = torch.stack([cell % columns, cell // columns], -1) + shift.clamp(-0.5, 0.5)
        scale = torch.cat(scales, 1).flatten(2).gather(2, cell[:, None].expand(-1, len(self.scales), -1)).square()
        log_radius = (scale * self.log_radii[:, None]).sum(1) / scale.sum(1).clamp_min(1e-20)
        (v0, _), (u0, _) = self.box
        place = place * self.cell + (self.cell - 1) / 2 + place.new_tensor([u0, v0])
        return place, log_radius, strength


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

    Blobs at the pattern's scales, matched from where the dots were or else along the smooth flow inwards from the rim, then
    a least-squares fit of a blurred ellipse on sloping background. A lost dot has confidence 0 and its predicted pixel.

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
        blobs, log_radius, strength = (x[strength > 1e-6] for x in (blobs, log_radius, strength))  # the rest fill up the count
        own = cKDTree(blobs).query(pixels)[1]
        self.match = DotMatcher(pixels, log_radius[own], tolerance, anchors)
        self.coherence = Coherence(pixels, log_radius[own], tolerance)
        self.register_buffer("strength", torch.as_tensor(strength[own]))
        self.register_buffer("rest", torch.as_tensor(pixels))
        self.register_buffer("shapes", torch.as_tensor(shapes))
        self.float()

    def forward(self, image, previous=None):
        """`image [B, 1, H, W]` in 0..1 -> pixels `[B, D, 2]`, confidence `[B, D]` in 0..1.

        `previous [B, D, 2]`: pixels in the frames before, NaN where lost, from which the dots are followed (else from rest).
        """
        *levels, blobs, log_radius, valid = self.begin(image)
        return self.end(*levels, blobs, log_radius, valid, *self.match(blobs, log_radius, valid, previous))

    def begin(self, image):
        """The levels of the pyramid, and the blobs: places `[B, K, 2]`, log radius `[B, K]`, and how surely one is a dot."""
        levels, rest = pyramid(1 - image if self.polarity == "light" else image), self.rest
        blobs, log_radius, strength = self.detect(levels)
        nearest = square_distance(blobs - self.match.origin, self.match.pixels).argmin(-1)
        relative = strength / self.strength[nearest]
        level = relative[:, : rest.shape[0] // 2].mean(1, keepdim=True)
        valid = torch.sigmoid(20 * (relative / (level + 1e-3) - 0.4))
        return *levels, blobs, log_radius, valid

    def end(self, level_0, level_1, level_2, blobs, log_radius, valid, place, certainty, strain):
        """Pixels and confidence, by the fit about where the matcher places the dots."""
        levels, rest = (level_0, level_1, level_2), self.rest
        _, gradient, _ = self.match.predict(certainty, place - rest, strain)
        shape = self.shapes + gradient.clamp(-0.6, 0.6) @ self.shapes
        pixels, _, quality = self.fit(levels, place, shape)
        predicted, _, _ = self.match.predict(certainty * quality, pixels - rest, strain)
        stray = (pixels - rest - predicted).square().sum(-1).clamp_min(1e-12).sqrt() / self.match.nearest
        confidence = quality * torch.sigmoid(20 * (STRAY - stray))
        confidence = confidence * self.coherence(pixels, confidence, strain, rest + predicted, blobs, log_radius, valid)
        confidence = confidence * torch.sigmoid(40 * (confidence.mean(-1, keepdim=True) - FEWEST))
        return torch.where(confidence[..., None] > 0.05, pixels, rest + predicted), confidence
