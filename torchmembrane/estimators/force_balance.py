"""Force balance: the surface and the pressure whose residual forces, the contact forces, are few and push inwards.

Every vertex carries three equations of equilibrium and one unknown depth. With the contact traction

    q_k = (grad_k U(x) - h_k - p grad_k V(x)) / a_k,    s = -q . n / p0 the push, q_t the part along the surface,

    min over x, p:  sum_d 1/2 R^2 log(1 + |r_d(x)|^2 / (R sigma)^2) + beta sum_k a_k [f(s_k) + kappa |q_t| / (1 + c s_k)]

at the cavity's volume. `r_d` is the angle between a marker's ray and its modelled position; its price saturates, so that a
wrongly matched marker has little say. A convex body without friction pushes with at least the fluid's pressure or not at all: a
small push is the grid's error or noise, a large one a contact. So the price `f` of a push is quadratic at first and saturates
beyond `tau` (like s^2 / (1 + s^2 / tau^2)), that of a pull stays quadratic, and what rubs is cheaper where something pushes.
Whether a vertex is pushed is asked of its surroundings (`REACH`): contacts are patches.

Reweighted Gauss-Newton steps while `tau` falls from where everything is quadratic (graduated non-convexity): no start but the
rest surface is needed. A fine grid starts from the solution on every second of its lines, that one from one coarser still: it
takes few vertices to find the basin. From the solution of the previous frame the first step's factor does for all: with it,
two conjugate-gradient steps solve the others' equations well enough.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..mechanics.cavity import CavityLaw, Equilibrium, rest_balance
from ..mechanics.hyperelastic import ElasticEnergy
from ..solve.conjugate_gradient import conjugate_gradient
from ..solve.stencil_system import NEAR, StencilSystem
from ..surface.membrane import Membrane
from ..surface.projection import SurfacePoints
from ..surface.stencil import apply_stencil, inner, one_ring_edges, pad_border, stencil_kernels
from .covariance import StandardDeviations, standard_deviations

STEPS, COARSE_STEPS, TAU = 8, 4, (4.0, 0.4)  # from rest, and so where a finer grid follows
FINE_STEPS, FINER_STEPS, FINE_TAU = 5, 4, (0.8, 0.4)  # from the coarsest grid's solution, from a finer one's
WARM_STEPS, WARM_TAU = 4, (1.2, 0.4)  # from the previous frame's solution
CONJUGATE_STEPS = 2  # of a step that has the factor of another
FALL = 0.6  # share of the steps over which tau falls
SPARSITY = 3200.0  # price of the push p0 on the whole surface, while it is quadratic
FRICTION, SLIP = 3.75, 0.05  # kappa over the price of a push; where |q_t| begins to be linear, over p0
CONE, COARSE_CONE = 15.0, 5.0  # c, and on the coarsest grid, whose own error looks like friction under a push
REACH = 0.04  # over the surface's size
FLOOR = 1e-3  # of a push's weight; without it a vertex under a contact has no place of its own
OUTLIER = 5.0  # R
LONGEST_STEP = 0.026  # over the surface's size
COARSEST, COARSEST_WARM = 9, 13  # fewest lines of a coarser grid, of one that is given the previous frame's solution
LARGEST_RELATIVE_STEP, LARGEST_VOLUME_ERROR = 2e-3, 1e-3  # rms of the last step over the size, and volume error, when settled


def schedule(steps: int, fall: tuple[float, float]) -> list[tuple[float, float]]:
    """`tau` and the outlier scale `R` of every step, while `tau` falls from first to last."""
    first, last = fall
    taus = [first * (last / first) ** min(1.0, k / (FALL * (steps - 1))) for k in range(steps)]
    return [(tau, OUTLIER * tau / last) for tau in taus]


class Observation(NamedTuple):
    """Measured marker rays: `origins [B, 3, D]`, a basis across each ray `[B, 2, 3, D]`, weights over the variance `[B, D]`."""

    origins: Tensor
    across: Tensor
    weight: Tensor


class NormalEquations(NamedTuple):
    """`M = A^T W A + J^T w J`: the forces' slope `A [B, 3, 3, 7, N]` and weights `W [B, 3, 3, N]`; the angles' weighted slope
    `w J [B, 2, 3, D]` and `J^T w J [B, 3, 3, D]`, in the markers' positions."""

    slope: Tensor
    weights: Tensor
    weighted_sight: Tensor
    springs: Tensor


class Linearised(NamedTuple):
    """At the inner vertices: the contact `force [B, 3, N]`, its `slope [B, 3, 3, 7, N]` (of a component, in one, of a vertex of
    the stencil), the gradient of the `volume [B, 3, N]`, the outward `normal [B, 3, N]`. All but the normal zero at, and in,
    vertices that do not move. The slope is the Hessian of an energy: symmetric."""

    force: Tensor
    slope: Tensor
    volume: Tensor
    normal: Tensor


class ForceBalance(nn.Module):
    """Surface, contact tractions and pressure from marker rays.

    Arguments
        membrane, elasticity  the rest surface on the solver's grid, its material
        markers            the markers' `SurfacePoints`, and `positions [D, 3]`, their rest positions
        noise              angular noise of a marker, radians; about twice the locator's, to leave room for the grid's own error
        filling, gas       the cavity, as for `MinimumEnergy`
        steps              on this grid, without a start; default as the constants above

    A grid with an odd number of lines, at least 17, holds the estimator on every second line as `coarse`. The reference
    traction `p0` is the rest pressure, or tension / size where that is larger.
    Wrong when: the press is so shallow that its tractions drown in noise; two contacts lie within `REACH`.
    """

    def __init__(self, membrane: Membrane, elasticity: ElasticEnergy, markers: SurfacePoints, positions: Tensor, noise: float,
                 filling="liquid", gas: tuple[float, float] | None = None, steps: int | None = None):  # fmt: skip
        super().__init__()
        self.membrane, self.elasticity, self.noise = membrane, elasticity, noise
        self.largest_relative_step, self.largest_volume_error = LARGEST_RELATIVE_STEP, LARGEST_VOLUME_ERROR
        rest_pressure, rest_load = rest_balance(membrane, elasticity)
        self.cavity = CavityLaw(membrane, rest_pressure, filling, gas)
        self.size, self.cone = membrane.size, CONE
        self.reference = max(
            float(rest_pressure), float(elasticity.tension) / self.size, float(elasticity.c1 + elasticity.c2) / self.size
        )
        self.register_buffer("rest_pressure", rest_pressure)
        self.register_buffer("rest_load", rest_load)
        self.register_buffer("moves", (~membrane.fixed).double()[:, None])
        self.register_buffer("positions", torch.as_tensor(positions, dtype=torch.float64))
        within = lambda field: inner(field, membrane.grid)  # noqa: E731
        self.register_buffer("area", within(membrane.rest_area[:, None]).squeeze(-1))
        self.register_buffer("free", within(self.moves).squeeze(-1))
        self.register_buffer("edges", one_ring_edges())
        self.register_buffer("stencil_kernels", stencil_kernels())
        self.register_buffer(
            "free_neighbours", apply_stencil(self.moves, stencil_kernels()[1:], membrane.grid, border=False).reshape(6, -1)
        )
        self.register_buffer("surroundings", within(within(_surroundings(membrane)).mT).mT)
        vertex_shares, pair_shares = _shares(membrane, markers)
        self.register_buffer("vertex_shares", vertex_shares)
        self.register_buffer("pair_shares", pair_shares)
        self.system = StencilSystem(membrane.grid, self.free > 0)
        self.coarse = self._coarser(filling, gas)
        self.passes_on_starts = self.coarse is not None and min(self.coarse.membrane.grid) >= COARSEST_WARM
        usual = STEPS if self.coarse is None else FINE_STEPS if self.coarse.coarse is None else FINER_STEPS
        self.steps = steps or usual

    def _coarser(self, filling, gas) -> "ForceBalance | None":
        grid = self.membrane.grid
        if any(count % 2 == 0 or count < 2 * COARSEST - 1 for count in grid):
            return None
        every_second = lambda field: field.unflatten(0, grid)[::2, ::2].numpy()  # noqa: E731
        membrane = Membrane(every_second(self.membrane.rest), every_second(self.membrane.fixed))
        markers = membrane.closest_points(self.positions.numpy())
        elasticity = self.elasticity.on(membrane)
        coarse = ForceBalance(membrane, elasticity, markers, self.positions, self.noise, filling, gas)
        if coarse.coarse is None:
            coarse.steps, coarse.cone = COARSE_STEPS, COARSE_CONE
        return coarse

    def set_prestretch(self, prestretch: Tensor) -> None:
        """Another prestretch `[]`, gradients included; rest pressure and load follow, the reference traction stays."""
        self.elasticity.prestretch = prestretch
        self.rest_pressure, self.rest_load = rest_balance(self.membrane, self.elasticity)
        self.cavity.rest_pressure = self.rest_pressure
        if self.coarse is not None:
            self.coarse.set_prestretch(prestretch)

    def forward(
        self, origins: Tensor, directions: Tensor, weight: Tensor, start: tuple[Tensor, Tensor] | None = None
    ) -> Equilibrium:
        """Arguments: `origins`, `directions [B, D, 3]`, the markers' measured rays; `weight [B, D]`: 0 for a lost one, else up
        to 1; `start`: vertices `[B, V, 3]` and pressure `[B]` near the solution, such as the previous frame's."""
        seen, warm = self.observation(origins, directions, weight), start is not None
        if warm and not self.passes_on_starts:
            return self._descend(*start, seen, self.falls(warm), one_factor=True)
        if self.coarse is None:
            return self._descend(*self.at_rest(weight), seen, self.falls())
        coarse = self.coarse(origins, directions, weight, self.coarsened(*start) if warm else None)
        return self._descend(*self.refined(coarse.vertices, coarse.pressure), seen, self.falls())

    def falls(self, warm=False) -> list[tuple[float, float]]:
        """`tau` and `R` of every step on this grid; `warm`: with a start."""
        if warm and not self.passes_on_starts:
            return schedule(WARM_STEPS, WARM_TAU)
        return schedule(self.steps, TAU if self.coarse is None else FINE_TAU)

    def standard_deviations(
        self, equilibrium: Equilibrium, origins: Tensor, directions: Tensor, weight: Tensor, marker_noise: float | Tensor
    ) -> StandardDeviations:
        """Of the surface, total force and pressure found from these rays, as the noise of the markers spreads to first order.

        `marker_noise`: standard deviation of every marker's angles, radians; or `[B, D, 2, 3]`, how noise in each of two
        independent directions turns the rays. Wrong when: noise may change which vertices are pushed, as in the shallowest
        presses and where two answers compete; the grid's and the material's errors are not in it.
        """
        seen = self.observation(origins, directions, weight)
        noise = marker_noise if isinstance(marker_noise, Tensor) else marker_noise * seen.across.movedim(-1, 1)
        return standard_deviations(self, equilibrium.vertices, equilibrium.pressure, seen, noise, TAU[1], OUTLIER)

    def observation(self, origins: Tensor, directions: Tensor, weight: Tensor) -> Observation:
        return Observation(origins.mT, _across(directions.mT), weight / self.noise**2)

    def at_rest(self, weight: Tensor) -> tuple[Tensor, Tensor]:
        """The rest surface and pressure, for every row of `weight [B, D]`."""
        return self.membrane.rest.repeat(weight.shape[0], 1, 1), self.rest_pressure.repeat(weight.shape[0])

    def coarsened(self, x: Tensor, pressure: Tensor) -> tuple[Tensor, Tensor]:
        """Vertices `[B, V, 3]` and pressure `[B]` on the grid of `coarse`: every second line's."""
        return x.unflatten(1, self.membrane.grid)[:, ::2, ::2].flatten(1, 2), pressure

    def refined(self, x: Tensor, pressure: Tensor) -> tuple[Tensor, Tensor]:
        """Surface and pressure of `coarse` on this grid: the displacement is bilinear between its lines."""
        u = (x - self.coarse.membrane.rest).unflatten(1, self.coarse.membrane.grid).permute(0, 3, 1, 2)
        u = F.interpolate(u, self.membrane.grid, mode="bilinear", align_corners=True).permute(0, 2, 3, 1).flatten(1, 2)
        return self.membrane.rest + u * self.moves, pressure

    def _descend(
        self, x: Tensor, pressure: Tensor, seen: Observation, schedule: list[tuple[float, float]], one_factor=False
    ) -> Equilibrium:
        factor = None
        for tau, outlier in schedule:
            before, scales = x, (x.new_tensor(tau), x.new_tensor(outlier))
            x, pressure, made = self._compiled_once(x, pressure, seen, *scales, factor)
            factor = (factor or made) if one_factor else None
        return self.equilibrium(x, pressure, before)

    def equilibrium(self, x: Tensor, pressure: Tensor, before: Tensor) -> Equilibrium:
        """What this surface and pressure amount to; `before`: the surface a step earlier."""
        moved = (x - before).square().sum(-1).mean(-1).sqrt() / self.size
        traction = self.contact_force(x, pressure) / self.membrane.rest_area[:, None]
        return Equilibrium(x, pressure, self.membrane.volume(x), traction, moved)

    @torch.compiler.nested_compile_region
    def _compiled_once(self, x: Tensor, pressure: Tensor, seen: Observation, tau: Tensor, outlier: Tensor, factor):
        """`step`, which `torch.compile` then traces and compiles once, not once a step."""
        return self.step(x, pressure, seen, tau, outlier, factor)

    def contact_force(self, x: Tensor, pressure: Tensor) -> Tensor:
        """Force that something outside must exert on every free vertex, `[B, V, 3]`."""
        push = pressure[:, None, None] * self.membrane.volume_gradient(x)
        return (self.elasticity.gradient(x) - self.rest_load - push) * self.moves

    def linearised(self, x: Tensor, pressure: Tensor) -> "Linearised":
        """`contact_force` and what it and the volume do when vertices move, at the inner vertices."""
        grid = self.membrane.grid
        edges = apply_stencil(x, self.edges, grid, border=False).unflatten(-1, (2, -1))
        gradient, volume_one_ring = self.membrane.volume_one_ring(edges)
        stress, elastic_ring = self.elasticity.one_ring(edges)
        pull = (stress[:, None] * edges[:, :, 0].unflatten(-1, (6, -1))).sum(2)
        force = pull - inner(self.rest_load, grid).mT - pressure[:, None, None] * gradient
        beside = self.free_neighbours * (elastic_ring - pressure[:, None, None, None, None] * volume_one_ring)
        slope = torch.cat([-elastic_ring.sum(3, keepdim=True), beside], 3) * self.free
        return Linearised(force * self.free, slope, gradient * self.free, F.normalize(gradient, dim=1))

    def markers(self, x: Tensor) -> Tensor:
        """The markers' positions on the surface `x`, `[B, D, 3]`."""
        return self.positions + self.vertex_shares @ inner(x - self.membrane.rest, self.membrane.grid)

    def angles(self, x: Tensor, seen: Observation) -> tuple[Tensor, Tensor]:
        """Angles across the measured rays `[B, 2, D]` and their derivatives in the markers' positions `[B, 2, 3, D]`."""
        to_marker = self.markers(x).mT - seen.origins
        distance = torch.linalg.vector_norm(to_marker, dim=1, keepdim=True)
        along = (to_marker / distance)[:, None]
        angle = (seen.across * along).sum(2, keepdim=True)
        return angle.squeeze(2), (seen.across - angle * along) / distance[:, None]

    def step(
        self, x: Tensor, pressure: Tensor, seen: Observation, tau, outlier, factor: tuple[Tensor, ...] | None = None
    ) -> tuple[Tensor, Tensor, tuple[Tensor, ...] | None]:
        """One reweighted Gauss-Newton step in surface and pressure, the volume linearised, the longest vertex step capped.

        Also returns the factor of its matrix if it made one: with the `factor` of a step near this one it makes none.
        """
        at = self.linearised(x, pressure)
        W = self.force_weights(at.normal, at.force, tau)
        angle, sight = self.angles(x, seen)
        weight = self.marker_weights_at(angle, seen, outlier)
        normal = self.normal_equations(at, W, sight, weight)
        loads, of_fluid = self.loads(normal, at, angle)
        made = None
        if factor is None:
            made = self.system.factor(self.matrix(normal))
            y = self.system.substitute(made, loads)
        else:
            y = conjugate_gradient(
                lambda u: self.product(normal, u), lambda r: self.system.substitute(factor, r), loads, CONJUGATE_STEPS
            )
        move, rise = self.solve_bordered(x, pressure, y, loads, of_fluid)
        move = move.unflatten(-1, (3, -1)).mT
        longest = torch.linalg.vector_norm(move, dim=-1).amax(-1)
        share = (LONGEST_STEP * self.size / longest.clamp_min(torch.finfo(x.dtype).tiny)).clamp_max(1.0)
        return x + pad_border(share[:, None, None] * move, self.membrane.grid), pressure + share * rise, made

    def normal_equations(self, at: "Linearised", W: Tensor, sight: Tensor, weight: Tensor) -> NormalEquations:
        """Of forces weighted by `W [B, 3, 3, N]` and angles by `weight [B, D]`, `sight` being these angles' slope."""
        weighted = weight[:, None, None] * sight
        return NormalEquations(at.slope, W, weighted, (sight[:, :, :, None] * weighted[:, :, None]).sum(1))

    def loads(self, normal: NormalEquations, at: "Linearised", angle: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """`v`, `A^T W f + J^T w r` and `-A^T W v`, `[B, 3, 3 N]`; `f^T W v` and `v^T W v`, `[B]`."""
        W, v = normal.weights, at.volume
        weighted = torch.stack([_weighed(W, at.force), -_weighed(W, v)], 1)
        of_forces, of_fluid = self.along(at.slope, weighted).split(1, 1)
        of_markers = (normal.weighted_sight * angle[:, :, None]).sum(1) @ self.vertex_shares
        loads = torch.cat([v[:, None], of_forces + of_markers[:, None], of_fluid], 1).flatten(2)
        return loads, tuple((field * v).sum((1, 2)) for field in (weighted[:, 0], -weighted[:, 1]))

    def matrix(self, normal: NormalEquations) -> tuple[Tensor, Tensor, Tensor]:
        """`M` as `system.factor` takes it."""
        A = normal.slope.transpose(2, 3).flatten(2, 3).movedim(-1, 1)
        near = (normal.springs @ self.pair_shares).unflatten(-1, (len(NEAR), -1)).permute(0, 3, 1, 4, 2)
        return self.system.matrix(A.mT @ (normal.weights.movedim(-1, 1) @ A), near)

    def product(self, normal: NormalEquations, u: Tensor) -> Tensor:
        """`M u` for `u [B, C, 3 N]`, without the matrix."""
        u = u.unflatten(-1, (3, -1))
        of_forces = self.along(normal.slope, _weighed(normal.weights[:, None], self.along(normal.slope, u)))
        of_markers = _weighed(normal.springs[:, None], u @ self.vertex_shares.transpose(0, 1)) @ self.vertex_shares
        return (of_forces + of_markers).flatten(2)

    def along(self, slope: Tensor, move: Tensor) -> Tensor:
        """How forces change, `A u [B, C, 3, N]`, when the inner vertices make moves `u` of that shape: `A^T u` as well."""
        m, n = self.membrane.grid
        moves = (
            apply_stencil(move.mT, self.stencil_kernels, (m - 2, n - 2))
            .unflatten(-1, (len(self.stencil_kernels), -1))
            .flatten(2, 3)
        )
        return (slope.flatten(2, 3)[:, None] * moves[:, :, None]).sum(3)

    def force_weights(self, normal: Tensor, force: Tensor, tau: float, curvature=False) -> Tensor:
        """`W_k = (w_n n n^T + w_t (I - n n^T)) / a_k`, `[B, 3, 3, N]`: the parabolas that price a force.

        Arguments: `normal`, `force [B, 3, N]` of the inner vertices. With `curvature` that of the price of a push itself, zero
        where it bends down.
        """
        p0 = self.reference
        traction = force / self.area
        q_n = (traction * normal).sum(1)
        q_t = traction - q_n[:, None] * normal
        push2 = (-q_n / p0).clamp_min(0) ** 2 @ self.surroundings
        ratio = push2 / tau**2
        pushed = (1 - 3 * ratio).clamp_min(0) / (1 + ratio) ** 3 if curvature else (1 + ratio) ** -2
        w_n = FLOOR + torch.where(q_n < 0, pushed, 1.0)
        dearer = FRICTION / (1 + self.cone * (push2 + SLIP**4).sqrt())
        w_t = dearer * (q_t.square().sum(1) / p0**2 + SLIP**2).rsqrt()
        scale = SPARSITY / (p0 * self.size) ** 2 / self.area
        one = torch.eye(3, dtype=force.dtype, device=force.device)[..., None]
        along = (scale * (w_n - w_t))[:, None] * normal
        return along[:, :, None] * normal[..., None, :, :] + (scale * w_t)[:, None, None] * one

    def price(self, found: Equilibrium, origins: Tensor, directions: Tensor, weight: Tensor) -> Tensor:
        """What the last steps minimise, `[B]`: the misfit of the markers (given as to `forward`) and the tractions' price."""
        seen = self.observation(origins, directions, weight)
        x, area, tau, grid = found.vertices, self.area, TAU[-1], self.membrane.grid
        traction, normal = inner(found.traction, grid) / self.reference, inner(self.membrane.normals(x), grid)
        q_n = (traction * normal).sum(-1)
        slip2 = (traction - q_n[..., None] * normal).square().sum(-1)
        push2 = (-q_n).clamp_min(0) ** 2
        kappa = FRICTION / (1 + self.cone * (push2 @ self.surroundings + SLIP**4).sqrt())
        price = push2 / (2 + 2 * push2 / tau**2) + q_n.clamp_min(0) ** 2 / 2 + kappa * ((slip2 + SLIP**2).sqrt() - SLIP)
        misfit = seen.weight * self.angles(x, seen)[0].square().sum(1)
        return OUTLIER**2 / 2 * (misfit / OUTLIER**2).log1p().sum(-1) + SPARSITY / self.size**2 * price @ area

    def marker_weights_at(self, angle: Tensor, seen: Observation, outlier: float) -> Tensor:
        return seen.weight / (1 + seen.weight * angle.square().sum(1) / outlier**2)

    def solve_bordered(self, x, pressure, y, loads, of_fluid):
        """Step `d` and rise of the pressure: `M d + m dp + n lambda = -g` with the rows of the pressure and of the volume.

        `loads` are `n, g, m`, and `y` is `M^-1` of them.
        """
        if self.cavity.filling == "open":
            return -y[:, 1], torch.zeros_like(pressure)
        (fWv, vWv), products = of_fluid, (loads @ y.mT).flatten(1).unbind(-1)
        nMn, nMg, nMm, mMg, mMm = *products[:3], *products[7:]
        target, compliance = self.cavity.condition(self.membrane.volume(x) - self.membrane.rest_volume, pressure)
        a11, a12, a22 = vWv - mMm, compliance - nMm, -nMn
        b1, b2 = fWv + mMg, target + nMg
        det = a11 * a22 - a12 * a12
        rise, multiplier = (b1 * a22 - a12 * b2) / det, (a11 * b2 - a12 * b1) / det
        volume, load, push = y.unbind(1)
        return -(multiplier[:, None] * volume + load + rise[:, None] * push), rise


def _weighed(blocks: Tensor, field: Tensor) -> Tensor:
    """Blocks `[..., 3, 3, N]` times a field `[..., 3, N]`."""
    return (blocks * field[..., None, :, :]).sum(-2)


def _across(directions: Tensor) -> Tensor:
    """Two unit vectors across each unit direction, `[B, 3, D]` to `[B, 2, 3, D]`."""
    x, y, z = directions.unbind(1)
    none = torch.zeros_like(x)
    first = torch.where((z.abs() < 0.9)[:, None], torch.stack([y, -x, none], 1), torch.stack([none, z, -y], 1))
    first = F.normalize(first, dim=1)
    return torch.stack([first, torch.linalg.cross(directions, first, dim=1)], 1)


def _surroundings(membrane: Membrane) -> Tensor:
    """Weights `[V, V]` of a Gaussian mean over the rest surface; column k is that around vertex k."""
    weight = torch.exp(-(torch.cdist(membrane.rest, membrane.rest) ** 2) / (2 * (REACH * membrane.size) ** 2))
    weight = membrane.rest_area[:, None] * weight
    return weight / weight.sum(0)


def _shares(membrane: Membrane, markers: SurfacePoints) -> tuple[Tensor, Tensor]:
    """Every marker's share in what is summed at the inner vertices, `[D, N]`, and at them with those at `NEAR`, `[D, 4 N]`."""
    m, n = membrane.grid
    vertices, weights = torch.as_tensor(markers.vertices).long(), torch.as_tensor(markers.weights, dtype=torch.float64)
    share = torch.zeros(len(vertices), m * n, dtype=torch.float64).scatter_(1, vertices, weights) * ~membrane.fixed
    share = share.unflatten(1, (m, n))
    here = share[:, 1:-1, 1:-1]
    near = [(here * share[:, 1 + i : m - 1 + i, 1 + j : n - 1 + j]).flatten(1) for i, j in NEAR]
    return here.flatten(1), torch.cat(near, 1)
