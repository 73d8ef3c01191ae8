"""Export of a sensor's complete reconstruction, from image to result, to one ONNX file (`torchmembrane export`).

The reconstructor is called with `Value`s in place of tensors. Each function marked as `traced` is traced once, and the pieces
are assembled into one graph.
"""

import json
from collections.abc import Callable, Sequence
from functools import cache, wraps
from hashlib import sha256
from inspect import unwrap
from pathlib import Path
from types import MethodType
from typing import Any, cast

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper
from torch import Tensor, nn

from .. import __version__
from ..control_flow import FUNCTIONS, Value, where_rows
from ..errors import MembraneError, check_arguments
from ..estimators.base import Estimator
from ..files.atomic import write_bytes
from ..progress import Progress, silent, within
from ..reconstruct import Reconstructor
from ..results.status import Status
from ..results.store import FORMATS, Mesh, Settings
from ..torch_modes import on_cpu
from .check import checked
from .graph import Assembly, described, inlined
from .torch_internals import tree_flatten, tree_leaves, tree_map, tree_unflatten
from .trace import EXPORTER, traced_model

FORMAT = 1
SEAL = "SHA-256: "
CHECK, NODES = 0.85, 3_600  # for the default estimator: share of the time before the check, and traced nodes for each grid
IMAGE, PREVIOUS = "image", "previous_pixels"
EXAMPLES = 2  # frames of the example inputs; the batch size of the model stays free


class Known(Value):
    """A value of the graph: its name, and an example tensor for tracing."""

    def __init__(self, graph: "Tracer", name: str, example: Tensor) -> None:
        super().__init__(graph)
        self.name, self.example = name, example


class Piece(nn.Module):
    """A function with the module whose buffers it uses; `arranged` rebuilds all its arguments from the tensor arguments."""

    def __init__(
        self,
        owner: nn.Module | None,
        function: Callable[..., Any],
        arranged: Callable[..., Sequence[Any]] = lambda *tensors: tensors,
    ) -> None:
        super().__init__()
        self.owner, self.function, self.arranged = owner, function, arranged

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        found = tree_leaves(self.function(self.owner, *self.arranged(*tensors)))
        return tuple(value for value in found if value is not None)


class Tracer:
    """A recorder that appends every call, loop and conditional on `Value`s to an `Assembly`.

    Nodes are named after the subpackage from which they come.
    """

    def __init__(self, progress: Progress = silent, expected: int = NODES) -> None:
        self.assembly, self.progress, self.expected = Assembly(), progress, expected
        self.traced: dict[tuple[Any, ...], onnx.ModelProto] = {}
        self.nodes = 0  # number of nodes traced so far

    def given(self, name: str, example: Tensor) -> Known:
        """Return an input of the graph."""
        return Known(self, name, example)

    def call(self, owner: nn.Module | None, function: Callable[..., Any], inputs: Sequence[Any]) -> Any:
        """Append `function(owner, *inputs)` to the graph and return its values."""
        model, names, found = self._trace(owner, function, inputs)
        return self._known(found, self.assembly.append(model, names))

    def fori_loop(
        self, step: Callable[..., Any], rows: Sequence[tuple[float, ...]], state: Sequence[Any], given: Sequence[Any]
    ) -> Any:
        """Append a loop over a bound method and return the final values; see `control_flow.fori_loop`."""
        assert isinstance(step, MethodType) and isinstance(step.__self__, nn.Module)
        precise = state[0].example.dtype == torch.float64
        columns = [np.array(column, np.float64 if precise else np.float32) for column in zip(*rows, strict=True)]
        row = [Known(self, "", torch.as_tensor(column[0])) for column in columns]
        model, names, found = self._trace(step.__self__, unwrap(step.__func__), [*state, *given, *row])
        tables = dict(zip(reversed(names), reversed(columns), strict=False))
        names = {name: here for name, here in names.items() if name not in tables}
        return self._known(found, self.assembly.loop(model, names, len(rows), tables))

    def repeat_rows(self, step: Callable[..., Any], count: int, state: Sequence[Any], given: Sequence[Any]) -> Any:
        """Append a loop over a bound method that ends when all rows are done; see `control_flow.repeat_rows`."""
        assert isinstance(step, MethodType) and isinstance(step.__self__, nn.Module)
        going = self.call(None, _somewhere_left, (state[0],))
        masked = _masked(unwrap(step.__func__), len(state))
        model, names, found = self._trace(step.__self__, masked, [*state, *given])
        return self._known(found[:-1], self.assembly.loop(model, names, count, {}, going.name))

    def cond(self, done: Known, values: Sequence[Known], otherwise: Callable[[], Sequence[Known]]) -> Sequence[Known]:
        """Append a conditional and return the chosen values; see `control_flow.cond`."""
        condition = self.call(None, _everywhere, (done,))
        names = {k: value.name for k, value in enumerate(values)}
        kinds = [_kind(value.example) for value in values]
        with self.assembly.cond(condition.name, names, kinds):
            names |= {k: value.name for k, value in enumerate(otherwise())}
        return [Known(self, names[k], value.example) for k, value in enumerate(values)]

    def _trace(
        self, owner: nn.Module | None, function: Callable[..., Any], inputs: Sequence[Any]
    ) -> tuple[onnx.ModelProto, dict[str, str], Any]:
        """Return the function as a model, the names of its inputs in this graph, and examples of its outputs."""
        leaves, structure = tree_flatten(tuple(inputs))
        places = {k: leaf for k, leaf in enumerate(leaves) if isinstance(leaf, Known)}
        fixed = {k: leaf for k, leaf in enumerate(leaves) if k not in places}

        def arranged(*tensors: Tensor) -> Sequence[Any]:
            known = fixed | dict(zip(places, tensors, strict=True))
            arguments: Sequence[Any] = tree_unflatten([known[k] for k in range(len(known))], structure)
            return arguments

        names = {f"input {k}": value.name for k, value in places.items()}
        examples = {f"input {k}": value.example.clone() for k, value in places.items()}  # one tensor twice would be one input
        with torch.no_grad():
            found = function(owner, *arranged(*examples.values()))
        if owner is not None:
            self.assembly.part = type(owner).__module__.removeprefix("torchmembrane.").partition(".")[0]
        key = (owner, function, str(structure), *fixed.items(), *(value.shape for value in examples.values()))
        if key not in self.traced:
            self.progress(min(1.0, self.nodes / self.expected), getattr(function, "__qualname__", ""))
            outputs = [f"output {k}" for k, _ in enumerate(value for value in tree_leaves(found) if value is not None)]
            try:
                self.traced[key] = self._whole(traced_model(Piece(owner, function, arranged), examples, outputs))
            except Exception as error:  # torch's exporter and its dependencies raise exceptions of any type
                reason = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
                name = getattr(function, "__qualname__", str(function))
                raise MembraneError(f"export: {name} cannot be written as ONNX: {reason.strip()}") from error
            self.nodes += len(self.traced[key].graph.node)
        return self.traced[key], names, found

    def _whole(self, model: onnx.ModelProto) -> onnx.ModelProto:
        """Return the model with its `onnx_function` nodes inlined."""
        return inlined(model, self._function)

    def _function(self, node: onnx.NodeProto) -> onnx.ModelProto:
        """Return the model of an `onnx_function` for a node's sizes (without the batch) and precision."""
        given = {attribute.name: attribute for attribute in node.attribute}
        name, sizes, width = node.op_type, tuple(given["sizes"].ints), given["bytes"].i
        if (name, sizes, width) not in self.traced:
            example = {"value": torch.zeros(EXAMPLES, *sizes, dtype=torch.float32 if width == 4 else torch.float64)}
            piece = Piece(None, lambda _, value: FUNCTIONS[name](value))
            self.traced[name, sizes, width] = self._whole(traced_model(piece, example, ["result"]))
        return self.traced[name, sizes, width]

    def _known(self, found: Any, names: dict[str, str]) -> Any:
        """Return the values with these names, in the structure of the examples `found`."""
        each = iter(names.values())
        return tree_map(lambda example: None if example is None else Known(self, next(each), example), found)


def _everywhere(_: None, done: Tensor) -> Tensor:
    return done.all()


def _somewhere_left(_: None, done: Tensor) -> Tensor:
    return torch.logical_not(done.all())


@cache
def _masked(step: Callable[..., Any], count: int) -> Callable[..., Any]:
    """Return a method that takes a step of `repeat_rows` with a state of `count` tensors in the rows that are not done, and
    says whether any row is left."""

    @wraps(step)
    def masked(owner: nn.Module, *values: Any) -> list[Tensor]:
        before, (now_done, *after) = values[1:count], step(owner, *values)
        done = values[0] | now_done  # onnxruntime has no Where for bools
        return [done, *where_rows(values[0], before, after), _somewhere_left(None, done)]

    return masked


def _kind(example: Tensor) -> int:
    """Return the ONNX code of a tensor's element type."""
    return helper.np_dtype_to_tensor_dtype(example.numpy().dtype)


@check_arguments
@on_cpu
def export(
    reconstructor: Reconstructor,
    path: str | Path,
    *,
    tracking: bool = False,
    progress: Progress = silent,
) -> onnx.ModelProto:
    """Write the complete reconstruction, from image to result, as one ONNX model, after checking that it agrees with torch.

    The model has standard operators only and a free batch size. It computes in float32, except for the solver of slack sheets,
    which uses float64. On simulated images of the sensor at rest and pressed, it must give torch's statuses, and vertices
    within 3e-5 of the surface's size. The model's metadata are `format`, `version` (of this package), `status_texts` and `mesh`
    (the fields of `Mesh`) as JSON, and `bits` if the sensor's camera has that value: divide 16-bit images by `2^bits - 1`
    before they are given to the model. The file ends with its digest (`sealed`).

    Args:
        reconstructor: the sensor's reconstructor, in float32.
        path: path of the model's file.
        tracking: whether to track dots from frame to frame; it has no effect for texture, which is not tracked.
        progress: called with the completed share and the name of the current piece (about thirty); the last step is the check.

    Returns:
        The model. Its input is `image [batch, 1, height, width]`, grey in 0..1; for views with images of their own there is one
        input `image_NAME` for each. With `tracking` of dots there is also `previous_pixels [batch, D, 2]` (for W views
        `[batch, W, D, 2]`), NaN to start from rest. Its outputs are the fields of `Reconstruction`.

    Raises:
        MembraneError: the folder does not exist, the reconstructor's precision is not float32, it cannot be exported, or the
            model disagrees with torch.
    """
    if not Path(path).parent.is_dir():
        raise MembraneError(f"export: {path}: the folder {Path(path).parent} does not exist; make it first")
    if len({view.camera.bits for view in reconstructor.sensor.views}) > 1:
        raise MembraneError("export: views whose cameras differ in bits; expected the same of all")
    if reconstructor.rest_pixels.dtype != torch.float32:
        raise MembraneError(f"export: the reconstructor is {reconstructor.rest_pixels.dtype}; expected torch.float32")
    progress(0.0, "image")
    grids = max(1, sum(isinstance(part, Estimator) for part in reconstructor.estimator.modules()))
    tracer, generator = Tracer(within(progress, 0.0, CHECK), NODES * grids), torch.Generator().manual_seed(0)
    images = [
        tracer.given(name, torch.rand(EXAMPLES, 1, height, width, generator=generator).to(reconstructor.rest_pixels))
        for name, (width, height) in image_inputs(reconstructor).items()
    ]
    before = []
    if tracking and reconstructor.observer.follows:
        rest = reconstructor.rest_pixels
        before.append(tracer.given(PREVIOUS, rest.expand(EXAMPLES, *rest.shape).contiguous()))
    inputs, values = images + before, cast(Any, images)  # they stand for tensors
    with EXPORTER.at_work(), torch.no_grad():
        given = [reconstructor.observer.sighted(pixels) for pixels in cast(Any, before)]
        result: Any = reconstructor.reconstruct_grey(values[0] if len(values) == 1 else values, *given)
    model = _finished(tracer, inputs, result, reconstructor)
    progress(CHECK, "check against torch")
    checked(model.SerializeToString(), reconstructor)
    write_bytes(path, sealed(model.SerializeToString()))
    return model


def image_inputs(reconstructor: Reconstructor) -> dict[str, tuple[int, int]]:
    """Return the names of a model's image inputs with width and height: one, or one for each view with images of its own."""
    apart = reconstructor.sensor.views_apart
    if not apart:
        return {IMAGE: reconstructor.image_size}
    return {f"{IMAGE}_{name}": size for name, size in zip(apart, reconstructor.camera.image_sizes, strict=True)}


def sealed(content: bytes) -> bytes:
    """Append a `doc_string` with the SHA-256 digest of a model's bytes to these bytes.

    The fields of a protocol buffer may be in any order, so this is still the same model. The digest reveals damaged weights
    before the model is run. Programs that rewrite the model put the `doc_string` before the graph; such files are not checked.

    Example:
        >>> onnx.ModelProto.FromString(sealed(b"")).doc_string[:20]
        'SHA-256: e3b0c44298f'
    """
    seal: bytes = onnx.ModelProto(doc_string=f"{SEAL}{sha256(content).hexdigest()}").SerializeToString()
    return content + seal


def _finished(tracer: Tracer, inputs: list[Known], result: Any, reconstructor: Reconstructor) -> onnx.ModelProto:
    """Return the complete model with described inputs and outputs, from a `Reconstruction` of `Known` values."""

    def of_batch(name: str, value: Known, kind: int) -> onnx.ValueInfoProto:
        return described(name, kind, ["batch", *value.example.shape[1:]])

    outputs = []
    for name, value in result._asdict().items():
        tracer.assembly.named(value.name, name)
        outputs.append(of_batch(name, value, TensorProto.INT32 if name == "status" else TensorProto.FLOAT))
    given = [of_batch(value.name, value, TensorProto.FLOAT) for value in inputs]
    return tracer.assembly.model(given, outputs, metadata_of(reconstructor))


def metadata_of(reconstructor: Reconstructor) -> dict[str, str]:
    """Return a model's metadata about its sensor: texts by key."""
    mesh = Mesh.from_reconstructor(reconstructor, Settings.from_reconstructor(reconstructor, FORMATS[0]))._asdict()
    plain = {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in mesh.items()}
    texts = {str(status.value): status.text for status in Status}
    metadata = {"format": str(FORMAT), "version": __version__, "name": mesh["name"], "length_unit": mesh["length_unit"]}
    bits = reconstructor.sensor.camera.bits
    metadata |= {} if bits is None else {"bits": str(bits)}
    return metadata | {"force_unit": mesh["force_unit"], "status_texts": json.dumps(texts), "mesh": json.dumps(plain)}
