"""Base class of the estimators whose unknowns are the ranges of the grid's vertices along their rays."""

from typing import Any, ClassVar, Self

from torch import Tensor

from ...camera.model import Camera, Rays
from ...errors import MembraneError
from ...mechanics.affine_quadrilateral import AffineQuadrilaterals
from ...mechanics.cavity import CavityLaw, rest_balance
from ...mechanics.hyperelastic import ElasticEnergy
from ...surface.membrane import Membrane
from ...torch_modes import on_cpu
from ..base import Equilibrium, Estimator, Observation, Problem
from ..contacts import Contacts
from .flow import FlowInterpolation, VertexFlow
from .segmentation import Segmentation


class VertexRays(Estimator):
    """Rest state, flow and contacts of an estimator whose unknowns are the ranges `t_k`, `x_k = o_k + t_k d_k`.

    The rest load `h = grad U(X) - p0 grad V(X)` is subtracted, so that zero flow gives exactly zero displacement.

    Args:
        membrane: the rest surface on the solver's grid.
        energy: elastic energy of the membrane.
        rest_rays: origins and unit directions of the rest rays, `[V, 3]`.
        filling: filling of the cavity, as for `CavityLaw`.
        gas: absolute pressure and volume of a gas at rest.
        flow: interpolates the markers' pixels to the vertices of the grid; only `prepare` needs it.
    """

    in_parts: ClassVar[bool] = True
    rest_range: Tensor
    rest_load: Tensor
    free: Tensor

    def __init__(
        self,
        membrane: Membrane,
        energy: ElasticEnergy | AffineQuadrilaterals,
        rest_rays: Rays | tuple[Tensor, Tensor],
        filling: str,
        gas: tuple[float, float] | None,
        flow: VertexFlow | None,
    ):
        rest_pressure, rest_load = rest_balance(membrane, energy)
        super().__init__(membrane, CavityLaw(membrane, rest_pressure, filling, gas))
        self.energy, self.flow = energy, flow
        self.segmentation = Segmentation(membrane, rest_rays, patches=self.patches)
        origins, directions = rest_rays
        self.register_buffer("rest_range", ((membrane.rest - origins) * directions).sum(-1))
        self.register_buffer("rest_load", rest_load.mT.contiguous().mT)  # in the memory layout of forces: components first
        self.register_buffer("free", (~membrane.fixed).double())

    @classmethod
    @on_cpu
    def from_problem(cls, problem: Problem, settings: Any = None) -> Self:
        """Build the estimator for a sensor; `settings` are those of the class."""
        settings = settings or cls.Settings()
        rays = problem.camera.pixel_to_ray(problem.vertex_pixels)
        flow = VertexFlow(problem, cls.interpolation(problem, settings))
        build: Any = cls  # subclasses take settings too
        built: Self = build(problem.membrane, problem.elasticity, rays, problem.filling, problem.gas, settings, flow)
        return built

    @classmethod
    def interpolation(cls, problem: Problem, settings: Any) -> FlowInterpolation:
        """Return the interpolation of the flow between the markers: the smooth one, unless a subclass returns another."""
        return FlowInterpolation(problem.membrane, problem.markers)

    def prepare(self, camera: Camera, pixels: Tensor, confidence: Tensor, covariance: Tensor | None = None) -> Observation:
        """Return the rays of the grid's vertices, moved by the flow of the markers at `pixels [B, D, 2]`, with equal noise."""
        if self.flow is None:
            raise MembraneError(
                f"{type(self).__name__}.prepare: there is no flow; pass flow, or call forward with the vertices' rays"
            )
        return Observation(*camera.pixel_to_ray(self.flow(pixels, confidence)), confidence)

    def contacts(self, found: Equilibrium, normals: Tensor) -> Contacts:
        """Return the contacts, where the membrane bulges inwards along its `normals [B, V, 3]` (section 5.1)."""
        return self.segmentation.contacts(found.vertices, normals)
