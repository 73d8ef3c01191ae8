"""One dimension (Appendix A): a flat membrane against a convex obstacle, and a semicircle from its image.

Flat membrane (eqs. 30-31): the free parts are parabolas of one curvature `p / T`, tangent to the obstacle where they meet it.
Semicircle (eqs. 32-37): a material point with the angle theta at rest is observed from the centre at `psi = g(theta)`; its
radius u is unknown. In terms of theta

    E = 1/2 int 1/r [(u g')^2 + (du/dtheta)^2] dtheta,    area 1/2 int u^2 g' dtheta constant,    u(0) = u(pi) = r

(eqs. 35-36 print `dphi/dtheta` for `g'` and total `r^(-3/2)`; eq. 37 prints u = 0 at the ends).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.integrate import quad
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from torch import Tensor

from ....errors import MembraneError
from .strip import Strip, area, around, outward

NEWTON_STEPS = 12
STEPS = 40  # of the reweighted Gauss-Newton method
GNC_SHARE, EPS = (
    0.7,
    (5.0, 0.1),
)  # graduated non-convexity: share of the steps in which eps decreases, and its first and last value over the rest pressure
TENSILE = 100.0  # penalty of tensile normal traction
LONGEST_STEP = 0.02  # relative to the strip's length


class Obstacle(NamedTuple):
    """A convex body above a line, with its lowest point at height 0.

    Attributes:
        height: function of x that gives the height of the lower boundary.
        slope: function of x that gives the slope of this boundary.
        left: smallest x of the body.
        right: largest x of the body.
    """

    height: Callable[[float], float]
    slope: Callable[[float], float]
    left: float
    right: float

    @classmethod
    def disc(cls, centre: float, radius: float) -> "Obstacle":
        """Return a disc with its centre at x = `centre`."""
        return cls(
            lambda x: radius - np.sqrt(radius**2 - (x - centre) ** 2),
            lambda x: (x - centre) / np.sqrt(radius**2 - (x - centre) ** 2),
            centre - radius,
            centre + radius,
        )


class FlatContact(NamedTuple):
    """A pressed flat membrane.

    Attributes:
        contact: ends of the contact, `(c1, c2)`.
        curvature: curvature of the free parts, p / T.
        height: function of x that gives the height of the membrane.
    """

    contact: tuple[float, float]
    curvature: float
    height: Callable[[np.ndarray], np.ndarray]


def flat_contact(obstacle: Obstacle, span: float, depth: float) -> FlatContact:
    """Return the flat membrane pressed by an obstacle at constant area below it (eqs. 30-31).

    For a given curvature of the free parts, each end of the contact is the point where the parabola from the rim meets the
    obstacle tangentially. It is unique, because the tangents of a convex body intersect the vertical line at the rim in order.
    The area determines the curvature.

    Args:
        obstacle: the obstacle that presses the membrane.
        span: length of the membrane, which lies over `[0, span]`.
        depth: depth of the obstacle's lowest point below the flat membrane.

    Raises:
        MembraneError: the depth is not positive, or the lowest point is not over the membrane.

    Example:
        >>> state = flat_contact(Obstacle.disc(50.0, 20.0), 100.0, 4.0)
        >>> abs(round(sum(state.contact) / 2, 6)), round(float(state.height(np.array([50.0]))[0]), 6)
        (50.0, -4.0)
    """
    lowest = brentq(obstacle.slope, obstacle.left + 1e-9 * span, obstacle.right - 1e-9 * span)
    if not (depth > 0 and 0 < lowest < span):
        raise MembraneError(
            f"flat_contact: depth {depth}, lowest point at {lowest:.4g}; expected depth > 0, a point in (0, {span})"
        )

    def ends(curvature: float) -> tuple[float, float]:
        left, right = max(obstacle.left, 0.0), min(obstacle.right, span)

        def meets(x: float, d: float) -> float:
            return obstacle.height(x) - depth + d * obstacle.slope(x) - curvature * d**2 / 2

        inset = 1e-12 * span
        return (
            brentq(lambda x: meets(x, -x), left + inset, lowest, xtol=1e-14),
            brentq(lambda x: meets(x, span - x), lowest, right - inset, xtol=1e-14),
        )

    def free_area(width: float, level: float, curvature: float) -> float:
        return width * level / 2 + curvature * width**3 / 12

    def enclosed(curvature: float) -> float:
        c1, c2 = ends(curvature)
        level = [obstacle.height(c) - depth for c in (c1, c2)]
        body = quad(obstacle.height, c1, c2)[0] - depth * (c2 - c1)
        return free_area(c1, level[0], curvature) + body + free_area(span - c2, level[1], curvature)

    high = depth / span**2
    while enclosed(high) < 0:
        high *= 2
    curvature = brentq(enclosed, 0.0, high, xtol=1e-16)
    c1, c2 = ends(curvature)

    def free(distance: np.ndarray, width: float, level: float) -> np.ndarray:
        return distance * (level / width + curvature / 2 * (width - distance))

    def height(x: np.ndarray) -> np.ndarray:
        body = np.array([obstacle.height(np.clip(v, c1, c2)) for v in x]) - depth
        left, right = free(x, c1, obstacle.height(c1) - depth), free(span - x, span - c2, obstacle.height(c2) - depth)
        return np.where(x < c1, left, np.where(x > c2, right, body))

    return FlatContact((c1, c2), curvature, height)


class StripProfile(NamedTuple):
    """A reconstructed strip that is a semicircle at rest.

    Attributes:
        nodes: positions of the nodes, `[N, 2]`.
        pressure: pressure of the fluid, force / length^2.
        traction: contact force on the strip per length, `[N, 2]`; zero for minimum energy.
        angle: polar angles of the nodes at rest, radians, `[N]`.
        radius: radius of the semicircle.
    """

    nodes: Tensor
    pressure: float
    traction: Tensor
    angle: Tensor
    radius: float

    def at(self, angle: np.ndarray) -> np.ndarray:
        """Return the positions `[M, 2]` of the material points with `angle [M]`, radians, at rest, by linear interpolation."""
        displacement = self.nodes - around(self.radius, self.angle)
        moved = torch.from_numpy(_hat_weights(self.angle.numpy(), angle)) @ displacement
        return (around(self.radius, torch.from_numpy(angle)) + moved).numpy()


class _Semicircle:
    """Rest state of a semicircle: nodes at equal angles around the origin, area, length and pressure."""

    def __init__(self, radius: float, strip: Strip, nodes: int) -> None:
        self.radius, self.strip = radius, strip
        self.angle = torch.linspace(0, torch.pi, nodes, dtype=torch.float64)
        self.rest = around(radius, self.angle)
        self.rest_area = area(self.rest)
        self.length = radius * torch.pi
        self.share = self.length / (nodes - 1)
        force, v = torch.func.grad(self.energy)(self.rest), torch.func.grad(area)(self.rest)
        self.rest_pressure = float((force * v)[1:-1].sum() / v[1:-1].square().sum())

    def energy(self, x: Tensor) -> Tensor:
        """Return the elastic energy `[]` of nodes at `x [N, 2]`."""
        return self.strip.energy(x, self.rest)


class MinimumEnergyProfile(_Semicircle):
    """Finds the strip with the least energy on the observed rays at constant area (eqs. 35-37), by Newton's method for `u`.

    Call it with the angles of the markers; it returns a `StripProfile`. Between markers `g` is a cubic spline.

    Args:
        radius: radius of the semicircle.
        strip: material of the strip.
        nodes: number of nodes.

    Example:
        >>> theta = np.linspace(0.3, 2.8, 7)
        >>> found = MinimumEnergyProfile(15.0, Strip(), 9)(theta, theta)
        >>> bool((found.nodes - found.nodes.flip(0) * torch.tensor([-1.0, 1.0])).abs().max() < 1e-9)
        True
    """

    def __call__(self, theta: np.ndarray, psi: np.ndarray) -> StripProfile:
        """Return the strip whose markers with rest angles `theta [M]` are observed at angles `psi [M]`, radians."""
        ends = np.array([0.0, np.pi])
        order = np.argsort(np.append(ends, theta))
        g = CubicSpline(np.append(ends, theta)[order], np.append(ends, psi)[order])
        observed = torch.from_numpy(g(self.angle.numpy()))
        u, pressure = torch.full_like(observed, self.radius), self.rest_pressure
        free = slice(1, -1)

        def energy(u: Tensor) -> Tensor:
            return self.energy(around(u, observed))

        def enclosed(u: Tensor) -> Tensor:
            return area(around(u, observed))

        for _ in range(NEWTON_STEPS):
            v = torch.func.grad(enclosed)(u)[free]
            load = torch.func.grad(energy)(u)[free]
            K = (torch.func.hessian(energy)(u) - pressure * torch.func.hessian(enclosed)(u))[free, free]
            kkt = torch.cat([torch.cat([K, -v[:, None]], 1), torch.cat([v, v.new_zeros(1)])[None]])
            step = torch.linalg.solve(kkt, torch.cat([pressure * v - load, (self.rest_area - enclosed(u))[None]]))
            u[free] += step[:-1]
            pressure = pressure + float(step[-1])
        return StripProfile(around(u, observed), pressure, torch.zeros_like(self.rest), self.angle, self.radius)


class StripObservation(NamedTuple):
    """M markers on the strip and the rays on which they are observed.

    Attributes:
        bulge: vectors from the chord between nodes to the markers at rest, `[M, 2]`.
        weights: interpolation weights of the nodes, `[M, N]`.
        across: unit vectors orthogonal to the rays, `[M, 2]`.
    """

    bulge: Tensor
    weights: Tensor
    across: Tensor


class ForceBalanceProfile(_Semicircle):
    """Finds sparse inward contact forces like `ForceBalance`, in the plane: every node has two equations and lies on a ray.

    The solver starts from the rest shape.

    Args:
        radius: radius of the semicircle.
        strip: material of the strip.
        nodes: number of nodes.
        noise: standard deviation of a marker's angle, radians.
        sparsity: b of `beta = b / (p0 x length)`.
        friction: kappa, penalty of tangential traction relative to normal traction.

    Limitations:
        Contacts closer than about a tenth of the length are not resolved. A harmonic strip under two points is ambiguous: they
        may be invisible from the centre, unless the penalty of tangential forces is very large.
    """

    def __init__(
        self, radius: float, strip: Strip, nodes: int, noise: float, sparsity: float = 100.0, friction: float = 30.0
    ) -> None:
        super().__init__(radius, strip, nodes)
        self.noise, self.friction = noise, friction
        self.beta = sparsity / (self.rest_pressure * self.length)
        self.enclosed_hessian = torch.func.hessian(area)(self.rest).reshape(2 * nodes, 2 * nodes)

    def __call__(self, theta: np.ndarray, psi: np.ndarray) -> StripProfile:
        """Return the strip whose markers with rest angles `theta [M]` are observed at angles `psi [M]`, radians."""
        weights = torch.from_numpy(_hat_weights(self.angle.numpy(), theta))
        bulge = around(self.radius, torch.from_numpy(theta)) - weights @ self.rest
        across = torch.from_numpy(np.stack([-np.sin(psi), np.cos(psi)], -1))
        observation = StripObservation(bulge, weights, across)
        x, pressure = self.rest, torch.tensor(self.rest_pressure, dtype=torch.float64)
        first, last = (eps * self.rest_pressure for eps in EPS)
        for k in range(STEPS):
            eps = first * (last / first) ** min(1, k / (GNC_SHARE * (STEPS - 1)))
            x, pressure = self._step(x, pressure, observation, eps)
        return StripProfile(x, float(pressure), self._force(x, pressure) / self.share, self.angle, self.radius)

    def _force(self, x: Tensor, pressure: Tensor) -> Tensor:
        """Return the residual forces of the nodes, `[N, 2]`, which are the contact forces; zero at the ends."""
        force: Tensor = torch.func.grad(self.energy)(x) - pressure * torch.func.grad(area)(x)
        force[[0, -1]] = 0
        return force

    def _traction(self, x: Tensor, pressure: Tensor) -> tuple[Tensor, Tensor]:
        """Return the normal traction (positive: tensile) and the tangential traction, `[N]` each."""
        q, n = self._force(x, pressure) / self.share, outward(x)
        return (q * n).sum(-1), q[:, 0] * n[:, 1] - q[:, 1] * n[:, 0]

    def _angles(self, x: Tensor, observation: StripObservation) -> tuple[Tensor, Tensor]:
        """Return the angles `[M]` between rays and modelled markers, and their derivatives `[M, 2 N]`."""
        bulge, weights, across = observation
        marker = bulge + weights @ x
        distance = marker.norm(dim=-1, keepdim=True)
        along = marker / distance
        angle = (across * along).sum(-1)
        slope = (across - angle[:, None] * along) / distance
        return angle, (weights[:, :, None] * slope[:, None]).flatten(1)

    def _step(self, x: Tensor, pressure: Tensor, observation: StripObservation, eps: float) -> tuple[Tensor, Tensor]:
        """Take one reweighted Gauss-Newton step with linearised area, limiting the longest step of a node."""
        N = len(x)
        free = slice(2, 2 * N - 2)
        H = torch.func.hessian(self.energy)(x).reshape(2 * N, 2 * N) - pressure * self.enclosed_hessian
        v = torch.func.grad(area)(x)
        A = torch.cat([H[:, free], -v.reshape(-1, 1)], 1)[free]
        n, (q_n, q_t) = outward(x), self._traction(x, pressure)
        t = torch.stack([n[:, 1], -n[:, 0]], -1)
        w_n = torch.where(q_n < 0, (q_n**2 + eps**2).rsqrt(), TENSILE / eps)
        w_t = self.friction * (q_t**2 + eps**2).rsqrt()
        W = (w_n[:, None, None] * n[:, :, None] * n[:, None] + w_t[:, None, None] * t[:, :, None] * t[:, None])[1:-1]
        W = torch.block_diag(*(self.beta / self.share * W))
        angle, J = self._angles(x, observation)
        J = torch.cat([J[:, free], J.new_zeros(len(J), 1)], 1) / self.noise
        M = A.T @ W @ A + J.T @ J
        load = A.T @ (W @ self._force(x, pressure)[1:-1].flatten()) + J.T @ (angle / self.noise)
        keep = torch.cat([v[1:-1].flatten(), v.new_zeros(1)])
        kkt = torch.cat([torch.cat([M, keep[:, None]], 1), torch.cat([keep, keep.new_zeros(1)])[None]])
        step = torch.linalg.solve(kkt, torch.cat([-load, (self.rest_area - area(x))[None]]))
        move = step[:-2].reshape(-1, 2)
        share = (LONGEST_STEP * self.length / move.norm(dim=-1).max()).clamp(max=1.0)
        moved = x.clone()
        moved[1:-1] += share * move
        return moved, pressure + share * step[-2]


def _hat_weights(nodes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the weights `[M, N]` of linear interpolation from `nodes [N]` to `points [M]`."""
    return np.stack([np.interp(points, nodes, row) for row in np.eye(len(nodes))], -1)
