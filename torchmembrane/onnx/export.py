"""A sensor's whole reconstruction, image to result, as one ONNX file: `torchmembrane export`.

The reconstructor is called with `Value`s: what it and its parts mark as `traced` is traced once each and put together.
"""

import json
from collections.abc import Callable, Sequence
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
from ..control_flow import FUNCTIONS, Value
from ..errors import MembraneError, check_arguments
from ..files.atomic import write_bytes
from ..progress import Progress, silent, within
from ..reconstruct import Reconstructor
from ..results.status import Status
from ..results.store import FORMATS, Mesh, Settings
from .check import checked
from .graph import Assembly, described, inlined
from .torch_internals import tree_flatten, tree_leaves, tree_map, tree_unflatten
from .trace import EXPORTER, traced_model

FORMAT = 1
SEAL = "SHA-256: "
CHECK, NODES = 0.65, 11_500  # share of the time before the check, and how many nodes are traced, of the default estimator
IMAGE, PREVIOUS = "image", "previous_pixels"
EXAMPLES = 2  # frames with which a piece is traced; the batch stays free


class Known(Value):
    """A value by its name in the graph, with an example to trace with."""

    def __init__(self, graph: "Tracer", name: str, example: Tensor) -> None:
        super().__init__(graph)
        self.name, self.example = name, example


class Piece(nn.Module):
    """A method with the module whose buffers it uses; `arranged` rebuilds its arguments from the tensors among them."""

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
    """Appends every call, loop and condition on a `Value` to an `Assembly`.

    Nodes are named after the part of the package that they come from.
    """

    def __init__(self, progress: Progress = silent) -> None:
        self.assembly, self.progress = Assembly(), progress
        self.traced: dict[tuple[Any, ...], onnx.ModelProto] = {}
        self.nodes = 0  # of the pieces traced so far

    def given(self, name: str, example: Tensor) -> Known:
        """An input of the graph."""
        return Known(self, name, example)

    def call(self, owner: nn.Module | None, function: Callable[..., Any], inputs: Sequence[Any]) -> Any:
        """Values of `function(owner, *inputs)`."""
        model, names, found = self._trace(owner, function, inputs)
        return self._known(found, self.assembly.append(model, names))

    def fori_loop(
        self, step: Callable[..., Any], rows: Sequence[tuple[float, ...]], state: Sequence[Any], given: Sequence[Any]
    ) -> Any:
        """Values after a loop of a bound piece, as `control_flow.fori_loop`."""
        assert isinstance(step, MethodType) and isinstance(step.__self__, nn.Module)
        precise = state[0].example.dtype == torch.float64
        columns = [np.array(column, np.float64 if precise else np.float32) for column in zip(*rows, strict=True)]
        row = [Known(self, "", torch.as_tensor(column[0])) for column in columns]
        model, names, found = self._trace(step.__self__, unwrap(step.__func__), [*state, *given, *row])
        tables = dict(zip(reversed(names), reversed(columns), strict=False))
        names = {name: here for name, here in names.items() if name not in tables}
        return self._known(found, self.assembly.loop(model, names, len(rows), tables))

    def cond(self, done: Known, values: Sequence[Known], otherwise: Callable[[], Sequence[Known]]) -> Sequence[Known]:
        """Values after a conditional, as `control_flow.cond`."""
        condition = self.call(None, _everywhere, (done,))
        names = {k: value.name for k, value in enumerate(values)}
        kinds = [_kind(value.example) for value in values]
        with self.assembly.cond(condition.name, names, kinds):
            names |= {k: value.name for k, value in enumerate(otherwise())}
        return [Known(self, names[k], value.example) for k, value in enumerate(values)]

    def _trace(
        self, owner: nn.Module | None, function: Callable[..., Any], inputs: Sequence[Any]
    ) -> tuple[onnx.ModelProto, dict[str, str], Any]:
        """The piece as a model, the names that its inputs have here, and examples of its outputs."""
        leaves, structure = tree_flatten(tuple(inputs))
        places = {k: leaf for k, leaf in enumerate(leaves) if isinstance(leaf, Known)}
        fixed = {k: leaf for k, leaf in enumerate(leaves) if k not in places}

        def arranged(*tensors: Tensor) -> Sequence[Any]:
            known = fixed | dict(zip(places, tensors, strict=True))
            arguments: Sequence[Any] = tree_unflatten([known[k] for k in range(len(known))], structure)
            return arguments

        names = {f"input {k}": value.name for k, value in places.items()}
        examples = {f"input {k}": value.example.clone() for k, value in places.items()}  # one tensor twice is traced as one
        with torch.no_grad():
            found = function(owner, *arranged(*examples.values()))
        if owner is not None:
            self.assembly.part = type(owner).__module__.removeprefix("torchmembrane.").partition(".")[0]
        key = (owner, function, str(structure), *fixed.items(), *(value.shape for value in examples.values()))
        if key not in self.traced:
            self.progress(min(1.0, self.nodes / NODES), getattr(function, "__qualname__", ""))
            outputs = [f"output {k}" for k, _ in enumerate(value for value in tree_leaves(found) if value is not None)]
            try:
                self.traced[key] = self._whole(traced_model(Piece(owner, function, arranged), examples, outputs))
            except Exception as error:  # of torch's exporter and of what it calls, which raise what they like
                reason = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
                name = getattr(function, "__qualname__", str(function))
                raise MembraneError(f"export: {name} cannot be written as ONNX: {reason.strip()}") from error
            self.nodes += len(self.traced[key].graph.node)
        return self.traced[key], names, found

    def _whole(self, model: onnx.ModelProto) -> onnx.ModelProto:
        """The model with the nodes of its `onnx_function`s inlined."""
        return inlined(model, self._function)

    def _function(self, node: onnx.NodeProto) -> onnx.ModelProto:
        """The model of an `onnx_function` for the sizes of a node, apart from the batch, and its precision."""
        given = {attribute.name: attribute for attribute in node.attribute}
        name, sizes, width = node.op_type, tuple(given["sizes"].ints), given["bytes"].i
        if (name, sizes, width) not in self.traced:
            example = {"value": torch.zeros(EXAMPLES, *sizes, dtype=torch.float32 if width == 4 else torch.float64)}
            piece = Piece(None, lambda _, value: FUNCTIONS[name](value))
            self.traced[name, sizes, width] = self._whole(traced_model(piece, example, ["result"]))
        return self.traced[name, sizes, width]

    def _known(self, found: Any, names: dict[str, str]) -> Any:
        """The values of such names, arranged as the examples `found` are."""
        each = iter(names.values())
        return tree_map(lambda example: None if example is None else Known(self, next(each), example), found)


def _everywhere(_: None, done: Tensor) -> Tensor:
    return done.all()


def _kind(example: Tensor) -> int:
    """ONNX' number of a tensor's element type."""
    return helper.np_dtype_to_tensor_dtype(example.numpy().dtype)


@check_arguments
def export(
    reconstructor: Reconstructor,
    path: str | Path,
    *,
    tracking: bool = False,
    progress: Progress = silent,
) -> onnx.ModelProto:
    """Write the whole reconstruction, image to result, as one ONNX model, if it agrees with torch.

    Standard operators only, batch free, float32, but for the solve of slack sheets, float64. Run on the sensor at rest and
    pressed, both simulated, it must give torch's statuses, and vertices within 3e-5 of the surface's size. The model's metadata
    hold `format`, `version` (this package's), `status_texts` and `mesh` (the fields of `Mesh`) as JSON, and `bits` where the
    sensor's camera states them: images of 16 bits are then divided by `2^bits - 1` before they are given to the model. The file
    ends in its digest (`sealed`).

    Args:
        reconstructor: the sensor's.
        path: the model's file.
        tracking: follow the dots of the frames before; of a texture, which is not followed, the model is the same.
        progress: is told how far it is, and the names of the pieces, some thirty; the last step is the check.

    Returns:
        The model. Input `image [batch, 1, height, width]`, grey in 0..1, of views that have images of their own one for each,
        `image_NAME`; with `tracking`, of dots, also `previous_pixels [batch, D, 2]`, of W views `[batch, W, D, 2]`, NaN to
        start from rest. Outputs as `Reconstruction`.

    Raises:
        MembraneError: a folder that does not exist, a reconstructor of another precision than float32, or one that cannot be
            written, or is not the same when it is.
    """
    if not Path(path).parent.is_dir():
        raise MembraneError(f"export: {path}: the folder {Path(path).parent} does not exist; make it first")
    if len({view.camera.bits for view in reconstructor.sensor.views}) > 1:
        raise MembraneError("export: views whose cameras differ in bits; expected the same of all")
    if reconstructor.rest_pixels.dtype != torch.float32:
        raise MembraneError(f"export: the reconstructor is {reconstructor.rest_pixels.dtype}; expected torch.float32")
    progress(0.0, "image")
    tracer, generator = Tracer(within(progress, 0.0, CHECK)), torch.Generator().manual_seed(0)
    images = [
        tracer.given(name, torch.rand(EXAMPLES, 1, height, width, generator=generator).to(reconstructor.rest_pixels))
        for name, (width, height) in image_inputs(reconstructor).items()
    ]
    before = []
    if tracking and reconstructor.observer.follows:
        rest = reconstructor.rest_pixels
        before.append(tracer.given(PREVIOUS, rest.expand(EXAMPLES, *rest.shape).contiguous()))
    inputs, values = images + before, cast(Any, images)  # stand for tensors
    with EXPORTER.at_work():
        given = [reconstructor.observer.sighted(pixels) for pixels in cast(Any, before)]
        result: Any = reconstructor.reconstruct_grey(values[0] if len(values) == 1 else values, *given)
    model = _finished(tracer, inputs, result, reconstructor)
    progress(CHECK, "check against torch")
    checked(model.SerializeToString(), reconstructor)
    write_bytes(path, sealed(model.SerializeToString()))
    return model


def image_inputs(reconstructor: Reconstructor) -> dict[str, tuple[int, int]]:
    """Names of a model's images, each with width and height: one, or of each view that has images of its own."""
    apart = reconstructor.sensor.views_apart
    if not apart:
        return {IMAGE: reconstructor.image_size}
    return {f"{IMAGE}_{name}": size for name, size in zip(apart, reconstructor.camera.image_sizes, strict=True)}


def sealed(content: bytes) -> bytes:
    """A model's bytes, followed by its `doc_string`, which holds the SHA-256 digest of the bytes before it.

    The fields of a protocol buffer may come in any order, so this is the same model. A damaged weight is found before the model
    is run. Programs that write the model anew put the `doc_string` before the graph; their files are not checked.

    Example:
        >>> onnx.ModelProto.FromString(sealed(b"")).doc_string[:20]
        'SHA-256: e3b0c44298f'
    """
    seal: bytes = onnx.ModelProto(doc_string=f"{SEAL}{sha256(content).hexdigest()}").SerializeToString()
    return content + seal


def _finished(tracer: Tracer, inputs: list[Known], result: Any, reconstructor: Reconstructor) -> onnx.ModelProto:
    """The model, its values described, from a `Reconstruction` of `Known` values."""

    def of_batch(name: str, value: Known, kind: int) -> onnx.ValueInfoProto:
        return described(name, kind, ["batch", *value.example.shape[1:]])

    outputs = []
    for name, value in result._asdict().items():
        tracer.assembly.named(value.name, name)
        outputs.append(of_batch(name, value, TensorProto.INT32 if name == "status" else TensorProto.FLOAT))
    given = [of_batch(value.name, value, TensorProto.FLOAT) for value in inputs]
    return tracer.assembly.model(given, outputs, metadata_of(reconstructor))


def metadata_of(reconstructor: Reconstructor) -> dict[str, str]:
    """The metadata of a model on its sensor: texts by key."""
    mesh = Mesh.from_reconstructor(reconstructor, Settings.from_reconstructor(reconstructor, FORMATS[0]))._asdict()
    plain = {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in mesh.items()}
    texts = {str(status.value): status.text for status in Status}
    metadata = {"format": str(FORMAT), "version": __version__, "name": mesh["name"], "length_unit": mesh["length_unit"]}
    bits = reconstructor.sensor.camera.bits
    metadata |= {} if bits is None else {"bits": str(bits)}
    return metadata | {"force_unit": mesh["force_unit"], "status_texts": json.dumps(texts), "mesh": json.dumps(plain)}
