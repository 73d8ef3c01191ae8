"""A sensor's whole reconstruction, image to result, as one ONNX file: `torchmembrane export`.

The graph is put together from pieces traced once each: observe, rays, start, step, equilibrium, result.
"""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper
from torch import Tensor, nn

from .assembly import Assembly, traced
from .cavity import Equilibrium
from .force_balance import DENTS, EPS, FALL, Balance, Observation, _across
from .markers.locate import LEVELS, DotLocator
from .markers.match import SETTLING, WIDTHS, DotMatcher, LocalDeformation
from .reconstruct import Reconstructor
from .results import STATUS_TEXTS, Reconstruction
from .store import Mesh, Settings

FORMAT = 1
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

    def alias(self, names: list[str], known: list[str]) -> None:
        """Further names of values."""
        self._keep(names, {name: self.names[name] for name in known}, [self.examples[name] for name in known])

    def _trace(self, owner, function, inputs, outputs):
        examples = {name: self.examples[name].clone() for name in inputs}  # one tensor twice would be traced as one input
        with torch.no_grad():
            values = function(owner, *examples.values())
        key = (function, *inputs)
        if key not in self.traced:
            self.traced[key] = traced(Piece(owner, function), examples, [f"next {name}" for name in outputs])
        return self.traced[key], values

    def _keep(self, outputs, names, values) -> None:
        self.names |= dict(zip(outputs, names.values(), strict=True))
        self.examples |= dict(zip(outputs, values, strict=True))


def export(reconstructor: Reconstructor, path: str | Path, settings: Settings) -> onnx.ModelProto:
    """Write the reconstructor as one ONNX model to `path`; returns it.

    Input `image [batch, 1, height, width]`, grey in 0..1; outputs as `Reconstruction`. Metadata: `format`, `status_texts` and
    `mesh` (the fields of `Mesh`), JSON. Standard operators only; float32.
    """
    width, height = reconstructor.image_size
    tracer = Tracer()
    image = torch.rand(EXAMPLES, 1, height, width, generator=torch.Generator().manual_seed(0))
    tracer.given("image", image.to(reconstructor.rest_pixels))
    tracer.assembly.part = "markers"
    tracer.piece(reconstructor, Reconstructor.check, ["image"], ["image", "status"])
    locate = dots if isinstance(reconstructor.locator, DotLocator) else texture
    locate(tracer, reconstructor.locator)
    tracer.piece(reconstructor, _displacement, ["pixels"], ["displacement"])
    tracer.assembly.part = "assembly"
    seen = ["displacement", "confidence", "status"]
    tracer.piece(reconstructor, Reconstructor.judge, seen, ["usable", "confidence", "status"])
    tracer.piece(reconstructor, Reconstructor.rays, ["usable", "confidence"], ["origins", "directions"])
    estimate = force_balance if reconstructor.finds_contacts else minimum_energy
    tracer.assembly.part = "solve"
    estimate(tracer, reconstructor.estimator)
    tracer.assembly.part = "assembly"
    tracer.piece(reconstructor, _result, [*Equilibrium._fields, *seen], list(Reconstruction._fields))
    model = _finished(tracer, reconstructor, settings)
    onnx.save(model, path)
    return model


def dots(tracer: Tracer, locator: DotLocator) -> None:
    """From `image` to `pixels` and `confidence`."""
    match, deformation = locator.match, locator.match.deformation
    levels, blobs = [f"level {k}" for k in range(LEVELS)], ["blobs", "log radius", "valid"]
    tracer.piece(locator, DotLocator.begin, ["image"], [*levels, *blobs])
    scene = ["around", "others", "there", "nearby"]
    tracer.piece(deformation, LocalDeformation.begin, ["blobs", "valid"], ["deformation", *scene])
    widths = np.array(WIDTHS, np.float32)
    tracer.steps(deformation, LocalDeformation.refine, ["deformation"], [*scene, "valid"], len(widths), width=widths)
    state, known = ["weight", "flow", "strain"], ["known", "base"]
    tracer.piece(match, DotMatcher.begin, ["deformation", *blobs], [*state, *known])
    tracer.steps(match, DotMatcher.grow, state, known, match.steps)
    tracer.steps(match, DotMatcher.settle, state, known, SETTLING)
    tracer.piece(match, DotMatcher.end, state, ["place", "certainty", "strain"])
    tracer.piece(locator, DotLocator.end, [*levels, *blobs, "place", "certainty", "strain"], ["pixels", "confidence"])


def texture(tracer: Tracer, locator) -> None:
    """From `image` to `pixels` and `confidence`."""
    tracer.piece(locator, type(locator).forward, ["image"], ["pixels", "confidence"])


def _displacement(reconstructor, pixels):
    return (pixels - reconstructor.measured_rest,)


def minimum_energy(tracer: Tracer, estimator) -> None:
    """From `origins` and `directions` to the fields of `Equilibrium`."""
    kind = type(estimator)
    tracer.piece(estimator, kind.start, ["directions"], ["range", "pressure"])
    rays, state = ["origins", "directions"], ["range", "pressure"]
    tracer.steps(estimator, kind.step, state, rays, estimator.steps)
    tracer.piece(estimator, kind.equilibrium, [*state, *rays], list(Equilibrium._fields))


def force_balance(tracer: Tracer, estimator) -> None:
    """From `origins`, `directions` and `confidence` to the fields of `Equilibrium`, by the starts of `ForceBalance`."""
    first, last = (eps * estimator.reference for eps in EPS)
    falls = np.minimum(1.0, np.arange(estimator.steps) / (FALL * (estimator.steps - 1)))
    eps = (first * (last / first) ** falls).astype(np.float32)
    rays, found = ["origins", "across", "weight"], list(Balance._fields)
    best = [f"best {name}" for name in found]
    tracer.piece(estimator, _seen, ["directions", "confidence"], ["across", "weight"])
    tracer.piece(estimator, _rest, ["confidence"], ["surface", "pressure", "before"])
    for depth, width in ((None, None), *DENTS):
        if depth:
            tracer.piece(estimator, partial(_dented, depth=depth, width=width), best, ["surface", "pressure", "before"])
        tracer.steps(estimator, _step, ["surface", "pressure", "before"], rays, estimator.steps, eps=eps)
        tracer.piece(estimator, _balance, ["surface", "pressure", "before", *rays], found)
        if depth:
            tracer.piece(estimator, _better, [*best, *found], best)
        else:
            tracer.alias(best, found)
    tracer.piece(estimator, _equilibrium, best, list(Equilibrium._fields))


def _seen(estimator, directions, confidence):
    return _across(directions), confidence / estimator.noise**2


def _rest(estimator, confidence):
    rest = estimator.membrane.rest.expand(confidence.shape[0], -1, -1)
    return rest, estimator.rest_pressure.expand(confidence.shape[0]), rest


def _step(estimator, surface, pressure, before, origins, across, weight, eps):
    return *estimator.step(surface, pressure, Observation(origins, across, weight), eps), surface


def _balance(estimator, surface, pressure, before, origins, across, weight):
    moved = torch.linalg.vector_norm(surface - before, dim=-1).amax(-1) / estimator.size
    return tuple(estimator.balance(surface, pressure, Observation(origins, across, weight))._replace(last_step=moved))


def _dented(estimator, *best, depth, width):
    surface = estimator.dented(Balance(*best), depth, width)
    return surface, estimator.rest_pressure.expand(surface.shape[0]), surface


def _better(estimator, *both):
    return tuple(estimator.better(Balance(*both[: len(both) // 2]), Balance(*both[len(both) // 2 :])))


def _equilibrium(estimator, *best):
    return tuple(estimator.equilibrium(Balance(*best)))


def _result(reconstructor, vertices, pressure, volume, traction, unbalance, displacement, confidence, status):
    equilibrium = Equilibrium(vertices, pressure, volume, traction, unbalance)
    return tuple(reconstructor.result(equilibrium, displacement, confidence, status))


def _finished(tracer: Tracer, reconstructor: Reconstructor, settings: Settings) -> onnx.ModelProto:
    width, height = reconstructor.image_size
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["batch", 1, height, width])
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
    return tracer.assembly.model([image], outputs, metadata)
