"""What an estimator is: what it is built from, what it is given, what it finds, and what its class has to say."""

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
from ..surface.membrane import Membrane
from ..surface.projection import SurfacePoints
from .contacts import ContactPatches, Contacts


class Problem(NamedTuple):
    """One sensor, as an estimator is built from it; tensors are in double precision.

    camera           the camera
    membrane         the rest surface on the solver's grid
    elasticity       the elastic energy of the membrane
    filling          of the cavity: "liquid", "gas" or "open"
    gas              of a gas: its absolute pressure at rest, force / length^2, and its volume, length^3; else None
    markers          the markers as points of the rest surface's triangles
    positions        [D, 3]  rest positions of the markers on the surface, length unit
    rest_pixels      [D, 2]  where the camera model sees the markers at rest, px
    vertex_pixels    [V, 2]  where the camera model sees the grid's vertices at rest, px
    rest_covariance  [D, 2, 2]  px^2, noise of the markers' displacements in a frame like the rest image
    rest_confidence  [D]  1 of markers whose rays at rest count, 0 of others; None: all count
    views            W, how many views see the markers: each marker is then listed once for each view, D is all of these, and
                     the camera is a `Rig`
    levers           [D, 3]  from the positions to what the camera sees of the markers at rest; None: they lie on the surface
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

    def cavity_law(self) -> CavityLaw:
        """What the fluid asks of the enclosed volume; the rest pressure is the one that balances the membrane's tension."""
        return CavityLaw(self.membrane, rest_balance(self.membrane, self.elasticity)[0], self.filling, self.gas)


class Observation(NamedTuple):
    """Measured rays of a batch, of the markers or of the grid's vertices, as an estimator's `prepare` makes them.

    origins     [B, N, 3]  of the rays, length unit
    directions  [B, N, 3]  of the rays, unit vectors
    confidence  [B, D]  of the markers, 0 for a lost one, else up to 1
    across      [B, N, 2, 3]  two vectors across each ray: the ray's turn along them counts in standard deviations of its
                marker; None: all rays are as sure in all directions
    motion      [B, N, 2, 4 W]  by how much of these a moved camera turns the ray, as `marker_residuals.marker_rays` gives it;
                None: the camera has not moved
    gauge       [B, 2]  what a pressure gauge reads, as `pressure_gauge.gauge_reading` gives it; None: there is no gauge
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
    """What an estimator finds in a batch. An estimator that finds no tractions makes one by `without_tractions`.

    vertices       [B, V, 3]  the surface, length unit, camera frame
    pressure       [B]  pressure difference across the membrane, force / length^2
    volume         [B]  under the surface, length^3
    traction       [B, V, 3]  contact force per rest area; zero where none is found, as all below but `relative_step`
    relative_step  [B]  the solve's last step over the surface's size
    reference      [B, V]  the traction that pushes are measured against
    misfit         [B]  rms of the angles between markers and their rays, in standard deviations
    moved          [B, 4 W]  motion of each of the W views' cameras against the rim
    objective      [B]  what the solve minimises, over the number of markers seen
    unexplained    [B]  the part of it that no push explains: misfit, pulls and shear
    pushed         [B]  share of the surface that something pushes
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
    pushed: Tensor
    shared_misfit: Tensor

    @classmethod
    def without_tractions(cls, x: Tensor, pressure: Tensor, volume: Tensor, step: Tensor) -> "Equilibrium":
        """Of an estimator that finds no tractions: all that they tell is zero.

        Args:
            x: the surface, `[..., V, 3]`.
            pressure: `[...]`.
            volume: `[...]`.
            step: the last step over the surface's size, `[...]`; zero where nothing is iterated.
        """
        none = torch.zeros_like(x)
        zero, still = none[..., 0, 0], none[..., :4, 0]
        return cls(x, pressure, volume, none, step, none[..., 0], zero, still, zero, zero, zero, zero)


class Deviations(NamedTuple):
    """Standard deviations that are reported with every frame; NaN where they are not known.

    force  [B, 3]  of the total force
    depth  [B]  of the deepest displacement along the rest normal, length unit
    """

    force: Tensor
    depth: Tensor

    @classmethod
    def unknown(cls, found: Equilibrium) -> "Deviations":
        """NaN for every frame."""
        force = torch.full_like(found.vertices[:, 0], torch.nan)
        return cls(force, force[:, 0])

    def calibrated(self, force: Tensor, uncertainty: float | None) -> "Deviations":
        """With that of the scale of all forces, relative, by the calibration of the material; None: not known.

        Args:
            force: `[B, 3]`, as found.
            uncertainty: as in the sensor's record.
        """
        return self._replace(force=torch.hypot(self.force, uncertainty * force)) if uncertainty else self


class StandardDeviations(NamedTuple):
    """Of `vertices [B, V, 3]` (zero where fixed), total `force [B, 3]` and `pressure [B]`."""

    vertices: Tensor
    force: Tensor
    pressure: Tensor

    def known(self, frames: Tensor) -> "StandardDeviations":
        """The same, NaN but in `frames [B]`, bool."""
        rows = ((value, frames.reshape(-1, *(1,) * (value.ndim - 1))) for value in self)
        return StandardDeviations(*(torch.where(row, value, torch.nan) for value, row in rows))


class Estimator(nn.Module, ABC):
    """From what the markers of a sensor show to its surface: the base of every estimator, also of your own.

    A subclass defines `Settings`, `from_problem`, `prepare`, `forward` and `is_converged`; everything else has a default. It
    works on batches and is differentiable. Tensors of the sensor are buffers, in double precision when it is built, so that
    they change precision and device with the module; a `state_dict` leaves them out, as they are rebuilt from the sensor, and
    keeps parameters.

    Args:
        membrane: the rest surface on the solver's grid.
        cavity: what the fluid asks of the volume; of a problem, `problem.cavity_law()`.
        settings: default: those of `Settings()`.
        spacing: spacing of the markers, length unit, where it limits what is known of contacts.

    Attributes:
        Settings: a frozen dataclass, of which every field has a default.
        default_locator: how markers are found in images where nothing else is asked for: "fit" or "soft".
        needs_every_vertex: whether every vertex of the grid must be seen by the camera at rest; a sensor of which that is not
            true is refused.
        finds_tractions: whether `forward` finds tractions, and with them forces.
        takes_views: whether it can be given several views, as of `Problem.views`; refused otherwise.
        takes_heights: whether it can be given markers that stand off the surface, as of `Problem.levers`; refused otherwise.
        in_parts: whether `forward` is put together of methods marked `control_flow.traced`; an exported model holds any other
            `forward` as one part, which must consist of torch operations that ONNX has.
        name: the one by which it was asked for; set by `Reconstructor`.

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
        """The estimator of a sensor; `settings`: an instance of `Settings`, None: its defaults."""

    @abstractmethod
    def prepare(self, camera: Any, pixels: Tensor, confidence: Tensor, covariance: Tensor) -> Observation:
        """The rays that `forward` needs.

        Args:
            camera: the sensor's `Camera`; of several views a `Rig`.
            pixels: pixels of the markers, `[B, D, 2]`; those of a lost one mean nothing.
            confidence: confidence of the markers, `[B, D]`, 0 for a lost one.
            covariance: covariance of the pixels, `[B, D, 2, 2]` px^2, with the model's own error.
        """

    @abstractmethod
    def forward(self, observation: Observation) -> Equilibrium:
        """The surface."""

    @abstractmethod
    def is_converged(self, found: Equilibrium) -> Tensor:
        """Which frames' solutions are final, `[B]` bool; the others get the status `NOT_CONVERGED`."""

    @property
    def rest_pressure(self) -> Tensor:
        """Pressure difference across the membrane at rest, `[]`, force / length^2."""
        return self.cavity.rest_pressure

    @property
    def must_compile(self) -> bool:
        """Whether the first frame waits for machine code to be compiled; default: no."""
        return False

    @property
    def solves_in_double(self) -> bool:
        """Whether this sensor must be solved in double precision, whatever the results are in; default: no."""
        return False

    def is_explained(self, found: Equilibrium) -> Tensor:
        """Which frames' markers move as a surface of this sensor can, `[B]` bool; the others get the status `UNEXPLAINED`.
        Default: all."""
        return ~found.misfit.isnan()

    def contacts(self, found: Equilibrium, normals: Tensor) -> Contacts:
        """Where something touches; default: where the surface lies inside the rest surface (section 5.1).

        Args:
            found: by `forward`.
            normals: normals of the surface, outward unit vectors `[B, V, 3]`.
        """
        return self.patches.bulges(found.vertices, normals, found.traction if self.finds_tractions else None)

    def deviations(self, found: Equilibrium, observation: Observation, contacts: Contacts) -> Deviations:
        """How far off force and depth may be; default: not known, NaN."""
        return Deviations.unknown(found)

    def check_gauge(self) -> None:
        """Refuse a measured pressure where it tells this estimator nothing; default: always.

        Raises:
            MembraneError: a measured pressure tells nothing.
        """
        raise self._without("pressure for")

    def gauged(self, observation: Observation, pressure: Tensor | float) -> Observation:
        """The observation with the pressure that a gauge reads, `[B]` or `[]`, NaN where there is no reading; default: refused.

        Raises:
            MembraneError: as of `check_gauge`, or a pressure of another shape.
        """
        raise self._without("pressure for")

    def standard_deviations(
        self, x: Tensor, pressure: Tensor, moved: Tensor, observation: Observation, marker_noise: Tensor
    ) -> StandardDeviations:
        """Standard deviations that the markers' noise causes in a solution; default: refused.

        Args:
            x: the surface found, `[B, V, 3]`.
            pressure: found, `[B]`.
            moved: motion of the cameras found, `[B, 4 W]`.
            observation: that it was found from.
            marker_noise: `[B, D, 2, 3]`, how noise in each of two independent directions turns the markers' rays.

        Raises:
            MembraneError: this estimator knows none.
        """
        raise self._without("standard deviations of")

    def _without(self, what: str) -> MembraneError:
        return MembraneError(f"Reconstructor: {what} {self.name}; expected estimator = 'force-balance'")

    @property
    def element(self) -> str:
        """The finite element, as `mesh.npz` names it; default: that of the settings, else "triangle"."""
        return str(getattr(self.settings, "element", "triangle"))

    @property
    def volume(self) -> str:
        """Name of the volume constraint in `mesh.npz`; default: that of the settings, or "exact"."""
        return str(getattr(self.settings, "volume", "exact"))

    @property
    def flow_kind(self) -> str:
        """The flow between the markers, as `mesh.npz` names it; default: that of the settings, else "smooth"."""
        return str(getattr(self.settings, "flow", "smooth"))

    @property
    def smoothing_weight(self) -> float:
        """The smoother's weight, as `mesh.npz` has it; default: that of the settings, else 0."""
        return float(getattr(self.settings, "smoothing", 0.0))
