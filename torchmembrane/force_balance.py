"""Force balance: the surface and the pressure whose residual forces, the contact forces, are sparse and push inwards.

Every vertex carries three equations of equilibrium and one unknown depth. With the contact traction

    q_k = (grad_k U(x) - h_k - p grad_k V(x)) / a_k,    q_n = q . n,  q_t the rest,

    min over x, p:  1/2 sum_d |r_d(x)|^2 / sigma^2 + beta sum_k a_k [rho(q_n) + kappa rho(|q_t|)]   at the cavity's volume,

where `r_d` is the angle between a marker's ray and its modelled position, `rho(s) = sqrt(s^2 + eps^2)`, and for a pull
(`q_n > 0`) `eps + 50 q_n^2 / eps`. Iteratively reweighted Gauss-Newton steps while eps falls; of several starts the one with
the lowest objective wins.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from .cavity import CavityLaw, Equilibrium, rest_balance
from .energy import Sheet
from .membrane import Membrane, SurfacePoints, corners, triangles_of
from .solve.patches import PatchIndex, PatchSystem

STEPS = 28
FALL = 0.7  # share of the steps over which eps falls
EPS = (5.0, 0.1)  # first and last eps, over the reference traction
PULL = 100.0  # weight of a pull, over beta / eps
LONGEST_STEP = 0.026  # over the surface's size
DENTS = ((0.075, 0.11), (0.094, 0.225))  # depth and width of the later starts' dents, over the surface's size
WIN = 0.98  # a later start wins below this share of the best objective
NEIGHBOURS = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1))


LARGEST_UNBALANCE, LARGEST_VOLUME_ERROR = 5e-3, 1e-4  # last step over the size, and volume error, of a settled surface


class Balance(NamedTuple):
    """A start's outcome: `vertices [B, V, 3]`, pressure `[B]`, `traction [B, V, 3]` on the membrane, objective `[B]`, its data
    part `[B]`, and the longest vertex move of the last step over the surface's size `[B]`."""

    vertices: Tensor
    pressure: Tensor
    traction: Tensor
    objective: Tensor
    misfit: Tensor
    last_step: Tensor


class Observation(NamedTuple):
    """Measured marker rays: `origins [B, D, 3]`, a basis across each ray `[B, D, 2, 3]`, weights over the variance `[B, D]`."""

    origins: Tensor
    across: Tensor
    weight: Tensor


class ForceBalance(nn.Module):
    """Surface, contact tractions and pressure from marker rays.

    Arguments
        membrane, sheet    the rest surface on the solver's grid, its material
        markers            the markers' `SurfacePoints`, and `positions [D, 3]`, their rest positions
        noise              angular noise of a marker, radians; about twice the locator's, to leave room for the grid's own error
        filling, gas       the cavity, as for `MinimumEnergy`
        sparsity           b of `beta = b / (reference x area)`; the reference traction is the rest pressure, or tension / size
        friction           kappa, the price of tangential traction
        steps              of each start

    Wrong when: the press is shallow (its tractions drown in noise), contacts are close, a far camera is pressed along its axis.
    Sparsity shrinks the tractions, noise adds to them.
    """

    def __init__(self, membrane: Membrane, sheet: Sheet, markers: SurfacePoints, positions: Tensor, noise: float,
                 filling="liquid", gas: tuple[float, float] | None = None, sparsity=400.0, friction=10.0,
                 steps=STEPS):  # fmt: skip
        super().__init__()
        self.membrane, self.sheet, self.steps, self.friction = membrane, sheet, steps, friction
        self.largest_unbalance, self.largest_volume_error = LARGEST_UNBALANCE, LARGEST_VOLUME_ERROR
        rest_pressure, rest_load = rest_balance(membrane, sheet)
        self.cavity = CavityLaw(membrane, rest_pressure, filling, gas)
        self.size = float(membrane.rest_area.sum()) ** 0.5
        self.reference = max(float(rest_pressure), float(sheet.tension) / self.size, float(sheet.c1 + sheet.c2) / self.size)
        self.noise, self.beta = noise, sparsity / (self.reference * self.size**2)
        self.register_buffer("rest_pressure", rest_pressure)
        self.register_buffer("rest_load", rest_load)
        self.register_buffer("moves", (~membrane.fixed).double()[:, None])
        self.register_buffer("positions", torch.as_tensor(positions, dtype=torch.float64))
        self.register_buffer("marker_vertices", torch.as_tensor(markers.vertices).long())
        self.register_buffer("marker_weights", torch.as_tensor(markers.weights, dtype=torch.float64))
        stencil, scatter, inside = _stencil(membrane)
        self.register_buffer("scatter", scatter)
        self.register_buffer("inside", inside)
        self.system = PatchSystem(membrane.grid, membrane.fixed)
        self.vertex_patches = PatchIndex(self.system, stencil)
        self.marker_patches = PatchIndex(self.system, self.marker_vertices)

    def forward(self, origins: Tensor, directions: Tensor, weight: Tensor) -> Equilibrium:
        """`origins`, `directions [B, D, 3]`: the markers' measured rays; `weight [B, D]`: 0 for a lost one, else up to 1."""
        seen = Observation(origins, _across(directions), weight / self.noise**2)
        X, rest = self.membrane.rest.expand(len(weight), -1, -1), self.rest_pressure.expand(len(weight))
        best = self._descend(X, rest, seen)
        push = (-best.traction * self.membrane.normals(best.vertices)).sum(-1).clamp_min(0) * self.membrane.rest_area
        centre = (push[..., None] * X).sum(1) / push.sum(1, keepdim=True).clamp_min(torch.finfo(push.dtype).tiny)
        distance2 = ((X - centre[:, None]) ** 2).sum(-1, keepdim=True)
        for depth, width in DENTS:
            dent = depth * self.size * torch.exp(-distance2 / (2 * (width * self.size) ** 2)) * self.moves
            other = self._descend(X - dent * self.membrane.rest_normals, rest, seen)
            wins = other.objective < WIN * best.objective
            choose = lambda a, b, wins=wins: torch.where(wins.reshape(-1, *(1,) * (a.ndim - 1)), a, b)  # noqa: E731
            best = Balance(*(choose(a, b) for a, b in zip(other, best, strict=True)))
        volume = self.membrane.volume(best.vertices)
        return Equilibrium(best.vertices, best.pressure, volume, best.traction, best.last_step)

    def _descend(self, x: Tensor, pressure: Tensor, seen: Observation) -> Balance:
        first, last = (eps * self.reference for eps in EPS)
        for k in range(self.steps):
            eps = first * (last / first) ** min(1.0, k / (FALL * (self.steps - 1)))
            before = x
            x, pressure = self.step(x, pressure, seen, eps)
        moved = torch.linalg.vector_norm(x - before, dim=-1).amax(-1) / self.size
        return self.balance(x, pressure, seen)._replace(last_step=moved)

    def contact_force(self, x: Tensor, pressure: Tensor) -> Tensor:
        """Force that something outside must exert on every free vertex, `[B, V, 3]`."""
        push = pressure[:, None, None] * self.membrane.volume_gradient(x)
        return (self.sheet.gradient(x) - self.rest_load - push) * self.moves

    def balance(self, x: Tensor, pressure: Tensor, seen: Observation) -> Balance:
        """The objective, at the last eps, and its parts."""
        eps, area = EPS[1] * self.reference, self.membrane.rest_area
        traction = self.contact_force(x, pressure) / area[:, None]
        q_n, q_t = _split(traction, self.membrane.normals(x))
        pressed, pulled = (q_n**2 + eps**2).sqrt() - eps, PULL / 2 * q_n**2 / eps
        sideways = (q_t.square().sum(-1) + eps**2).sqrt() - eps
        contact = self.beta * (area * (torch.where(q_n < 0, pressed, pulled) + self.friction * sideways)).sum(-1)
        angle, _ = self._angles(x, seen)
        misfit = (seen.weight[..., None] * angle**2).sum((-1, -2)) / 2
        return Balance(x, pressure, traction, misfit + contact, misfit, torch.zeros_like(misfit))

    def markers(self, x: Tensor) -> Tensor:
        """The markers' positions on the surface `x`, `[B, D, 3]`."""
        moved = (x - self.membrane.rest)[:, self.marker_vertices.flatten()].unflatten(1, (-1, 3))
        return self.positions + (self.marker_weights[..., None] * moved).sum(-2)

    def _angles(self, x: Tensor, seen: Observation) -> tuple[Tensor, Tensor]:
        """Angles across the measured rays `[B, D, 2]` and their derivatives in the markers' three vertices `[B, D, 2, 9]`."""
        to_marker = self.markers(x) - seen.origins
        distance = torch.linalg.vector_norm(to_marker, dim=-1)[..., None]
        along = to_marker / distance
        angle = (seen.across @ along[..., None]).squeeze(-1)
        slope = (seen.across - angle[..., None] * along[..., None, :]) / distance[..., None]
        return angle, (slope[..., None, :] * self.marker_weights[:, None, :, None]).flatten(-2)

    def force_jacobian(self, x: Tensor, pressure: Tensor) -> Tensor:
        """Derivative of `contact_force` in the seven neighbours of every vertex, `[B, V, 3, 21]`; zero for fixed neighbours."""
        blocks = self.sheet.hessian_blocks(x) - pressure.reshape(-1, *(1,) * 5) * self.membrane.volume_hessian_blocks(x)
        pairs = blocks.unflatten(-1, (3, 3)).unflatten(-3, (3, 3)).transpose(-3, -2).flatten(1, 5)
        rows = pairs.new_zeros(len(x), self.inside.numel(), 3, 3).index_add(1, self.scatter, pairs)
        rows = rows.unflatten(1, self.inside.shape) * (self.inside * self.moves)[..., None, None]
        return rows.transpose(2, 3).flatten(-2)

    def step(self, x: Tensor, pressure: Tensor, seen: Observation, eps: float) -> tuple[Tensor, Tensor]:
        """One reweighted Gauss-Newton step in surface and pressure, the volume linearised, the longest vertex step capped."""
        force, A = self.contact_force(x, pressure), self.force_jacobian(x, pressure)
        v = self.membrane.volume_gradient(x) * self.moves
        W = self._weights(x, force, eps)
        angle, J = self._angles(x, seen)
        angle_weight = seen.weight[..., None]
        gram = lambda M, w: M.mT @ (w[..., None] * M)  # noqa: E731
        matrix = self.system.matrix([(self.vertex_patches, A.mT @ W @ A), (self.marker_patches, gram(J, angle_weight))])
        to_system = lambda field: self.system.vector([(self.vertex_patches, (A.mT @ W @ field[..., None]).squeeze(-1))])  # noqa: E731
        marker_load = (J.mT @ (angle_weight * angle)[..., None]).squeeze(-1)
        g = to_system(force) + self.system.vector([(self.marker_patches, marker_load)])
        m, n = -to_system(v), self.system.from_vertices(v)
        y = self.system.solve(matrix, torch.stack([g, m, n], -1))
        move, rise = self._bordered(x, pressure, y, m, n, v, W, force)
        move = self.system.to_vertices(move)
        longest = torch.linalg.vector_norm(move, dim=-1).amax(-1)
        share = (LONGEST_STEP * self.size / longest.clamp_min(torch.finfo(x.dtype).tiny)).clamp_max(1.0)
        return x + share[:, None, None] * move, pressure + share * rise

    def _weights(self, x: Tensor, force: Tensor, eps: float) -> Tensor:
        """`W_k = (w_n n n^T + w_t (I - n n^T)) / a_k`, `[B, V, 3, 3]`."""
        area, normal = self.membrane.rest_area, self.membrane.normals(x)
        q_n, q_t = _split(force / area[:, None], normal)
        w_n = torch.where(q_n < 0, (q_n**2 + eps**2).rsqrt(), PULL / eps)
        w_t = self.friction * (q_t.square().sum(-1) + eps**2).rsqrt()
        one = torch.eye(3, dtype=x.dtype, device=x.device)
        W = (w_n - w_t)[..., None, None] * normal[..., :, None] * normal[..., None, :] + w_t[..., None, None] * one
        return self.beta * W / area[:, None, None]

    def _bordered(self, x, pressure, y, m, n, v, W, force):
        """Step `d` and rise of the pressure: `M d + m dp + n lambda = -g` with the rows of the pressure and of the volume."""
        dot = lambda a, b: (a * b).sum((-1, -2)) if a.ndim == 3 else (a * b).sum(-1)  # noqa: E731
        Mg, Mm, Mn = y.unbind(-1)
        Wv = (W @ v[..., None]).squeeze(-1)
        if self.cavity.filling == "open":
            return -Mg, torch.zeros_like(pressure)
        target, compliance = self.cavity.condition(self.membrane.volume(x) - self.membrane.rest_volume, pressure)
        a11, a12, a22 = dot(v, Wv) - dot(m, Mm), compliance - dot(m, Mn), -dot(n, Mn)
        b1, b2 = dot(force, Wv) + dot(m, Mg), target + dot(n, Mg)
        det = a11 * a22 - a12**2
        rise, multiplier = (b1 * a22 - a12 * b2) / det, (a11 * b2 - a12 * b1) / det
        return -Mg - rise[:, None] * Mm - multiplier[:, None] * Mn, rise


def _split(traction: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    normal_part = (traction * normal).sum(-1)
    return normal_part, traction - normal_part[..., None] * normal


def _across(directions: Tensor) -> Tensor:
    """Two unit vectors across each unit direction, `[..., 3]` to `[..., 2, 3]`."""
    x, z = directions.new_tensor([1.0, 0.0, 0.0]), directions.new_tensor([0.0, 0.0, 1.0])
    least = torch.where(directions[..., 2:].abs() < 0.9, z, x)
    first = nn.functional.normalize(torch.linalg.cross(directions, least), dim=-1)
    return torch.stack([first, torch.linalg.cross(directions, first)], -2)


def _stencil(membrane: Membrane) -> tuple[Tensor, Tensor, Tensor]:
    """Neighbours `[V, 7]` of every vertex, where each triangle's pairs of vertices go in them, and which are free `[V, 7]`."""
    m, n = membrane.grid
    vertex = torch.arange(m * n)
    offset = torch.tensor(NEIGHBOURS)
    i, j = vertex[:, None] // n + offset[:, 0], vertex[:, None] % n + offset[:, 1]
    exists = (i >= 0) & (i < m) & (j >= 0) & (j < n)
    neighbour = torch.where(exists, i * n + j, vertex[:, None])
    triangle = triangles_of(corners(vertex[:, None], (m, n))).reshape(-1, 3)
    same = neighbour[triangle][:, :, None, :] == triangle[:, None, :, None]
    slot = (same & exists[triangle][:, :, None, :]).long().argmax(-1)
    free = exists & ~membrane.fixed[neighbour]
    return neighbour, (triangle[:, :, None] * len(NEIGHBOURS) + slot).flatten(), free.double()
