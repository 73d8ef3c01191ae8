"""A sensor's whole reconstruction, image to result, as one ONNX file: `torchmembrane export`.

The graph is put together from pieces traced once each: observe, rays, start, step, equilibrium, result.
"""

import json
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper
from torch import Tensor, nn

from ..errors import MembraneError
from ..estimators.base import Equilibrium, Observation
from ..estimators.force_balance import ForceBalance
from ..estimators.minimum_energy import STEPS
from ..io.results import STATUS_TEXTS, Reconstruction
from ..io.store import Mesh, Settings
from ..markers.dots.deformation import WIDTHS, LocalDeformation
from ..markers.dots.locator import DotLocator
from ..markers.dots.match import SETTLING, DotMatcher
from ..markers.dots.pyramid import LEVELS
from ..mechanics.cavity import Equilibrium
from ..reconstruct import Reconstructor
from ..solve.block_tridiagonal import parts
from .graph import Assembly, traced

FORMAT = 1
PREVIOUS = ("previous_vertices", "previous_pressure", "previous_pixels")
EXAMPLES = 2  # frames with which a piece is traced; the batch stays free


class Piece(nn.Module):
    """A function of tensors, with the module whose buffers it uses."""

    def __init__(self, owner: nn.Module, function: Callable):
        super().__init__()
        self.owner, self.function = owner, function

    def forward(self, *tensors: Tensor):
        return self.function(self.owner, *tensors)


class Tracer:
    """Pieces appended to an `Assembly` one after another; every value has a name there and an example to trace with."""

    def __init__(self):
        self.assembly, self.examples, self.names, self.traced = Assembly(), {}, {}, {}

    def given(self, name: str, example: Tensor) -> None:
        self.examples[name], self.names[name] = example, name

    def piece(self, owner: nn.Module, function: Callable, inputs: list[str], outputs: list[str]) -> None:
        """Append `function(owner, *inputs)`; outputs replace values of the same name."""
        model, values = self._trace(owner, function, inputs, outputs)
        names = self.assembly.append(model, {name: self.names[name] for name in inputs})
        self._keep(outputs, names, values)

    def steps(self, owner: nn.Module, function: Callable, state: list[str], given: list[str], count: int, **tables) -> None:
        """Append a loop of `state = function(owner, *state, *given, *rows)`; `tables` hold a row for each of the steps."""
        self.examples |= {name: torch.as_tensor(table[0]) for name, table in tables.items()}
        model, values = self._trace(owner, function, [*state, *given, *tables], state)
        names = {name: self.names[name] for name in [*state, *given]}
        self._keep(state, self.assembly.repeat(model, names, count, tables), values)

    @contextmanager
    def unless(self, condition: str, names: list[str]):
        """What is appended inside runs only where `condition`, a bool, is false; it gives `names` other values."""
        names = {name: self.names[name] for name in names}
        with self.assembly.unless(self.names[condition], names):
            yield
            names |= {name: self.names[name] for name in names}
        self.names |= names

    def constant(self, name: str, value: float) -> None:
        self.examples[name], self.names[name] = torch.tensor(value), self.assembly.constant(np.array(value, np.float32))

    def alias(self, names: list[str], known: list[str]) -> None:
        """Further names of values."""
        self._keep(names, {name: self.names[name] for name in known}, [self.examples[name] for name in known])

    def _trace(self, owner, function, inputs, outputs):
        examples = {name: self.examples[name].clone() for name in inputs}  # one tensor twice would be traced as one input
        with torch.no_grad():
            values = function(owner, *examples.values())
        key = (owner, function, *inputs)
        if key not in self.traced:
            self.traced[key] = traced(Piece(owner, function), examples, [f"next {name}" for name in outputs])
        return self.traced[key], values

    def _keep(self, outputs, names, values) -> None:
        self.names |= dict(zip(outputs, names.values(), strict=True))
        self.examples |= dict(zip(outputs, values, strict=True))


def export(reconstructor: Reconstructor, path: str | Path, settings: Settings, tracking: bool = False) -> onnx.ModelProto:
    """Write the reconstructor as one ONNX model to `path`; returns it.

    Input `image [batch, 1, height, width]`, grey in 0..1; outputs as `Reconstruction`. With `tracking` (force balance) also
    `previous_vertices [batch, V, 3]`, `previous_pressure [batch]` and, of dots, `previous_pixels [batch, D, 2]`: outputs of the
    frames before, NaN to start from rest.
    Metadata: `format`, `status_texts` and `mesh` (the fields of `Mesh`), JSON. Standard operators only; float32.
    """
    if tracking and not reconstructor.finds_contacts:
        raise MembraneError("export: minimum-energy starts from rest always; expected force-balance for tracking")
    width, height = reconstructor.image_size
    tracer = Tracer()
    image = torch.rand(EXAMPLES, 1, height, width, generator=torch.Generator().manual_seed(0))
    tracer.given("image", image.to(reconstructor.rest_pixels))
    if tracking:
        rest = *reconstructor.estimator.at_rest(image), reconstructor.rest_pixels.repeat(EXAMPLES, 1, 1)
        for name, value in zip(PREVIOUS, rest, strict=True):
            if name in previous_of(reconstructor):
                tracer.given(name, value)
    tracer.assembly.part = "markers"
    tracer.piece(reconstructor, _check, ["image"], ["status"])
    if not reconstructor.follows:
        tracer.piece(reconstructor.locator, type(reconstructor.locator).forward, ["image"], ["pixels", "confidence"])
    else:
        if tracking:
            tracer.piece(reconstructor, _located, [PREVIOUS[2]], ["dots before"])
        dots(tracer, reconstructor.locator, tracking)
    tracer.piece(reconstructor, Reconstructor.seen, ["pixels", "confidence", "status"], ["displacement", "confidence"])
    tracer.assembly.part = "assembly"
    seen = ["displacement", "confidence", "status"]
    tracer.piece(reconstructor, Reconstructor.judge, seen, ["usable", "confidence", "status"])
    tracer.piece(reconstructor, Reconstructor.rays, ["usable", "confidence"], ["origins", "directions"])
    tracer.assembly.part = "solve"
    if tracking:
        tracer.piece(reconstructor, Reconstructor.start, list(PREVIOUS[:2]), ["surface", "pressure"])
        track(tracer, reconstructor.estimator)
    elif reconstructor.finds_contacts:
        force_balance(tracer, reconstructor.estimator)
    else:
        minimum_energy(tracer, reconstructor.estimator)
    tracer.assembly.part = "assembly"
    tracer.piece(reconstructor, _result, [*Equilibrium._fields, *seen], list(Reconstruction._fields))
    model = _finished(tracer, reconstructor, settings)
    onnx.save(model, path)
    return model


def previous_of(reconstructor: Reconstructor) -> tuple[str, ...]:
    """A tracking model's further inputs: `previous_` and the field of `Reconstruction` that they continue."""
    return PREVIOUS if reconstructor.follows else PREVIOUS[:2]


def dots(tracer: Tracer, locator: DotLocator, tracking: bool) -> None:
    """From `image`, and `dots before` where tracking, to `pixels` and `confidence`."""
    match = locator.match
    levels, blobs = [f"level {k}" for k in range(LEVELS)], ["blobs", "log radius", "valid"]
    tracer.piece(locator, DotLocator.begin, ["image"], [*levels, *blobs])
    state, placed = ["weight", "flow", "strain"], ["place", "certainty", "dot strain"]
    before = ["dots before"] if tracking else []
    tracer.piece(match, DotMatcher.follow, [*blobs, *before], [*state, "kept"])
    tracer.alias([f"followed {name}" for name in state], state)
    tracer.piece(match, _all, ["kept"], ["all kept"])
    with tracer.unless("all kept", state):
        search(tracer, match, state, blobs)
        tracer.piece(match, DotMatcher.either, ["kept", *(f"followed {name}" for name in state), *state], state)
    tracer.piece(match, DotMatcher.end, state, placed)
    tracer.piece(locator, DotLocator.end, [*levels, *blobs, *placed], ["pixels", "confidence"])


def search(tracer: Tracer, match: DotMatcher, state: list[str], blobs: list[str]) -> None:
    """As `DotMatcher.search`."""
    scene, known = ["around", "away", "beside", "nearby"], ["known", "base"]
    tracer.piece(match.deformation, LocalDeformation.begin, ["blobs", "valid"], ["deformation", *scene])
    widths = np.array(WIDTHS, np.float32)
    tracer.steps(match.deformation, LocalDeformation.refine, ["deformation"], [*scene, "valid"], len(widths), width=widths)
    tracer.piece(match, DotMatcher.scene, ["deformation", *blobs], known)
    tracer.piece(match, DotMatcher.begin, known, [*known, *state])
    tracer.steps(match, DotMatcher.grow, state, known, match.steps)
    tracer.steps(match, DotMatcher.settle, state, known, SETTLING)
    tracer.piece(match, DotMatcher.best, state, state)


def _all(_, kept):
    return (kept.all(),)


def _located(reconstructor, pixels):
    return (reconstructor.located(pixels),)


def _check(reconstructor, image):
    return (reconstructor.check(image),)


def minimum_energy(tracer: Tracer, estimator) -> None:
    """From `origins` and `directions` to the fields of `Equilibrium`."""
    kind = type(estimator)
    rays, state = ["origins", "directions"], ["range", "latest", "changes"]
    tracer.piece(estimator, kind.start, rays, [*state, *rays])
    for _ in range((estimator.steps or STEPS) - 1):
        tracer.piece(estimator, kind.step, [*state, *rays], state)
    tracer.piece(estimator, kind.equilibrium, ["range", *rays], list(Equilibrium._fields))


def force_balance(tracer: Tracer, estimator: ForceBalance) -> None:
    """From `origins`, `directions` and `confidence` to the fields of `Equilibrium`, from rest, the coarser grid first."""
    if estimator.coarse is None:
        tracer.piece(estimator, ForceBalance.at_rest, ["confidence"], ["surface", "pressure"])
    else:
        force_balance(tracer, estimator.coarse)
        tracer.piece(estimator, ForceBalance.refined, ["vertices", "pressure"], ["surface", "pressure"])
    descend(tracer, estimator, estimator.falls())


def track(tracer: Tracer, estimator: ForceBalance) -> None:
    """As `force_balance`, from `surface` and `pressure` of the frames before."""
    if estimator.passes_on_starts:
        tracer.piece(estimator, ForceBalance.coarsened, ["surface", "pressure"], ["surface", "pressure"])
        track(tracer, estimator.coarse)
        tracer.piece(estimator, ForceBalance.refined, ["vertices", "pressure"], ["surface", "pressure"])
        descend(tracer, estimator, estimator.falls(warm=True))
    else:
        descend(tracer, estimator, estimator.falls(warm=True), one_factor=True)


def descend(tracer: Tracer, estimator: ForceBalance, falls: list[tuple[float, float]], one_factor=False) -> None:
    """The steps of a schedule from `surface` and `pressure`; `one_factor`: all with that of the first."""
    seen, state = ["marker origins", "across", "weight"], ["surface", "pressure", "before"]
    tracer.piece(estimator, ForceBalance.observation, ["origins", "directions", "confidence"], seen)
    tracer.alias(["before"], ["surface"])
    if one_factor:
        for name, value in zip(("tau", "outlier"), falls[0], strict=True):
            tracer.constant(name, value)
        factor = [f"factor {k}" for k in range(2 * len(parts(estimator.system.blocks)))]
        tracer.piece(estimator, _first_step, [*state, *seen, "tau", "outlier"], [*state, *factor])
        seen, falls = [*seen, *factor], falls[1:]
    tau, outlier = np.array(falls, np.float32).T.copy()
    tracer.steps(estimator, _step, state, seen, len(falls), tau=tau, outlier=outlier)
    tracer.piece(estimator, ForceBalance.equilibrium, state, list(Equilibrium._fields))


def _step(estimator, surface, pressure, before, origins, across, weight, *factor_and_scales):
    *factor, tau, outlier = factor_and_scales
    seen = Observation(origins, across, weight)
    return *estimator.step(surface, pressure, seen, tau, outlier, factor or None)[:2], surface


def _first_step(estimator, surface, pressure, before, origins, across, weight, tau, outlier):
    x, pressure, factor = estimator.step(surface, pressure, Observation(origins, across, weight), tau, outlier)
    return x, pressure, surface, *factor


def _result(reconstructor, vertices, pressure, volume, traction, relative_step, displacement, confidence, status):
    equilibrium = Equilibrium(vertices, pressure, volume, traction, relative_step)
    return tuple(reconstructor.result(equilibrium, displacement, confidence, status))


def _finished(tracer: Tracer, reconstructor: Reconstructor, settings: Settings) -> onnx.ModelProto:
    width, height = reconstructor.image_size
    inputs = [helper.make_tensor_value_info("image", TensorProto.FLOAT, ["batch", 1, height, width])]
    for name in PREVIOUS:
        if name in tracer.names:
            shape = ["batch", *tracer.examples[name].shape[1:]]
            inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
    outputs = []
    for name in Reconstruction._fields:
        tracer.assembly.named(tracer.names[name], name)
        kind = TensorProto.INT32 if name == "status" else TensorProto.FLOAT
        outputs.append(helper.make_tensor_value_info(name, kind, ["batch", *tracer.examples[name].shape[1:]]))
    mesh = Mesh.of(reconstructor, settings)._asdict()
    plain = {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in mesh.items()}
    texts = {str(code): text for code, text in STATUS_TEXTS.items()}
    metadata = {"format": str(FORMAT), "name": mesh["name"], "length_unit": mesh["length_unit"]}
    metadata |= {"force_unit": mesh["force_unit"], "status_texts": json.dumps(texts), "mesh": json.dumps(plain)}
    return tracer.assembly.model(inputs, outputs, metadata)
