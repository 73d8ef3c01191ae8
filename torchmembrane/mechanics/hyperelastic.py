"""Elastic energy of the membrane on linear triangles: harmonic, neo-Hookean, Mooney-Rivlin.

With the rest metric `G` and the deformed metric `g` of a triangle's edges, `I = tr(G^-1 g)` and `D = det g / det G` are the
invariants of `C = F^T F`; the energy per rest area is `W(I, D)`. Unless a modulus is given, results are in units of shear
modulus x thickness in the rest state. `l` is the prestretch of the rest state.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..errors import MembraneError
from ..solve.stencil import apply_stencil, convolved, stencil_kernels
from ..surface.membrane import Membrane
from ..surface.topology import corners, triangles_of
from ..torch_modes import on_cpu
from .metric import (
    adjugate,
    cell_edges,
    cell_metric,
    determinant,
    edge_vectors,
    forces_of_stress,
    metric,
    metric_constants,
    one_ring_constants,
    products,
    tensile_part,
)

MODELS = ("harmonic", "neo_hookean", "mooney_rivlin")
_FIRST = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
_SECOND = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


class Derivatives(NamedTuple):
    """Derivatives of `W(I, D)`."""

    I: Tensor  # noqa: E741
    D: Tensor
    ID: Tensor
    DD: Tensor
    convex_D: Tensor
    """The part of `D` from terms that are convex in the metric; a Gauss-Newton stiffness omits the other terms."""


class Strain(NamedTuple):
    """The strain of `T` triangles: their two edges from the first vertex `[..., 3, 2, T]`, the entries 11, 12, 22 of the
    adjugate of their metric `[..., 3, T]`, and the invariants `I` and `D` `[..., 1, T]`."""

    edges: Tensor
    adjugate: Tensor
    I: Tensor  # noqa: E741
    D: Tensor


@on_cpu
class ElasticEnergy(nn.Module):
    """The membrane's elastic energy `U(x)`, with its gradient, and its stiffness along given directions.

    harmonic       `W = mu/2 l^2 (I - 2)` (eq. 11 of the paper, whose printed form lacks the factor 1/2 and the area element)
    neo_hookean    `W = mu/2 (l^2 I + 1 / (l^4 D) - 3)`
    mooney_rivlin  `W = C1 (I1 - 3) + C2 (I2 - 3)`, `I1 = l^2 I + 1 / (l^4 D)`, `I2 = l^4 D + I / (l^2 D)`, `2 (C1 + C2) = mu`

    Args:
        membrane: the rest surface.
        model: "harmonic" | "neo_hookean" | "mooney_rivlin".
        prestretch: prestretch l of the rest state.
        modulus: mu, the shear modulus times the thickness at rest, force / length.
        c2_ratio: C2 / C1, for Mooney-Rivlin only.

    Raises:
        MembraneError: the model is unknown.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> dome = spherical_cap(12, 9, 3, (9, 9))
        >>> elasticity = ElasticEnergy(dome, "neo_hookean", prestretch=1.3)
        >>> list(elasticity.gradient(dome.rest).shape), bool(elasticity.energy(1.01 * dome.rest) > elasticity.energy(dome.rest))
        ([81, 3], True)
    """

    prestretch: Tensor
    c1: Tensor
    c2: Tensor
    inverse_metric: Tensor
    det: Tensor
    area: Tensor
    around: Tensor
    transposed: Tensor
    one: Tensor
    twice_12: Tensor
    bend: Tensor
    metric_to_pairs: Tensor
    stress_to_pairs: Tensor
    sides: Tensor
    first: Tensor
    missing: Tensor
    half_over_det: Tensor
    force_of_I: Tensor
    force_of_D: Tensor
    heron: Tensor
    total: Tensor
    cell_inverse: Tensor
    cell_det: Tensor
    cell_first: Tensor
    cell_second: Tensor
    rest_edges: Tensor
    rest_sides: Tensor
    rest_cell_edges: Tensor

    def __init__(
        self,
        membrane: Membrane,
        model: str = "neo_hookean",
        prestretch: float = 1.0,
        modulus: float = 1.0,
        c2_ratio: float = 0.0,
    ):
        super().__init__()
        if model not in MODELS:
            raise MembraneError(f"ElasticEnergy: model = {model!r}; expected one of {', '.join(MODELS)}")
        self.model, self.grid = model, membrane.grid
        c2 = modulus / 2 * c2_ratio / (1 + c2_ratio) if model == "mooney_rivlin" else 0.0
        for name, value in (("prestretch", prestretch), ("c1", modulus / 2 - c2), ("c2", c2)):
            self.register_buffer(name, torch.tensor(float(value), dtype=torch.float64))
        self.register_buffer("rest_edges", edge_vectors(membrane.rest, self.grid))
        g = metric(self.rest_edges)
        det = determinant(g)
        self.register_buffer("inverse_metric", adjugate(g) / det)
        self.register_buffer("det", det)
        self.register_buffer("area", det.sqrt() / 2)
        for name, constant in {**metric_constants(), **one_ring_constants()}.items():
            self.register_buffer(name, constant)
        self._register_one_ring(membrane)
        self._register_cells(membrane)

    def _register_one_ring(self, membrane: Membrane) -> None:
        """Register constants of the six triangles around every vertex, `6 V` in all; each has two sides at the vertex and one
        opposite to it."""
        own, ring = stencil_kernels()[:1], stencil_kernels()[1:]
        following = ring.roll(-1, 0)
        self.register_buffer("sides", torch.cat([ring - own, following - own, following - ring]))
        beyond, rest = (
            apply_stencil(x, self.sides, self.grid).unflatten(-1, (3, -1))
            for x in (torch.ones_like(membrane.rest), membrane.rest)
        )
        self.register_buffer("rest_sides", rest.flatten(-2))
        missing = (beyond != 0).any(0).any(0)
        e1, e2, _ = rest.unbind(-2)
        g11, g12, g22 = (e1 * e1).sum(0), (e1 * e2).sum(0), (e2 * e2).sum(0)
        det = torch.where(missing, 1.0, g11 * g22 - g12**2)
        twice_area = torch.where(missing, 0.0, det.sqrt())
        self.register_buffer("first", torch.stack([g22 - g12, g11 - g12, g12]) / det)  # weights of the squared sides in I
        self.register_buffer("missing", missing.double())
        self.register_buffer("half_over_det", torch.where(missing, 0.0, 0.5 / det))
        self.register_buffer("force_of_I", -twice_area * self.first[:2])
        self.register_buffer("force_of_D", -twice_area / det)
        self.register_buffer("heron", 0.5 - torch.eye(3, dtype=torch.float64))
        self.register_buffer("total", torch.ones(1, 3, dtype=torch.float64))

    def _register_cells(self, membrane: Membrane) -> None:
        self.register_buffer("rest_cell_edges", cell_edges(membrane.rest, self.grid))
        g11, g12, g22 = cell_metric(self.rest_cell_edges).unbind(-4)
        det = g11 * g22 - g12 * g12
        inverse = torch.stack([g22, -g12, g11]) / det
        self.register_buffer("cell_inverse", inverse * torch.tensor([1, 2, 1])[:, None, None, None])
        self.register_buffer("cell_det", 1 / det)
        self.register_buffer("cell_first", det.sqrt() * inverse)
        self.register_buffer("cell_second", 1 / det.sqrt())

    def for_membrane(self, membrane: Membrane) -> "ElasticEnergy":
        """Return the energy of the same material on another membrane or grid."""
        modulus = 2 * float(self.c1 + self.c2)
        return ElasticEnergy(membrane, self.model, float(self.prestretch), modulus, float(self.c2 / self.c1))

    on = for_membrane  # its name before 0.2.0

    def strain(self, x: Tensor) -> Strain:
        """Return the strain of all `T = 2 (m-1) (n-1)` triangles of vertices `x [..., V, 3]`."""
        return self._strain(edge_vectors(x, self.grid))

    def _strain(self, edges: Tensor) -> Strain:
        g = metric(edges)
        first = (self.twice_12 * self.inverse_metric * g).sum(-2, keepdim=True)
        return Strain(edges, adjugate(g), first, determinant(g) / self.det)

    def principal_stretches(self, x: Tensor) -> Tensor:
        """Return the stretches of every triangle along its two principal directions, relative to the rest state.

        They are the singular values of the deformation gradient F (eqs. 43, 44). With the invariants `I` and `D` of
        `C = F^T F`, their squares are `s = (I + sqrt(I^2 - 4 D)) / 2` and `D / s`. Multiply them by the prestretch for the
        stretches relative to the unstretched membrane.

        Args:
            x: vertices `[..., V, 3]`.

        Returns:
            `[..., T, 2]`, largest first, triangles in the order of `Membrane.triangles`.

        Limitations:
            Equal stretches are not differentiable, and only accurate to the square root of the rounding error.

        Example:
            >>> from torchmembrane.surface.shapes import heightfield
            >>> plane = heightfield([0, 1, 2], [0, 1, 2], torch.full((3, 3), 5.0))
            >>> x = plane.rest * torch.tensor([0.9, 1.2, 1.0])
            >>> ElasticEnergy(plane).principal_stretches(x)[0].round(decimals=6).tolist()
            [1.2, 0.9]
        """
        _, _, I, D = self.strain(x)  # noqa: E741
        larger = (I + (I * I - 4 * D).clamp_min(0).sqrt()) / 2
        squared = torch.cat([larger, D / larger], -2).unflatten(-1, (2, -1))  # all first triangles, then all second ones
        return squared.transpose(-3, -1).flatten(-3, -2).sqrt()

    def density(self, I: Tensor, D: Tensor) -> Tensor:  # noqa: E741
        """Return the energy per rest area `W(I, D)`."""
        l2, c1, c2 = self.prestretch**2, self.c1, self.c2
        if self.model == "harmonic":
            return c1 * l2 * (I - 2)
        return c1 * (l2 * I + 1 / (l2**2 * D) - 3) + c2 * (l2**2 * D + I / (l2 * D) - 3)

    def first_derivatives(self, I: Tensor, D: Tensor) -> tuple[Tensor, Tensor]:  # noqa: E741
        """Return the first derivatives of `density`, `dW/dI` and `dW/dD`; constant ones are scalars."""
        l2, c1, c2 = self.prestretch**2, self.c1, self.c2
        if self.model == "harmonic":
            return c1 * l2, torch.zeros_like(l2)
        w_D = -c1 / l2**2 / (D * D)
        if self.model == "neo_hookean":
            return c1 * l2, w_D
        inverse = 1 / D
        return c1 * l2 + c2 / l2 * inverse, w_D - c2 / l2 * I * inverse * inverse + c2 * l2**2

    def derivatives(self, I: Tensor, D: Tensor) -> Derivatives:  # noqa: E741
        """Return the first and second derivatives of `density`; constant ones are scalars."""
        l2, c1, c2 = self.prestretch**2, self.c1, self.c2
        zero, (w_I, w_D) = torch.zeros_like(l2), self.first_derivatives(I, D)
        if self.model == "harmonic":
            return Derivatives(w_I, w_D, zero, zero, zero)
        if self.model == "neo_hookean":
            return Derivatives(w_I, w_D, zero, -2 * w_D / D, w_D)
        return Derivatives(w_I, w_D, -c2 / (l2 * D**2), 2 * c1 / (l2**2 * D**3) + 2 * c2 * I / (l2 * D**3), w_D - c2 * l2**2)

    def energy(self, x: Tensor) -> Tensor:
        """Return the energy `U [...]` of vertices `x [..., V, 3]`."""
        _, _, I, D = self.strain(x)  # noqa: E741
        return (self.area * self.density(I, D)).sum((-1, -2))

    def gradient(self, x: Tensor) -> Tensor:
        """Return the gradient `dU/dx`, `[..., V, 3]`: the membrane's nodal forces with opposite sign."""
        if torch.compiler.is_exporting():
            return self.gradient_by_rings(x)
        return self._gradient(cell_edges(x, self.grid))

    def gradient_of_displaced(self, u: Tensor) -> Tensor:
        """Return `gradient` for a surface that is displaced from rest by `u [..., V, 3]`.

        The edges are computed as the rest edges plus the differences of `u`. If they were computed from positions in float32,
        rounding would change the strain of a short edge far from the origin by more than a slack sheet's tension does.
        """
        if torch.compiler.is_exporting():
            return self._gradient_by_rings(self.rest_sides + apply_stencil(u, self.sides, self.grid))
        return self._gradient(self.rest_cell_edges + cell_edges(u, self.grid))

    def _gradient(self, edges: Tensor) -> Tensor:
        if self.model == "harmonic":
            return forces_of_stress(edges, self.c1 * self.prestretch**2 * self.cell_first)
        g = cell_metric(edges)
        g11, g12, g22 = g.unbind(-4)
        D = (g11 * g22).addcmul(g12, g12, value=-1) * self.cell_det
        w_I, w_D = self.first_derivatives((g * self.cell_inverse).sum(-4), D)
        tensile = self.cell_second * w_D
        stress = torch.stack([tensile * g22, -tensile * g12, tensile * g11], -4)
        return forces_of_stress(edges, stress + self.cell_first * w_I.expand(D.shape).unsqueeze(-4))

    def gradient_by_rings(self, x: Tensor) -> Tensor:
        """Return `gradient`, computed from the six triangles around each vertex by convolutions: fast in exported models.

        `I` is linear and `D` quadratic (Heron) in the squared lengths `l` of a triangle's three sides.
        """
        return self._gradient_by_rings(apply_stencil(x, self.sides, self.grid))

    def _gradient_by_rings(self, e: Tensor) -> Tensor:
        batch, V = e.shape[:-2], e.shape[-1] // len(self.sides)
        squared = (self.total @ (e * e)).reshape(*batch, 3, 6 * V)
        dD = self.heron @ squared  # det dD/dl
        D = self.total @ (squared * dD) * self.half_over_det + self.missing
        w_I, w_D = self.first_derivatives(self.total @ (self.first * squared), D)
        of_sides = self.force_of_I * w_I + self.force_of_D * w_D * dD[..., :2, :]
        return (e[..., : 12 * V].reshape(*batch, 3, 12, V) * of_sides.reshape(*batch, 1, 12, V)).sum(-2).mT

    def stiffness_along(self, x: Tensor, directions: Tensor) -> Tensor:
        """Return the positive semi-definite stiffness for displacements along one direction at each vertex.

        Its sum over quadrilaterals is `K_kl = d_k . H_kl d_l` with the Hessian `H` of `U`. It is exact where the membrane is in
        tension, except that Mooney-Rivlin's non-convex term in `D` is omitted. For the harmonic energy it is `L_kl d_k . d_l`
        (eq. 64).

        Args:
            x: vertices `[..., V, 3]`.
            directions: direction at each vertex, `[..., V, 3]`.

        Returns:
            The corner matrices of all quadrilaterals, `[..., m-1, n-1, 4, 4]`.
        """
        H = self.hessian_blocks(x, positive=True).unflatten(-1, (3, 3)).unflatten(-3, (3, 3))
        d = triangles_of(corners(directions, self.grid))
        return self._quadrilaterals(torch.einsum("...kilj,...ki,...lj->...kl", H, d, d))

    def hessian_blocks(self, x: Tensor, positive: bool = False) -> Tensor:
        """Return the second derivatives of every triangle's energy with respect to its nine vertex coordinates.

        Args:
            x: vertices `[..., V, 3]`.
            positive: whether to omit compressive stress and Mooney-Rivlin's non-convex term in `D`, so that every block is
                positive semi-definite. Otherwise the derivatives are exact.

        Returns:
            `[..., m-1, n-1, 2, 9, 9]`, vertices in the order of `TRIANGLE_CORNERS`.
        """
        pairs = self._pairs(self.strain(x), positive)[..., :9, :, :].unflatten(-1, (2, *_cells(self.grid)))
        ab, ac, bc = pairs.unflatten(-5, (3, 3)).movedim((-3, -4, -6, -5), (-4, -3, -2, -1)).unbind(-3)
        rows = [[-(ab + ac), ab, ac], [ab.mT, -(ab.mT + bc), bc], [ac.mT, bc.mT, -(ac.mT + bc.mT)]]
        return torch.cat([torch.cat(row, -1) for row in rows], -2)

    def one_ring(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradient and the tangent stiffness at the inner vertices, as coefficients of their six neighbours.

        The gradient at vertex `k` is `sum_i s_i (x_i - x_k)` over the six neighbours `i`. Its derivative with respect to
        neighbour `i` is `H_i`, and with respect to the vertex itself minus the sum of all `H_i`.

        Args:
            u: displacement from rest, `[..., V, 3]`.

        Returns:
            `s [..., 6, N]` and `H [..., 3, 3, 6, N]`.
        """
        (m, n), pairs = self.grid, self._pairs(self._strain(self.rest_edges + edge_vectors(u, self.grid)))
        planes = pairs.reshape(-1, 6, *_cells(self.grid))
        found = convolved(planes, self.around).reshape(*pairs.shape[:-2], 2, 6, (m - 2) * (n - 2))
        direct, transposed = found.unbind(-3)
        both = direct + transposed.index_select(-3, self.transposed)
        return both[..., 9, :, :], both[..., :9, :, :].unflatten(-3, (3, 3))

    def _pairs(self, strain: Strain, positive: bool = False) -> Tensor:
        """Return the second derivatives of the energy in the vertex pairs (0, 1), (0, 2), (1, 2) of all triangles.

        The second derivatives in the edges `a`, `b` from vertex 0 are `sum_cd T_cd e_c e_d^T + S_ab 1`. Here `S` is the stress
        (the force on edge `a` is `sum_b S_ab e_b`), and `T` follows from the second derivatives `Q` in the metric.

        Returns:
            The nine entries of a pair's block, then its coefficient of the unit matrix, `[..., 10, 3, T]`.
        """
        e, adjugate, I, D = strain  # noqa: E741
        w, q = self.derivatives(I, D), self.twice_12 / self.det * adjugate
        stress = 2 * self.area * self.inverse_metric * w.I + 2 * self.area / self.det * w.D * adjugate
        Q = products(q, self.area * w.DD * q) + self.area / self.det * (w.convex_D if positive else w.D) * self.bend
        if self.model == "mooney_rivlin":
            p = self.area * w.ID * self.twice_12 * self.inverse_metric
            Q = Q + products(p, q) + products(q, p)
        S = (self.stress_to_pairs @ (tensile_part(stress) if positive else stress))[..., None, :, :]
        T1, T2 = (self.metric_to_pairs @ Q).unflatten(-2, (1, 3, 2, 2)).unbind(-2)
        e1, e2 = e[..., :, None, None, :, :].unbind(-2)
        first, second = torch.addcmul(T1 * e1, T2, e2)[..., None, :, :, :, :].unbind(-2)
        blocks = torch.addcmul(e1 * first, e2, second).flatten(-4, -3)
        return torch.cat([torch.addcmul(blocks, self.one, S), S], -3)

    @staticmethod
    def _quadrilaterals(K: Tensor) -> Tensor:
        first, second = (torch.tensor(t, dtype=K.dtype, device=K.device) for t in (_FIRST, _SECOND))
        return first.T @ K[..., 0, :, :] @ first + second.T @ K[..., 1, :, :] @ second

    @property
    def tension(self) -> Tensor:
        """Tension of the rest state, force / length: the isotropic stress resultant at `x = X`."""
        two, one = self.prestretch.new_full((), 2.0), self.prestretch.new_full((), 1.0)
        w = self.derivatives(two, one)
        return 2 * (w.I + w.D)


def _cells(grid: tuple[int, int]) -> tuple[int, int]:
    return grid[0] - 1, grid[1] - 1
