"""The base class of estimators, what they are built from (`Problem`), what they take (`Observation`) and return
(`Equilibrium`)."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor, nn

from ..camera.model import Camera
from ..camera.rig import Rig
from ..control_flow import traced
from ..errors import MembraneError
from ..mechanics.cavity import CavityLaw, rest_balance
from ..mechanics.hyperelastic import ElasticEnergy
from ..sensor.parts import FRICTION
from ..surface.membrane import Membrane
from ..surface.projection import SurfacePoints
from .contacts import ContactPatches, Contacts


class Problem(NamedTuple):
    """Description of a sensor from which an estimator is built; tensors are in double precision.

    camera           the camera; a `Rig` if there are several views
    membrane         the rest surface on the solver's grid
    elasticity       the elastic energy of the membrane
    filling          filling of the cavity: "liquid", "gas" or "open"
    gas              absolute pressure at rest, force / length^2, and volume, length^3, of a gas; else None
    markers          the markers as points on the rest surface's triangles
    positions        [D, 3]  rest positions of the markers on the surface, length unit
    rest_pixels      [D, 2]  pixels of the markers at rest according to the camera model
    vertex_pixels    [V, 2]  pixels of the grid's vertices at rest according to the camera model
    rest_covariance  [D, 2, 2]  covariance of the markers' measured displacements in a frame like the rest image, px^2
    rest_confidence  [D]  1 for markers whose rays at rest are used, 0 for others; None: all are used
    views            W, the number of views that see the markers; each marker is listed once for each view, and D counts all
    levers           [D, 3]  vectors from the positions to the visible points of the markers at rest; None: they coincide
    friction         coefficient of friction between the membrane and what touches it
    """

    camera: Camera | Rig
    membrane: Membrane
    elasticity: ElasticEnergy
    filling: str
    gas: tuple[float, float] | None
    markers: SurfacePoints
    positions: Tensor
    rest_pixels: Tensor
    vertex_pixels: Tensor
    rest_covariance: Tensor
    rest_confidence: Tensor | None = None
    views: int = 1
    levers: Tensor | None = None
    friction: float = FRICTION

    def cavity_law(self) -> CavityLaw:
        """Return the law of the cavity's filling; the rest pressure balances the membrane's tension."""
        return CavityLaw(self.membrane, rest_balance(self.membrane, self.elasticity)[0], self.filling, self.gas)


class Observation(NamedTuple):
    """Measured rays of a batch, of the markers or of the grid's vertices, from an estimator's `prepare`.

    origins     [B, N, 3]  origins of the rays, length unit
    directions  [B, N, 3]  unit directions of the rays
    confidence  [B, D]  confidence of the markers, 0 for a lost one, else up to 1
    across      [B, N, 2, 3]  two vectors orthogonal to each ray, scaled such that angles along them are in standard deviations
                of the marker; None: the noise is the same for all rays and directions
    motion      [B, N, 2, 4 W]  derivatives of these angles with respect to camera motion, from `marker_residuals.marker_rays`;
                None: the camera has not moved
    gauge       [B, 2]  reading of a pressure gauge, from `pressure_gauge.gauge_reading`; None: there is no gauge
    """

    origins: Tensor
    directions: Tensor
    confidence: Tensor
    across: Tensor | None = None
    motion: Tensor | None = None
    gauge: Tensor | None = None

    def to(self, dtype: torch.dtype) -> "Observation":
        """Return the observation in another precision."""
        return self._replace(**{name: value.to(dtype) for name, value in self._asdict().items() if value is not None})


class Equilibrium(NamedTuple):
    """Solution of an estimator for a batch. An estimator without tractions builds it by `without_tractions`.

    vertices       [B, V, 3]  the surface, length unit, camera frame
    pressure       [B]  pressure difference across the membrane, force / length^2
    volume         [B]  volume under the surface, length^3
    traction       [B, V, 3]  contact force per rest area; zero without tractions, like all following fields but `relative_step`
    relative_step  [B]  last step of the solver, relative to the surface's size
    reference      [B, V]  traction with which a vertex's compressive traction is compared
    misfit         [B]  rms of the angles between markers and their rays, in standard deviations
    moved          [B, 4 W]  motion of the camera of each of the W views relative to the rim
    objective      [B]  value of the objective function, per marker seen
    unexplained    [B]  the objective without the normal-compression term: misfit, normal tension and shear
    shared_misfit  [B]  the part of the misfit that neighbouring markers have in common
    """

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
    shared_misfit: Tensor

    @classmethod
    def without_tractions(cls, x: Tensor, pressure: Tensor, volume: Tensor, step: Tensor) -> "Equilibrium":
        """Return a solution without tractions: all fields that depend on them are zero.

        Args:
            x: the surface, `[..., V, 3]`.
            pressure: pressure difference across the membrane, `[...]`.
            volume: volume under the surface, `[...]`.
            step: last step relative to the surface's size, `[...]`; zero if the estimator does not iterate.
        """
        none = torch.zeros_like(x)
        zero, still = none[..., 0, 0], none[..., :4, 0]
        return cls(x, pressure, volume, none, step, none[..., 0], zero, still, zero, zero, zero)


class Deviations(NamedTuple):
    """Standard deviations that are reported with every frame; NaN where they are not known.

    force  [B, 3]  standard deviation of the total force
    depth  [B]  standard deviation of the largest displacement along the inward rest normal, length unit
    """

    force: Tensor
    depth: Tensor

    @classmethod
    def unknown(cls, found: Equilibrium) -> "Deviations":
        """Return NaN for every frame."""
        force = torch.full_like(found.vertices[:, 0], torch.nan)
        return cls(force, force[:, 0])

    def calibrated(self, force: Tensor, uncertainty: float | None) -> "Deviations":
        """Return the deviations with the uncertainty of the material's calibration added to that of the force.

        Args:
            force: total force found, `[B, 3]`.
            uncertainty: relative uncertainty of the scale of all forces, from the sensor's record; None: not known.
        """
        return self._replace(force=torch.hypot(self.force, uncertainty * force)) if uncertainty else self


class StandardDeviations(NamedTuple):
    """Standard deviations of the `vertices [B, V, 3]` (zero where fixed), total `force [B, 3]` and `pressure [B]`."""

    vertices: Tensor
    force: Tensor
    pressure: Tensor

    def known(self, frames: Tensor) -> "StandardDeviations":
        """Return the standard deviations, with NaN for every frame that is False in the mask `frames [B]`."""
        rows = ((value, frames.reshape(-1, *(1,) * (value.ndim - 1))) for value in self)
        return StandardDeviations(*(torch.where(row, value, torch.nan) for value, row in rows))


class Estimator(nn.Module, ABC):
    """Base class of estimators, which reconstruct the surface of a sensor from its markers. Subclass it to write your own.

    A subclass defines `Settings`, `from_problem`, `prepare`, `forward` and `is_converged`; everything else has a default. It
    works on batches and is differentiable. The sensor's tensors are buffers, in double precision when it is built, so that they
    change precision and device with the module. A `state_dict` contains parameters, but not these buffers, because they are
    rebuilt from the sensor.

    Args:
        membrane: the rest surface on the solver's grid.
        cavity: law of the cavity's filling, such as `problem.cavity_law()`.
        settings: settings of the estimator; default `Settings()`.
        spacing: spacing of the markers, length unit, if it limits the resolution of contacts.

    Attributes:
        Settings: a frozen dataclass whose fields all have defaults.
        default_locator: locator of markers in images if none is chosen: "fit" or "soft".
        needs_every_vertex: whether the camera must see every vertex of the grid at rest; other sensors are refused.
        finds_tractions: whether `forward` finds tractions, and with them forces.
        takes_views: whether it accepts several views (`Problem.views`).
        takes_heights: whether it accepts markers at a distance from the surface (`Problem.levers`).
        in_parts: whether `forward` is composed of methods marked `control_flow.traced`. Any other `forward` is exported as one
            part, which must consist of torch operations that ONNX supports.
        name: name by which the estimator was chosen; `Reconstructor` sets it.

    Example:
        >>> from dataclasses import dataclass
        >>> import torchmembrane as tm
        >>> @dataclass(frozen=True)
        ... class NoSettings:
        ...     pass
        >>> class AlwaysAtRest(tm.Estimator):
        ...     Settings = NoSettings
        ...     @classmethod
        ...     def from_problem(cls, problem, settings=None):
        ...         return cls(problem.membrane, problem.cavity_law(), settings)
        ...     def prepare(self, camera, pixels, confidence, covariance):
        ...         return tm.Observation(*camera.pixel_to_ray(pixels), confidence)
        ...     def forward(self, observation):
        ...         frames = len(observation.confidence)
        ...         x, pressure = self.membrane.rest.repeat(frames, 1, 1), self.rest_pressure.expand(frames)
        ...         return tm.Equilibrium.without_tractions(x, pressure, self.membrane.volume(x), 0 * pressure)
        ...     def is_converged(self, found):
        ...         return found.relative_step == 0
        >>> reconstructor = tm.Reconstructor(tm.preset("bubble"), AlwaysAtRest)
        >>> result = reconstructor.from_pixels(reconstructor.rest_pixels)
        >>> int(result.status[0]), float(result.displacement.abs().max())
        (0, 0.0)
    """

    Settings: ClassVar[type[Any]]
    default_locator: ClassVar[str] = "fit"
    needs_every_vertex: ClassVar[bool] = True
    finds_tractions: ClassVar[bool] = False
    in_parts: ClassVar[bool] = False
    takes_views: ClassVar[bool] = False
    takes_heights: ClassVar[bool] = False
    name: str = ""

    def __init__(self, membrane: Membrane, cavity: CavityLaw, settings: Any = None, spacing: float = 0.0):
        super().__init__()
        self.membrane, self.cavity, self.settings = membrane, cavity, settings or type(self).Settings()
        self.patches = ContactPatches(membrane, spacing)

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "forward" in vars(cls) and not cls.in_parts:
            cls.forward = traced(cls.forward)  # type: ignore[method-assign]

    @classmethod
    @abstractmethod
    def from_problem(cls, problem: Problem, settings: Any = None) -> Self:
        """Build the estimator for a sensor; `settings` is an instance of `Settings`, or None for the defaults."""

    @abstractmethod
    def prepare(self, camera: Any, pixels: Tensor, confidence: Tensor, covariance: Tensor) -> Observation:
        """Return the rays that `forward` needs.

        Args:
            camera: the sensor's `Camera`, or a `Rig` of several views.
            pixels: pixels of the markers, `[B, D, 2]`; those of lost markers are arbitrary.
            confidence: confidence of the markers, `[B, D]`, 0 for a lost one.
            covariance: covariance of the pixels including the model's own error, `[B, D, 2, 2]` px^2.
        """

    @abstractmethod
    def forward(self, observation: Observation) -> Equilibrium:
        """Reconstruct the surface."""

    @abstractmethod
    def is_converged(self, found: Equilibrium) -> Tensor:
        """Return which frames have converged, `[B]` bool; the others get the status `NOT_CONVERGED`."""

    @property
    def rest_pressure(self) -> Tensor:
        """Pressure difference across the membrane at rest, `[]`, force / length^2."""
        return self.cavity.rest_pressure

    @property
    def must_compile(self) -> bool:
        """Whether the first frame has to wait until machine code is compiled; default: no."""
        return False

    @property
    def solves_in_double(self) -> bool:
        """Whether this sensor must be solved in double precision, whatever the precision of the results; default: no."""
        return False

    def is_explained(self, found: Equilibrium) -> Tensor:
        """Return in which frames a surface of this sensor explains the markers, `[B]` bool; default: all without NaN.

        The other frames get the status `UNEXPLAINED`.
        """
        return ~found.misfit.isnan()

    def contacts(self, found: Equilibrium, normals: Tensor) -> Contacts:
        """Return the contacts; default: where the surface lies inside the rest surface (section 5.1).

        Args:
            found: result of `forward`.
            normals: outward unit normals of the surface, `[B, V, 3]`.
        """
        return self.patches.bulges(found.vertices, normals, found.traction if self.finds_tractions else None)

    def deviations(self, found: Equilibrium, observation: Observation, contacts: Contacts) -> Deviations:
        """Return the standard deviations of force and depth; default: unknown, NaN."""
        return Deviations.unknown(found)

    def check_gauge(self) -> None:
        """Refuse a measured pressure if this estimator cannot use it; default: always.

        Raises:
            MembraneError: a measured pressure is of no use.
        """
        raise self._without("use for a measured pressure")

    def gauged(self, observation: Observation, pressure: Tensor | float) -> Observation:
        """Add the pressure read by a gauge to the observation, `[B]` or `[]`, NaN without a reading; default: refused.

        Raises:
            MembraneError: as for `check_gauge`, or the pressure has another shape.
        """
        raise self._without("use for a measured pressure")

    def standard_deviations(
        self, x: Tensor, pressure: Tensor, moved: Tensor, observation: Observation, marker_noise: Tensor
    ) -> StandardDeviations:
        """Return the standard deviations of a solution due to the markers' noise; default: refused.

        Args:
            x: the surface found, `[B, V, 3]`.
            pressure: the pressure found, `[B]`.
            moved: the camera motions found, `[B, 4 W]`.
            observation: the rays that the solution was found from.
            marker_noise: changes of the rays' directions due to two independent components of noise, `[B, D, 2, 3]`.

        Raises:
            MembraneError: this estimator has no standard deviations.
        """
        raise self._without("standard deviations")

    def _without(self, what: str) -> MembraneError:
        return MembraneError(f"Reconstructor: the estimator {self.name} has no {what}; expected estimator = 'force-balance'")

    @property
    def element(self) -> str:
        """Name of the finite element in `mesh.npz`; default: that of the settings, else "triangle"."""
        return str(getattr(self.settings, "element", "triangle"))

    @property
    def volume(self) -> str:
        """Name of the volume constraint in `mesh.npz`; default: that of the settings, else "exact"."""
        return str(getattr(self.settings, "volume", "exact"))

    @property
    def flow_kind(self) -> str:
        """Name of the flow interpolation between the markers in `mesh.npz`; default: that of the settings, else "smooth"."""
        return str(getattr(self.settings, "flow", "smooth"))

    @property
    def smoothing_weight(self) -> float:
        """Weight of the smoother in `mesh.npz`; default: that of the settings, else 0."""
        return float(getattr(self.settings, "smoothing", 0.0))
