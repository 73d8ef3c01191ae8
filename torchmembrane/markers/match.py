"""Matching: which blob of the frame is which dot, grown inwards from the rim along the smooth flow."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import nn

SETTLING = 6  # steps after the growth has reached every dot
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


def inverse_2x2(matrix):
    a, b, c, d = matrix.flatten(-2).unbind(-1)
    return torch.stack([d, -b, -c, a], -1).unflatten(-1, (2, 2)) / (a * d - b * c)[..., None, None]


class LocalDeformation(nn.Module):
    """The deformation gradient at every blob of a frame, from the arrangement of the blobs around it alone.

    The dots next to the rest dot at that place are mapped by `A`, laid on the nearest blobs, and `A` fitted, a fixed
    number of times, with an average over nearby blobs between. Nothing needs to be known of which blob is which dot.
    """

    def __init__(self, pixels):
        super().__init__()
        near = cKDTree(pixels).query(pixels, k=min(NEIGHBOURS + 1, len(pixels)))[1][:, 1:]
        self.register_buffer("pixels", torch.as_tensor(pixels))
        self.register_buffer("pitch", torch.as_tensor(spacing(pixels)[1]))
        self.register_buffer("around", torch.as_tensor(pixels[near] - pixels[:, None]))

    def forward(self, blobs, valid):
        """`blobs [B, K, 2]`, `valid [B, K]` in 0..1 -> gradient `[B, K, 2, 2]`."""
        nearest = (blobs[:, :, None] - self.pixels).square().sum(-1).argmin(-1)
        pitch = self.pitch[nearest]
        around = self.around[nearest] / pitch[..., None, None]  # [B, K, M, 2]
        apart = (blobs[:, :, None] - blobs[:, None]).square().sum(-1)
        index = (apart + FAR * (1 - valid[:, None])).topk(min(13, blobs.shape[1]), largest=False).indices[..., 1:]
        others = blobs.gather(1, index.flatten(1)[..., None].expand(-1, -1, 2)).unflatten(1, index.shape[1:])
        others = (others - blobs[:, :, None]) / pitch[..., None, None]  # [B, K, 12, 2]
        there = valid.gather(1, index.flatten(1)).unflatten(1, index.shape[1:])
        nearby = torch.exp(-apart / (2 * (0.8 * pitch[..., None]) ** 2)) * valid[:, None]
        eye = torch.eye(2, dtype=blobs.dtype, device=blobs.device)
        ratio = others[..., :4, :].square().sum(-1).clamp_min(1e-12).sqrt().mean(-1).clamp(0.4, 2.0)
        gradient = ratio[..., None, None] * eye
        for width in (0.35, 0.3, 0.25, 0.2, 0.2, 0.2):
            mapped = around @ gradient.mT
            square = (mapped[..., None, :] - others[..., None, :, :]).square().sum(-1)
            likely = torch.exp(-square / (2 * width**2)) * there[..., None, :]
            total = likely.sum(-1)
            target = (likely @ others) / (total[..., None] + 1e-9)
            weight = total / (total + 0.1)
            weighted = around.mT * weight[..., None, :]
            moment = weighted @ around
            fitted = ((weighted @ target).mT + 0.2 * gradient) @ inverse_2x2(moment + 0.2 * eye)
            quality = valid * weight.mean(-1) ** 2
            share = nearby * quality[:, None]
            share = share / (share.sum(-1, keepdim=True) + 1e-6)
            gradient = (share @ fitted.flatten(-2)).unflatten(-1, (2, 2))
            gradient = gradient + (1 - share.sum(-1))[..., None, None] * eye
        return gradient


class LocalFlow(nn.Module):
    """Moving averages of the flow around every dot, over its neighbours, itself left out.

    Weights `w_n exp(-|x_n - x_d|^2 / 2 h_d^2)`, `h_d` the local pitch times `width`.
    """

    def __init__(self, pixels, nodes, width):
        super().__init__()
        h = width * spacing(pixels)[1]
        y = (nodes[:, None] - pixels) / h[None, :, None]  # [N, D, 2]
        kernel = np.exp(-0.5 * (y**2).sum(-1))
        kernel[np.arange(len(pixels)), np.arange(len(pixels))] = 0
        u, v = y[..., 0], y[..., 1]
        moments = kernel * np.stack([np.ones_like(u), u, v, u * u, u * v, v * v])  # [6, N, D]
        self.register_buffer("moments", torch.as_tensor(np.moveaxis(moments, 0, 1).reshape(len(nodes), -1)))
        self.register_buffer("h", torch.as_tensor(h))

    def rings(self, weight):
        """How many steps it takes the growth from the nodes `weight [S, N]` to reach every dot it can reach."""
        kernel = self.moments[:, : self.h.numel()].numpy()
        reached, count = weight, 0
        while True:
            grown = np.maximum(reached[:, : kernel.shape[1]], reached @ kernel * 0.7 > SUPPORT)
            if (grown == reached[:, : kernel.shape[1]]).all():
                return count
            reached, count = np.column_stack([grown, reached[:, kernel.shape[1] :]]), count + 1

    def forward(self, weight, flow, gradient):
        """Least-squares affine flow `f(x) ~ f_d + J_d (x - x_d)`.

        `weight [B, N]`, `flow [B, N, 2]` at the nodes -> flow `[B, D, 2]`, gradient `[B, D, 2, 2]`, support `[B, D]`.
        """
        count = self.h.numel()
        s, su, sv, suu, suv, svv = (weight @ self.moments).unflatten(-1, (6, count)).unbind(-2)
        load = (weight[:, None] * flow.mT) @ self.moments[:, : 3 * count]
        load = load.unflatten(-1, (3, count)).movedim(1, -1)  # [B, 3, D, 2]
        prior = RIDGE * self.h[:, None, None] * gradient.mT
        load = torch.cat([load[:, :1], load[:, 1:] + prior.movedim(-2, 1)], 1)
        suu, svv, s1 = suu + RIDGE, svv + RIDGE, s + 1e-3
        # adjugate of the symmetric 3 x 3 normal matrix
        c00, c01, c02 = suu * svv - suv**2, suv * sv - su * svv, su * suv - suu * sv
        c11, c12, c22 = s1 * svv - sv**2, su * sv - s1 * suv, s1 * suu - su**2
        adjugate = torch.stack([c00, c01, c02, c01, c11, c12, c02, c12, c22], -1).unflatten(-1, (3, 3))
        determinant = s1 * c00 + su * c01 + sv * c02
        fit = (adjugate @ load.movedim(-3, -2)) / determinant[..., None, None]
        return fit[..., 0, :], fit[..., 1:, :].mT / self.h[:, None, None], s

    def along(self, weight, flow, gradient):
        """The same where the gradient is known at the dots: `f_d = mean_n f_n + (J_n + J_d) / 2 (x_d - x_n)`.

        `gradient [B, D, 2, 2]`; anchors, the last nodes, take that of the dot.
        """
        count = self.h.numel()
        kernel, ku, kv = self.moments[:, : 3 * count].unflatten(-1, (3, count)).unbind(-2)
        dots, anchors = weight[:, :count], weight[:, count:]
        support = weight @ kernel
        sum_flow = (weight[:, None] * flow.mT) @ kernel  # [B, 2, D]
        own = torch.stack([dots @ k[:count] / 2 + anchors @ k[count:] for k in (ku, kv)], -1)  # [B, D, 2]
        theirs = (dots[..., None, None] * gradient / 2).movedim(1, -1)  # [B, 2, 2, D]
        theirs = theirs[:, :, 0] @ ku[:count] + theirs[:, :, 1] @ kv[:count]  # [B, 2, D]
        mine = (gradient @ own[..., None]).squeeze(-1)
        total = sum_flow.mT - (theirs.mT + mine) * self.h[:, None]
        return total / (support[..., None] + 1e-3), support


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
        near = cKDTree(pixels).query(pixels, k=min(NEIGHBOURS - 1, len(pixels)))[1][:, 1:]
        step = pixels[near] - pixels[:, None]
        nearest, mean = spacing(pixels)
        square = ((pixels[:, None] - pixels) ** 2).sum(-1)
        kernel = np.exp(-square / (2 * (SEAM * mean) ** 2))  # [from, to]
        self.register_buffer("near", torch.as_tensor(near))
        self.register_buffer("step", torch.as_tensor(step))
        self.register_buffer("length", torch.as_tensor(np.linalg.norm(step, axis=-1)))
        self.register_buffer("share", torch.as_tensor(kernel / kernel.sum(0)))
        self.register_buffer("total", torch.as_tensor(kernel.sum(0)))
        self.register_buffer("reach", torch.as_tensor(SEAM * mean))
        self.register_buffer("nearest", torch.as_tensor(nearest))
        self.register_buffer("log_radius", torch.as_tensor(log_radius))

    def forward(self, pixels, confidence, gradient, predicted, blobs, log_radius, valid):
        """`pixels [B, D, 2]`, `confidence [B, D]`, `gradient [B, D, 2, 2]`, `predicted [B, D, 2]` px; blobs as for
        `DotMatcher` -> `[B, D]` in 0..1.
        """
        sure = torch.sigmoid(20 * (confidence - 0.5))
        square = (blobs[:, :, None] - pixels[:, None]).square().sum(-1)  # [B, K, D]
        claimed = ((square < (CLAIM * self.nearest) ** 2) * sure[:, None]).amax(-1)
        misfit = (log_radius - self.log_radius[square.argmin(-1)]) / self.size_tolerance
        left = valid * torch.exp(-0.5 * misfit.square()) * (1 - claimed)
        own = (pixels - predicted).square().sum(-1).clamp_min(1e-12).sqrt()
        other = (blobs[:, :, None] - predicted[:, None]).square().sum(-1).clamp_min(1e-12).sqrt()
        margin = (other - own[:, None]) / self.nearest
        alone = 1 - (left[..., None] * torch.sigmoid(20 * (RIVAL - margin))).amax(1)
        left = (left[:, None] @ torch.exp(-square / (2 * self.reach**2))).squeeze(1) / self.total
        lost = (1 - sure) @ self.share
        ends = (gradient[:, self.near] + gradient[:, :, None]) / 2
        change = pixels[:, self.near] - pixels[:, :, None] - self.step - (ends @ self.step[..., None]).squeeze(-1)
        pair = sure[:, self.near] * sure[:, :, None]
        error = (pair * change.square().sum(-1).clamp_min(1e-12).sqrt() / self.length).sum(-1) @ self.share
        error = error / (pair.sum(-1) @ self.share + 1e-3)
        tear = torch.minimum(lost, left).clamp_min(1e-12).sqrt() * error
        return alone * torch.sigmoid(8 * (1 - tear / TEAR))


class DotMatcher(nn.Module):
    """Assigns blobs of a frame to the dots of the rest image.

    The flow is smooth and, where `anchors` are given, zero at them. Starting there, each of a fixed number of steps
    predicts every dot from the sure nodes around it and the local deformation, takes the blob nearest to the prediction
    and of its size, and keeps it where the choice is mutual. Without anchors each part of the pattern in turn is held
    to have moved least, and the start that matches most is kept.
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
        self.register_buffer("log_radius", torch.as_tensor(log_radius))
        starts = np.zeros((1, len(pixels))) if len(anchors) else sectors(pixels)
        self.register_buffer("starts", torch.as_tensor(starts))
        self.steps = self.local.rings(np.column_stack([starts, np.ones((len(starts), len(anchors)))])) + 3
        self.register_buffer("still", torch.zeros(len(anchors), 2, dtype=torch.float64))

    def with_anchors(self, weight, flow):
        still = self.still.expand(flow.shape[0], -1, -1)
        return torch.cat([weight, torch.ones_like(still[..., 0])], 1), torch.cat([flow, still], 1)

    def predict(self, weight, flow, strain):
        """Flow, gradient and support at the dots, from the dots `weight [B, D]`, `flow [B, D, 2]` and the anchors."""
        weight, flow = self.with_anchors(weight, flow)
        _, gradient, _ = self.local(weight, flow, strain)
        predicted, support = self.local.along(weight, flow, gradient)
        return predicted, gradient, support

    def choose(self, predicted, support, blobs, misfit):
        """Each dot's blob: its certainty `[B, D]`, the flow to it `[B, D, 2]` (the prediction where lost), its index.

        `misfit [B, D, K]`: squared size differences, in standard deviations.
        """
        expected = self.pixels + predicted
        square = expected.square().sum(-1)[..., None] + blobs.square().sum(-1)[:, None] - 2 * expected @ blobs.mT
        cost = square / (TOLERANCE * self.nearest[:, None]) ** 2 + misfit
        cost = cost + FAR * (support[..., None] < SUPPORT)
        best, chosen = cost.min(-1)
        mutual = best <= cost.amin(1).gather(1, chosen) * (1 + 1e-6)
        weight = torch.exp(-0.5 * best) * mutual * (support / (support + 0.5))
        flow = blobs.gather(1, chosen[..., None].expand(-1, -1, 2)) - self.pixels
        return weight, torch.where(weight[..., None] > 0.02, flow, predicted), chosen

    def forward(self, blobs, log_radius, valid):
        """`blobs [B, K, 2]`, `log_radius`, `valid [B, K]` -> positions `[B, D, 2]` and certainty `[B, D]` in 0..1."""
        deformation = self.deformation(blobs, valid)
        strain = (deformation - torch.eye(2, dtype=blobs.dtype, device=blobs.device)).flatten(-2)
        blobs = blobs - self.origin
        misfit = ((self.log_radius[:, None] - (log_radius + 3 * (1 - valid))[:, None]) / self.size_tolerance).square()
        starts = self.starts.shape[0]
        blobs, misfit, strain = (x[:, None].expand(-1, starts, -1, -1).flatten(0, 1) for x in (blobs, misfit, strain))
        flow = torch.zeros_like(self.pixels).expand(blobs.shape[0], -1, -1)
        weight, flow, chosen = self.choose(flow, FAR + flow[..., 0], blobs, misfit)
        weight = (weight.unflatten(0, (-1, starts)) * self.starts).flatten(0, 1)
        for _ in range(self.steps):
            gradient = strain.gather(1, chosen[..., None].expand(-1, -1, 4)).unflatten(-1, (2, 2))
            predicted, support = self.local.along(*self.with_anchors(weight, flow), gradient)
            weight, flow, chosen = self.choose(predicted, support, blobs, misfit)
        for _ in range(SETTLING):
            gradient = strain.gather(1, chosen[..., None].expand(-1, -1, 4)).unflatten(-1, (2, 2))
            predicted, _, support = self.predict(weight, flow, gradient)
            weight, flow, chosen = self.choose(predicted, support, blobs, misfit)
        weight, flow = weight.unflatten(0, (-1, starts)), flow.unflatten(0, (-1, starts))
        best = weight.sum(-1).argmax(-1)[:, None, None].expand(-1, -1, self.pixels.shape[0])
        flow = flow.gather(1, best[..., None].expand(-1, -1, -1, 2)).squeeze(1)
        gradient = gradient.unflatten(0, (-1, starts)).gather(1, best[..., None, None].expand(-1, -1, -1, 2, 2)).squeeze(1)
        return self.pixels + self.origin + flow, weight.gather(1, best).squeeze(1), gradient
