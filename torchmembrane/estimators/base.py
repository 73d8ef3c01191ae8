"""What every estimator is built from, is given, and finds."""

from typing import ClassVar, NamedTuple, Protocol

import torch
from torch import Tensor

from ..camera.model import Camera
from ..mechanics.cavity import CavityLaw
from ..mechanics.hyperelastic import ElasticEnergy
from ..surface.membrane import Membrane
from ..surface.projection import SurfacePoints

CONTACT_POINTS = 4
"""Contacts that are reported at most."""


class Problem(NamedTuple):
    """One sensor, as an estimator is built from it.

    camera          its camera
    membrane        the rest surface on the solver's grid
    elasticity      what the membrane stores
    filling, gas    the cavity: "liquid" | "gas" | "open"; a gas' absolute pressure at rest and its volume
    markers         the markers as material points of the rest surface
    positions       `[D, 3]` their rest positions
    rest_pixels     `[D, 2]` where the model sees them at rest
    vertex_pixels   `[V, 2]` where the model sees the grid's vertices at rest
    rest_covariance `[D, 2, 2]` px^2, of the displacements' noise in a frame like the rest image
    """

    camera: Camera
    membrane: Membrane
    elasticity: ElasticEnergy
    filling: str
    gas: tuple[float, float] | None
    markers: SurfacePoints
    positions: Tensor
    rest_pixels: Tensor
    vertex_pixels: Tensor
    rest_covariance: Tensor


class Observation(NamedTuple):
    """Measured rays of a batch, of the markers or of the grid's vertices: as the estimator's `prepare` makes them.

    origins, directions  `[B, N, 3]`, the latter of length one
    confidence           `[B, N]`, 0 for a lost one, else up to 1
    across               `[B, N, 2, 3]`, two vectors across each ray: a small turn of the ray, along them, in standard
                         deviations of its marker; None: all are as sure, in all directions
    motion               `[B, N, 2, 4]`, by how much of these a camera that moves turns the ray, as `bearings.marker_rays` says;
                         None: it has not moved
    gauge                `[B, 2]`, what a gauge in the cavity reads, as of `pressure_gauge.gauge_reading`; None: there is none
    """

    origins: Tensor
    directions: Tensor
    confidence: Tensor
    across: Tensor | None = None
    motion: Tensor | None = None
    gauge: Tensor | None = None

    def to(self, dtype: torch.dtype) -> "Observation":
        """The same in another precision."""
        return self._replace(**{name: value.to(dtype) for name, value in self._asdict().items() if value is not None})


class Equilibrium(NamedTuple):
    """What an estimator finds: `vertices [..., V, 3]`, pressure difference and volume `[...]`, contact `traction [..., V, 3]`
    (zero for minimum energy), `relative_step [...]`: the last step over the surface's size, `reference [..., V]`: the traction
    against which pushes are measured (zero where no tractions are found), `misfit [...]`: rms of the markers' angles off their
    rays, in standard deviations (zero where the surface is on every ray), `moved [..., 4]`: the camera, against the rim,
    `objective [...]`: how unlikely markers and tractions are, over the markers seen, and `unexplained [...]`: as much of it
    as no push is the reason of: misfit, pulls and shear, `pushed [...]`: share of the surface that something pushes, and
    `shared_misfit [...]`: as much of the misfit as neighbouring markers have in common (all four zero where no tractions are
    found)."""

    vertices: Tensor
    pressure: Tensor
    volume: Tensor
    traction: Tensor
    relative_step: Tensor
    reference: Tensor
    misfit: Tensor
    moved: Tensor
    objective: Tensor
    unexplained: Tensor
    pushed: Tensor
    shared_misfit: Tensor

    @classmethod
    def without_tractions(cls, x: Tensor, pressure: Tensor, volume: Tensor, step: Tensor) -> "Equilibrium":
        """A surface `x [..., V, 3]` on every ray, with its `pressure`, `volume` and last `step` over the size, `[...]` each;
        all that tractions tell is zero."""
        none = torch.zeros_like(x)
        zero, still = none[..., 0, 0], none[..., :4, 0]
        return cls(x, pressure, volume, none, step, none[..., 0], zero, still, zero, zero, zero, zero)


class Contacts(NamedTuple):
    """Where something touches, and what that tells: of P = 4 patches, strongest first, NaN-padded.

    indicator  `[B, V]` in 0..1
    points     `[B, P, 3]`, the patches' centroids
    force      `[B, P, 3]`, on the membrane; NaN where no tractions are found, as the slip
    normal     `[B, P, 3]`, mean outward normal of the membrane there
    area       `[B, P]`
    slip       `[B, P]`, shear force over normal force
    curvature  `[B, P, 2]`, principal curvatures of the surface there, positive where the object bulges into the membrane
    at_rim     `[B, P]`, 1 where the patch reaches the rim, else 0
    """

    indicator: Tensor
    points: Tensor
    force: Tensor
    normal: Tensor
    area: Tensor
    slip: Tensor
    curvature: Tensor
    at_rim: Tensor


class Deviations(NamedTuple):
    """Standard deviations: `force [B, 3]`, and `depth [B]` of the deepest displacement along the rest normal."""

    force: Tensor
    depth: Tensor

    @classmethod
    def unknown(cls, found: Equilibrium) -> "Deviations":
        """NaN for every frame."""
        force = torch.full_like(found.vertices[:, 0], torch.nan)
        return cls(force, force[:, 0])


class Estimator(Protocol):
    """From what the markers show to the surface: an `nn.Module` of one sensor, batched and differentiable.

    `finds_tractions`: tractions and standard deviations are found. `element`, `volume`, `flow_kind` and `smoothing_weight` are
    stored beside the results.
    """

    finds_tractions: ClassVar[bool]
    membrane: Membrane
    cavity: CavityLaw

    def prepare(self, camera: Camera, pixels: Tensor, confidence: Tensor, covariance: Tensor) -> Observation:
        """The rays that `forward` needs, from the markers' `pixels [B, D, 2]`, their `confidence [B, D]`, and the `covariance
        [B, D, 2, 2]` of the pixels, px^2."""
        ...

    def __call__(self, observation: Observation) -> Equilibrium:
        """The surface."""
        ...

    def is_converged(self, found: Equilibrium) -> Tensor:
        """`[B]` bool."""
        ...

    def is_explained(self, found: Equilibrium) -> Tensor:
        """`[B]` bool: a surface of this sensor can move as the markers do."""
        ...

    def contacts(self, found: Equilibrium, normals: Tensor) -> Contacts:
        """Where something touches; `normals [B, V, 3]` of the surface found."""
        ...

    def deviations(self, found: Equilibrium, observation: Observation, contacts: Contacts) -> Deviations:
        """How far off force and depth may be."""
        ...
