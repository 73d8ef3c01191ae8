"""Matching: which blob of the frame is which dot, grown inwards from the rim along the smooth flow."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import nn

SETTLING = 6  # steps after the growth has reached every dot
FOLLOWING = 1  # steps after dots are followed from where they were
KEPT = 0.3  # certainty of a dot that could be followed
WIDTHS = (0.35, 0.3, 0.25, 0.2, 0.2, 0.2)  # pitches, of the fits of the local deformation
WIDTH = 1.1  # of the local average, pitches
RIDGE = 0.5  # pulls the flow's gradient to the one measured, where neighbours do not fix it
TOLERANCE = 0.30  # standard deviation of a prediction, pitches
NEIGHBOURS = 8
SEAM = 2.0  # width of the neighbourhood in which a seam is looked for, pitches
TEAR = 0.045  # root of the share of dots lost and blobs left over, times the relative error of steps
CLAIM = 0.35  # a blob so near to a dot is the dot's, pitches
RIVAL = 0.05  # a blob left over is as near to the prediction as the dot's own, pitches
SUPPORT = 0.8  # sure nodes, weighed by distance, that a prediction needs
FAR = 1e6
FADED = 30.0  # exponent of a weight that no longer counts; subnormal numbers are slow
MINORS = (  # adjugate [9] of a symmetric matrix from its entries 00 01 02 11 12 22: products a b - c d
    (3, 4, 1, 4, 0, 1, 1, 1, 0),
    (5, 2, 4, 2, 5, 2, 4, 2, 3),
    (4, 1, 3, 1, 2, 0, 3, 0, 1),
    (4, 5, 2, 5, 2, 4, 2, 4, 1),
)


def spacing(pixels):
    """`[D]` distance of each dot to its nearest neighbour and `[D]` the mean over its four nearest."""
    distance = cKDTree(pixels).query(pixels, k=min(5, len(pixels)))[0][:, 1:]
    return distance[:, 0], distance.mean(1)


def thin_out(points, gap):
    """Every point farther than `gap` from those kept before it."""
    kept = []
    for point in points:
        if all(np.hypot(*(point - other)) > gap for other in kept):
            kept.append(point)
    return np.array(kept).reshape(-1, 2)


def sectors(pixels):
    """`[7, D]` 0 or 1: the pattern cut into its middle and six outer parts."""
    around = pixels - pixels.mean(0)
    radius, angle = np.hypot(*around.T), np.arctan2(*around.T)
    part = np.where(radius < np.quantile(radius, 1 / 7), 6, ((angle / (2 * np.pi) + 0.5) * 6).astype(int) % 6)
    return (part == np.arange(7)[:, None]).astype(float)


def square_distance(x, y):
    """`[..., K, D]` between the points `x [..., K, 2]` and `y [..., D, 2]`."""
    return (x.square().sum(-1)[..., None] + y.square().sum(-1)[..., None, :] - 2 * x @ y.mT).clamp_min(0)


def mapping():
    """`[8, 24]`: of `A = [[a, b], [c, d]]`, `a b c d a^2+c^2 ab+cd b^2+d^2 1` to the matrix `[4, 6]` that takes monomials
    `u v uu uv vv 1` of `x` to `A x`, `|A x|^2` and 1.
    """
    matrix = np.zeros((8, 4, 6))
    matrix[np.arange(8), [0, 0, 1, 1, 2, 2, 2, 3], [0, 1, 0, 1, 2, 3, 4, 5]] = [1, 1, 1, 1, 1, 2, 1, 1]
    return torch.as_tensor(matrix.reshape(8, 24))


class LocalDeformation(nn.Module):
    """The deformation gradient at every blob of a frame, from the arrangement of the blobs around it alone.

    The dots next to the rest dot at that place are mapped by `A`, laid on the nearest blobs, and `A` fitted, a fixed
    number of times, with an average over nearby blobs between. Nothing needs to be known of which blob is which dot.
    Blobs are the last axis throughout.
    """

    def __init__(self, pixels):
        super().__init__()
        near = cKDTree(pixels).query(pixels, k=min(NEIGHBOURS + 1, len(pixels)))[1][:, 1:]
        pitch = spacing(pixels)[1]
        around = (pixels[near] - pixels[:, None]) / pitch[:, None, None]
        self.register_buffer("pixels", torch.as_tensor(pixels))
        u, v = np.moveaxis(around, -1, 0)
        self.register_buffer("around", torch.as_tensor(np.stack([u, v, u * u, u * v, v * v, np.ones_like(u)], 1)))
        self.register_buffer("pitch", torch.as_tensor(pitch))
        self.register_buffer("mapping", mapping())

    def forward(self, blobs, valid):
        """`blobs [B, K, 2]`, `valid [B, K]` in 0..1 -> gradient `[B, 2, 2, K]`."""
        gradient, *scene = self.begin(blobs, valid)
        for width in WIDTHS:
            (gradient,) = self.refine(gradient, *scene, valid, width)
        return gradient

    def begin(self, blobs, valid):
        """A first gradient; monomials `[B, K, 6, M]` of the dots around; of the blobs beside, in pitches, what their square
        distance needs `[B, K, 4, 12]`, and places and validity `[B, K, 3, 12]`; how near all blobs (columns) have the others
        `[B, K, K]`.
        """
        middle = self.pixels.mean(0)
        own = square_distance(blobs - middle, self.pixels - middle).argmin(-1)
        around, pitch = self.around[own], self.pitch[own]
        apart = square_distance(blobs - middle, blobs - middle)
        index = (apart + FAR * (1 - valid[:, None])).topk(min(13, blobs.shape[1]), largest=False).indices[..., 1:]
        known = torch.cat([blobs.mT, valid[:, None]], 1).gather(2, index.flatten(1)[:, None].expand(-1, 3, -1))
        place, there = known.unflatten(2, index.shape[1:]).split([2, 1], 1)
        others = (place - blobs.mT[..., None]) / pitch[:, None, :, None]  # [B, 2, K, 12]
        square = others.square().sum(1, keepdim=True)
        away = torch.cat([-2 * others, torch.ones_like(square), square], 1)
        beside = torch.cat([others * there, there], 1)
        nearby = torch.exp((apart / (-2 * (0.8 * pitch[:, None]) ** 2)).clamp_min(-FADED)) * valid[..., None]
        eye = torch.eye(2, dtype=blobs.dtype, device=blobs.device)[..., None]
        ratio = square[:, 0, :, :4].clamp_min(1e-12).sqrt().mean(-1).clamp(0.4, 2.0)
        return ratio[:, None, None] * eye, around, away.transpose(1, 2), beside.transpose(1, 2), nearby

    def refine(self, gradient, around, away, beside, nearby, valid, width):
        """The gradient after another fit, with blobs believed up to about `width` pitches off."""
        a, b, c, d = gradient.flatten(1, 2).unbind(1)
        entries = torch.stack([a, b, c, d, a * a + c * c, a * b + c * d, b * b + d * d, torch.ones_like(a)], -1)
        mapped = (entries * (-0.5 / width**2) @ self.mapping).unflatten(-1, (4, 6)) @ around
        target = beside @ torch.exp((away.mT @ mapped).clamp_min(-FADED))
        target = target / (target[:, :, 2:] + 0.1)  # weight times place, weight: [B, K, 3, M]
        sums = (target @ around.mT).flatten(-2).mT.unflatten(1, (3, 6))
        load = sums[:, :2, :2] + 0.2 * gradient
        uu, uv, vv, weight = (sums[:, 2, 2:] + sums.new_tensor([0.2, 0, 0.2, 0])[:, None]).unbind(1)
        fitted = load * torch.stack([vv, uu], 1)[:, None] - load.flip(2) * uv[:, None, None]
        quality = valid * (weight / around.shape[-1]).square()
        scaled = fitted.flatten(1, 2) * (quality / (uu * vv - uv * uv))[:, None]
        average = torch.cat([scaled, quality[:, None]], 1) @ nearby + sums.new_tensor([1e-6, 0, 0, 1e-6, 1e-6])[:, None]
        return ((average[:, :4] / average[:, 4:]).unflatten(1, (2, 2)),)


class LocalFlow(nn.Module):
    """Moving averages of the flow around every dot, over its neighbours, itself left out.

    Weights `w_n exp(-|x_n - x_d|^2 / 2 h_d^2)`, `h_d` the local pitch times `width`. The last nodes, the anchors, have no
    flow and weight 1. Dots are the last axis throughout: weight `[B, D]`, flow `[B, 2, D]`, gradient `[B, 2, 2, D]`.
    """

    def __init__(self, pixels, nodes, width):
        super().__init__()
        count, h = len(pixels), width * spacing(pixels)[1]
        y = (nodes[:, None] - pixels) / h[None, :, None]  # [N, D, 2]
        self.kernel = np.exp(-0.5 * (y**2).sum(-1))
        self.kernel[np.arange(count), np.arange(count)] = 0
        u, v = y[..., 0], y[..., 1]
        moments = self.kernel * np.stack([np.ones_like(u), u, v, u * u, u * v, v * v])  # [6, N, D]
        moments_of_dots = np.moveaxis(moments[:, :count], 0, 1)
        self.register_buffer("moments", torch.as_tensor(moments_of_dots.reshape(count, -1).copy()))
        self.register_buffer("first_moments", torch.as_tensor(moments_of_dots[:, :3].reshape(count, -1).copy()))
        self.register_buffer("still", torch.as_tensor(moments[:, count:].sum(1)))
        self.register_buffer("raised", self.still + torch.tensor([1e-3, 0, 0, RIDGE, 0, RIDGE])[:, None])
        self.register_buffer("minors", torch.tensor(MINORS))
        self.register_buffer("h", torch.as_tensor(h))

    def rings(self, weight):
        """How many steps it takes the growth from the nodes `weight [S, N]` to reach every dot it can reach."""
        count, reached, steps = self.kernel.shape[1], weight, 0
        while True:
            grown = np.maximum(reached[:, :count], reached @ self.kernel * 0.7 > SUPPORT)
            if (grown == reached[:, :count]).all():
                return steps
            reached, steps = np.column_stack([grown, reached[:, count:]]), steps + 1

    def gradient(self, weight, flow, prior):
        """Gradient `[B, 2, 2, D]` of the least-squares affine flow, drawn to `prior` where neighbours do not fix it."""
        weight = weight[:, None]
        rows = torch.cat([weight, weight * flow], 1)
        sums = (rows @ self.moments).unflatten(-1, (6, -1))  # [B, 3, 6, D]
        load = torch.cat([sums[:, 1:, :1], sums[:, 1:, 1:3] + RIDGE * self.h * prior], 2)
        normal = sums[:, 0] + self.raised  # of the symmetric 3 x 3 matrix: 00 01 02 11 12 22
        entry = lambda which: normal.index_select(1, which)  # noqa: E731
        a, b, c, d = self.minors
        adjugate = (entry(a) * entry(b) - entry(c) * entry(d)).unflatten(1, (3, 3))
        determinant = (normal[:, :3] * adjugate[:, 0]).sum(1) * self.h
        return (load[:, :, None] * adjugate[:, None, 1:]).sum(3) / determinant[:, None, None]

    def along(self, weight, flow, gradient):
        """Flow `f_d = mean_n f_n + (J_n + J_d) / 2 (x_d - x_n)` where the gradient is known at the dots, and the support
        `[B, D]`; anchors take the gradient of the dot.
        """
        weight = weight[:, None]
        rows = torch.cat([weight, weight * torch.cat([flow, gradient.flatten(1, 2) / 2], 1)], 1)
        sums = (rows @ self.first_moments).unflatten(-1, (3, -1))  # [B, 7, 3, D]
        support = sums[:, 0, 0] + self.still[0]
        own = sums[:, 0, 1:] / 2 + self.still[1:3]
        theirs = sums[:, 3::2, 1] + sums[:, 4::2, 2]
        mine = (gradient * own[:, None]).sum(2)
        return (sums[:, 1:3, 0] - self.h * (theirs + mine)) / (support + 1e-3)[:, None], support


class Coherence(nn.Module):
    """Whether the matches around every dot hang together: 1, or towards 0 where the pattern is torn.

    A region matched one pitch off ends in a seam, where dots are lost, blobs of their size are left over, and the step
    from a dot to its neighbour is not what the deformation measured at both makes of it at rest. Lost dots or blobs left
    over alone, or a field that varies fast, are no seam. A blob left over as near to the prediction as the dot's own is
    its rival: then neither is believed.
    """

    def __init__(self, pixels, log_radius, size_tolerance):
        super().__init__()
        self.size_tolerance = size_tolerance
        near = cKDTree(pixels).query(pixels, k=min(NEIGHBOURS - 1, len(pixels)))[1][:, 1:].T.copy()
        step = np.moveaxis(pixels[near] - pixels, -1, 0).copy()
        nearest, mean = spacing(pixels)
        square = ((pixels[:, None] - pixels) ** 2).sum(-1)
        kernel = np.exp(-square / (2 * (SEAM * mean) ** 2))  # [from, to]
        self.register_buffer("near", torch.as_tensor(near))
        self.register_buffer("step", torch.as_tensor(step))
        self.register_buffer("length", torch.as_tensor(np.linalg.norm(step, axis=0)))
        self.register_buffer("share", torch.as_tensor(kernel / kernel.sum(0)))
        self.register_buffer("total", torch.as_tensor(kernel.sum(0)))
        self.register_buffer("reach", torch.as_tensor(SEAM * mean))
        self.register_buffer("origin", torch.as_tensor(pixels.mean(0)))
        self.register_buffer("nearest", torch.as_tensor(nearest))
        self.register_buffer("log_radius", torch.as_tensor(log_radius))

    def forward(self, pixels, confidence, gradient, predicted, blobs, log_radius, valid):
        """`pixels [B, D, 2]`, `confidence [B, D]`, `gradient [B, D, 2, 2]`, `predicted [B, D, 2]` px; blobs as for
        `DotMatcher` -> `[B, D]` in 0..1.
        """
        sure = torch.sigmoid(20 * (confidence - 0.5))
        blobs, pixels, predicted = (x - self.origin for x in (blobs, pixels, predicted))
        square = square_distance(blobs, pixels)  # [B, K, D]
        claimed = ((square < (CLAIM * self.nearest) ** 2) * sure[:, None]).amax(-1)
        misfit = (log_radius - self.log_radius[square.argmin(-1)]) / self.size_tolerance
        left = valid * torch.exp(-0.5 * misfit.square()) * (1 - claimed)
        own = (pixels - predicted).square().sum(-1).clamp_min(1e-12).sqrt()
        other = square_distance(blobs, predicted).clamp_min(1e-12).sqrt()
        margin = (other - own[:, None]) / self.nearest
        alone = 1 - (left[..., None] * torch.sigmoid(20 * (RIVAL - margin))).amax(1)
        left = (left[:, None] @ torch.exp(-square / (2 * self.reach**2))).squeeze(1) / self.total
        lost = (1 - sure) @ self.share
        here = torch.cat([gradient.flatten(2), pixels, sure[..., None]], -1)
        there = here.index_select(1, self.near.flatten()).mT.unflatten(-1, self.near.shape)  # [B, 7, neighbours, D]
        here = here.mT[:, :, None]
        ends = (there[:, :4] + here[:, :4]).unflatten(1, (2, 2)) / 2
        change = there[:, 4:6] - here[:, 4:6] - self.step - (ends * self.step).sum(2)
        pair = there[:, 6] * here[:, 6]
        error = (pair * change.square().sum(1).clamp_min(1e-12).sqrt() / self.length).sum(1) @ self.share
        error = error / (pair.sum(1) @ self.share + 1e-3)
        tear = torch.minimum(lost, left).clamp_min(1e-12).sqrt() * error
        return alone * torch.sigmoid(8 * (1 - tear / TEAR))


class DotMatcher(nn.Module):
    """Assigns blobs of a frame to the dots of the rest image.

    The flow is smooth and, where `anchors` are given, zero at them. Dots are followed from where they were, or else, where
    one cannot be, searched for from the anchors on: each of a fixed number of steps predicts every dot from the sure nodes
    around it and the local deformation, takes the blob nearest to the prediction and of its size, and keeps it where the
    choice is mutual. Without anchors each part of the pattern in turn is held to have moved least, and the start that
    matches most is kept.
    """

    def __init__(self, pixels, log_radius, size_tolerance, anchors=None):
        super().__init__()
        self.size_tolerance = size_tolerance
        nearest, mean = spacing(pixels)
        anchors = np.empty((0, 2)) if anchors is None else thin_out(np.asarray(anchors, float), 0.7 * np.median(mean))
        nodes = np.concatenate([pixels, anchors])
        self.deformation = LocalDeformation(pixels)
        self.local = LocalFlow(pixels, nodes, WIDTH)
        self.register_buffer("origin", torch.as_tensor(pixels.mean(0)))
        self.register_buffer("pixels", torch.as_tensor(pixels - pixels.mean(0)))
        self.register_buffer("nearest", torch.as_tensor(nearest))
        self.register_buffer("stiffness", torch.as_tensor((TOLERANCE * nearest) ** -2.0))
        self.register_buffer("log_radius", torch.as_tensor(log_radius))
        starts = np.zeros((1, len(pixels))) if len(anchors) else sectors(pixels)
        self.register_buffer("starts", torch.as_tensor(starts))
        self.steps = self.local.rings(np.column_stack([starts, np.ones((len(starts), len(anchors)))])) + 3

    def predict(self, weight, flow, strain):
        """Flow `[B, D, 2]`, gradient `[B, D, 2, 2]` and support `[B, D]` at the dots, from weight, flow and strain there."""
        flow, strain = flow.mT, strain.movedim(1, -1)
        gradient = self.local.gradient(weight, flow, strain)
        predicted, support = self.local.along(weight, flow, gradient)
        return predicted.mT, gradient.movedim(-1, 1), support

    def choose(self, predicted, support, blobs, base):
        """Each dot's blob: its certainty `[B, D]`, the flow to it `[B, 2, D]` (the prediction where lost), its strain
        `[B, 2, 2, D]`.

        `blobs [B, 7, K]`: 1, positions and strains; `base [B, D, K]`: what of the cost does not depend on the prediction.
        """
        expected = self.pixels.mT + predicted
        alone = (expected * expected).sum(1) * self.stiffness + FAR * (support < SUPPORT)
        cost = torch.cat([alone[:, None], -2 * self.stiffness * expected], 1).mT @ blobs[:, :3] + base
        best = cost.amin(-1)
        chosen = (cost <= best[..., None]).to(cost.dtype)
        taken = torch.cat([blobs, cost.amin(1, keepdim=True)], 1) @ chosen.mT
        found, strain, rival = (taken[:, 1:] / taken[:, :1]).split([2, 4, 1], 1)
        mutual = best <= rival[:, 0] + 1e-6 * best.abs()
        weight = torch.exp(-0.5 * best) * mutual * (support / (support + 0.5))
        flow = torch.where(weight[:, None] > 0.02, found - self.pixels.mT, predicted)
        return weight, flow, strain.unflatten(1, (2, 2))

    def forward(self, blobs, log_radius, valid, previous=None):
        """`blobs [B, K, 2]`, `log_radius`, `valid [B, K]` -> positions `[B, D, 2]`, certainty `[B, D]` in 0..1 and strain
        `[B, D, 2, 2]`.

        The dots are followed from where they were in the frames before, `previous [B, D, 2]`, NaN where lost; from rest
        without it, or where half of them were lost. In a frame in which one cannot be followed all are searched for.
        """
        *followed, kept = self.follow(blobs, log_radius, valid, previous)
        return self.end(*self.either(kept, *followed, *self.search(blobs, log_radius, valid)))

    def search(self, blobs, log_radius, valid):
        """Weight `[B, D]`, flow `[B, 2, D]` and strain `[B, 2, 2, D]` of the dots."""
        known, base = self.scene(self.deformation(blobs, valid), blobs, log_radius, valid)
        known, base, *state = self.begin(known, base)
        for _ in range(self.steps):
            state = self.grow(*state, known, base)
        for _ in range(SETTLING):
            state = self.settle(*state, known, base)
        return self.best(*state)

    def follow(self, blobs, log_radius, valid, previous=None):
        """As `search`, from the frames before; and in which frames `[B]` all dots that were found could be followed."""
        found, flow = torch.ones_like(self.nearest[None]) > 0, torch.zeros_like(self.pixels[None])
        if previous is not None:
            finite = previous.isfinite().all(-1)
            enough = finite.to(blobs.dtype).mean(-1, keepdim=True) > 0.5
            flow = torch.where((finite & enough)[..., None], previous - self.pixels - self.origin, flow)
            found = finite | ~enough
        weight, flow, eye = found.to(blobs.dtype), flow.mT, torch.eye(2, dtype=blobs.dtype, device=blobs.device)
        known, base = self.scene(eye[..., None].expand(*valid.shape[:1], 2, 2, valid.shape[1]), blobs, log_radius, valid)
        state = self.grow(weight, flow, torch.zeros_like(flow[:, None]).expand(-1, 2, -1, -1), known, base)
        for _ in range(FOLLOWING):
            state = self.settle(*state, known, base)
        weight, flow, strain = state
        followed = ~(found & ~(weight >= KEPT)).any(-1)
        return weight, flow, self.local.gradient(weight, flow, strain), followed

    def either(self, kept, weight, flow, strain, *searched):
        """The dots followed in the frames `kept [B]`, those searched in the others."""
        followed = (weight, flow, strain)
        return tuple(torch.where(kept.reshape(-1, *(1,) * (a.ndim - 1)), a, b) for a, b in zip(followed, searched, strict=True))

    def scene(self, deformation, blobs, log_radius, valid):
        """What `choose` needs to know of the blobs: `[B, 7, K]`, `[B, D, K]`."""
        strain = deformation - torch.eye(2, dtype=blobs.dtype, device=blobs.device)[..., None]
        place = (blobs - self.origin).mT
        known = torch.cat([torch.ones_like(place[:, :1]), place, strain.flatten(1, 2)], 1)
        misfit = ((self.log_radius[:, None] - (log_radius + 3 * (1 - valid))[:, None]) / self.size_tolerance).square()
        return known, misfit + self.stiffness[:, None] * place.square().sum(1, keepdim=True)

    def begin(self, known, base):
        """The scene of every start; weight, flow and strain of the dots before the first step."""
        starts = self.starts.shape[0]
        if starts > 1:
            known, base = (x[:, None].expand(-1, starts, -1, -1).flatten(0, 1) for x in (known, base))
        flow = torch.zeros_like(self.pixels.mT).expand(known.shape[0], -1, -1)
        weight, flow, strain = self.choose(flow, FAR + flow[:, 0], known, base)
        return known, base, (weight.unflatten(0, (-1, starts)) * self.starts).flatten(0, 1), flow, strain

    def grow(self, weight, flow, strain, known, base):
        """One step outwards along the strain measured."""
        return self.choose(*self.local.along(weight, flow, strain), known, base)

    def settle(self, weight, flow, strain, known, base):
        """One step along the strain measured and what the neighbours' flow says of it."""
        gradient = self.local.gradient(weight, flow, strain)
        return self.choose(*self.local.along(weight, flow, gradient), known, base)

    def best(self, weight, flow, strain):
        """The best start's."""
        starts = self.starts.shape[0]
        if starts > 1:
            weight, flow, strain = (x.unflatten(0, (-1, starts)) for x in (weight, flow, strain))
            best = weight.sum(-1).argmax(-1)[:, None]
            take = lambda x: torch.take_along_dim(x, best.reshape(-1, *(1,) * (x.ndim - 1)), 1).squeeze(1)  # noqa: E731
            weight, flow, strain = take(weight), take(flow), take(strain)
        return weight, flow, strain

    def end(self, weight, flow, strain):
        """Positions, certainty and strain."""
        return self.pixels + self.origin + flow.mT, weight, strain.movedim(-1, 1)
