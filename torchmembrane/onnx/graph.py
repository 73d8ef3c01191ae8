"""Assembly of one ONNX graph from pieces; a repeated piece is traced and stored once."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from ..control_flow import NAMED
from .trace import OPSET

IR_VERSION = 8
"""onnxruntime supports this version, and the operator set, since 1.14."""
FEW = 64
"""Larger double-precision constants are stored in single precision if that is lossless."""
SPARSE_SIZE, SPARSE_SHARE = 4096, 0.7
"""A larger constant with a smaller share of nonzero numbers is stored as these numbers and the distances between them."""


def inlined(model: onnx.ModelProto, function: Callable[[onnx.NodeProto], onnx.ModelProto]) -> onnx.ModelProto:
    """Replace the `onnx_function` nodes of a model, which have one input and one output each, by the nodes of their models."""
    graph, nodes, constants = model.graph, [], {}
    for node in graph.node:
        if node.domain != NAMED:
            nodes.append(node)
            continue
        inside, (result,) = function(node).graph, node.output
        known = {inside.input[0].name: node.input[0], inside.output[0].name: result}
        for tensor in inside.initializer:
            known[tensor.name] = f"{node.op_type}/{[list(each.ints) or each.i for each in node.attribute]}/{tensor.name}"
            constants[known[tensor.name]] = tensor
        nodes.extend(renamed(inside.node, known, result))
    del graph.node[:]
    graph.node.extend(nodes)
    for name, tensor in constants.items():
        graph.initializer.append(tensor)
        graph.initializer[-1].name = name
    return model


def renamed(nodes: Iterable[onnx.NodeProto], known: dict[str, str], prefix: str) -> list[onnx.NodeProto]:
    """Return copies of nodes with names replaced by `known`; other outputs get a prefix and are added to `known`."""
    copies = [_bare(node) for node in nodes]
    for name in (name for node in copies for name in node.output):
        known.setdefault(name, f"{prefix}/{name}" if name else "")
    for node in copies:
        node.input[:] = [known[name] if name else "" for name in node.input]
        node.output[:] = [known[name] if name else "" for name in node.output]
        node.name = next(filter(None, node.output))
    return copies


class Assembly:
    """An ONNX graph to which pieces are added; equal constants are stored once.

    Nodes are named `PART/...` after the current `part`.

    `append` and `loop` take a model from `traced_model` and the names of its inputs in this graph, and return the names of its
    outputs.
    """

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[tuple[Any, ...], TensorProto] = {}
        self.made: dict[str, list[onnx.NodeProto]] = {}
        self.pieces, self.part = 0, ""

    def append(self, piece: onnx.ModelProto, names: dict[str, str]) -> dict[str, str]:
        """Add the nodes of a piece and return the names of its outputs."""
        nodes, outputs = self._renamed(piece, names)
        self.nodes.extend(nodes)
        return outputs

    def constant(self, array: np.ndarray) -> str:
        """Add a constant if it is new, and return its name."""
        if array.dtype == np.float64 and array.size > FEW and np.array_equal(single := array.astype(np.float32), array):
            return self._widened(self.constant(single))
        nonzero = np.flatnonzero(array) if array.size > SPARSE_SIZE and array.dtype.kind == "f" else None
        if nonzero is not None and len(nonzero) < SPARSE_SHARE * array.size:
            return self._scattered(array, nonzero)
        tensor = numpy_helper.from_array(array)
        key = (tensor.data_type, tuple(tensor.dims), tensor.raw_data)
        if key not in self.constants:
            tensor.name = f"constant{len(self.constants)}"
            self.constants[key] = tensor
        return self.constants[key].name

    def _scattered(self, array: np.ndarray, nonzero: np.ndarray) -> str:
        """Add a mostly zero constant, which is expanded when the model is loaded, and return its name."""
        distances = np.diff(nonzero, prepend=0)[:, None]
        parts = {
            "values": array.ravel()[nonzero],
            "distances": distances.astype(np.min_scalar_type(distances.max(initial=0))),
            "axis": np.array(0),
            "length": np.array([array.size]),
            "shape": np.array(array.shape),
        }
        names = {name: self.constant(part) for name, part in parts.items()}
        dense = f"{names['values']}/{names['distances']}/{names['shape']}"
        if dense not in self.made:
            made = [f"{dense}/{step}" for step in ("distances", "places", "zero", "flat")]
            zero = numpy_helper.from_array(np.zeros(1, array.dtype))
            self.made[dense] = [
                helper.make_node("Cast", [names["distances"]], [made[0]], to=TensorProto.INT64),
                helper.make_node("CumSum", [made[0], names["axis"]], [made[1]]),
                helper.make_node("ConstantOfShape", [names["length"]], [made[2]], value=zero),
                helper.make_node("ScatterND", [made[2], made[1], names["values"]], [made[3]]),
                helper.make_node("Reshape", [made[3], names["shape"]], [dense]),
            ]
        return dense

    def _widened(self, name: str) -> str:
        """Return the name of a double-precision constant that is cast from a single-precision one when the model is loaded."""
        double = f"{name}/double"
        self.made.setdefault(double, [helper.make_node("Cast", [name], [double], to=TensorProto.DOUBLE)])
        return double

    def named(self, name: str, output: str) -> None:
        """Give a value the name `output`."""
        self.nodes.append(helper.make_node("Identity", [name], [output]))

    def loop(
        self,
        piece: onnx.ModelProto,
        names: dict[str, str],
        steps: int,
        tables: dict[str, np.ndarray],
        going: str | None = None,
    ) -> dict[str, str]:
        """Add a Loop over a piece whose outputs, in order, are the next values of its first inputs.

        For further inputs, `tables` has a row for every step; inputs that are not in `tables` keep their value. If `going` is
        given, the name of a bool in this graph, steps are taken only while it is true, and the piece has one more output, its
        next value.
        """
        k, count = f"{self.part}/{self.pieces}", len(piece.graph.output) - (going is not None)
        state = [value.name for value in piece.graph.input][:count]
        inside = {name: f"{k}/{name}" for name in [*state, *tables]}
        nodes, outputs = self._renamed(piece, names | inside)
        rows = [
            helper.make_node("Gather", [self.constant(table), f"{k}/step"], [inside[name]]) for name, table in tables.items()
        ]
        next_going = f"{k}/on" if going is None else outputs.pop([*outputs][-1])
        go_on = helper.make_node("Identity", [next_going], [f"{k}/still"])
        kinds = {value.name: value.type.tensor_type.elem_type for value in piece.graph.input}
        counter = [described(f"{k}/step", TensorProto.INT64, []), described(f"{k}/on", TensorProto.BOOL, [])]
        entering = [described(inside[name], kinds[name]) for name in state]
        leaving = [described(here, kinds[name]) for name, here in zip(state, outputs.values(), strict=True)]
        still = described(f"{k}/still", TensorProto.BOOL, [])
        body = helper.make_graph([*rows, *nodes, go_on], "step", [*counter, *entering], [still, *leaving])
        last = {name: f"{here}/last" for name, here in outputs.items()}
        trips = [self.constant(np.array(steps)), going or self.constant(np.array(True))]
        self.nodes.append(helper.make_node("Loop", [*trips, *(names[name] for name in state)], list(last.values()), body=body))
        return last

    @contextmanager
    def cond(self, condition: str, names: dict[Any, str], kinds: Sequence[int]) -> Iterator[None]:
        """Run the pieces that are appended within this context only if `condition` (bool) is false.

        `names` are the names of values before the context, and `kinds` their element types. Within the context, set `names` to
        the names of the replacements; afterwards they name the chosen values.
        """
        k, before, outside = f"{self.part}/{self.pieces}", dict(names), self.nodes
        self.nodes = []
        yield
        same = [helper.make_node("Identity", [name], [f"{k}/{i}/same"]) for i, name in enumerate(before.values())]

        def described_each(given: Iterable[str]) -> list[onnx.ValueInfoProto]:
            return [described(*each) for each in zip(given, kinds, strict=True)]

        branches = dict(
            then_branch=helper.make_graph(same, "then", [], described_each([node.output[0] for node in same])),
            else_branch=helper.make_graph(self.nodes, "else", [], described_each(names.values())),
        )
        names |= {name: f"{k}/{i}/either" for i, name in enumerate(names)}
        self.nodes = [*outside, helper.make_node("If", [condition], list(names.values()), **branches)]

    def model(
        self, inputs: list[onnx.ValueInfoProto], outputs: list[onnx.ValueInfoProto], metadata: dict[str, str]
    ) -> onnx.ModelProto:
        """Return the graph as a checked model with these inputs, outputs and metadata."""
        nodes = [*chain.from_iterable(self.made.values()), *self.nodes]
        graph = helper.make_graph(nodes, "torchmembrane", inputs, outputs, list(self.constants.values()))
        _shorten(graph, {value.name: value.name for value in [*inputs, *outputs]} | {"": ""})
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="torchmembrane")
        model.ir_version = IR_VERSION
        helper.set_model_props(model, metadata)
        onnx.checker.check_model(model, full_check=True)
        return model

    def _renamed(self, piece: onnx.ModelProto, names: dict[str, str]) -> tuple[list[onnx.NodeProto], dict[str, str]]:
        """Return copies of a piece's nodes with unique names, and the names of its outputs in this graph."""
        known, k = dict(names), f"{self.part}/{self.pieces}"
        self.pieces += 1
        for tensor in piece.graph.initializer:
            known[tensor.name] = self.constant(numpy_helper.to_array(tensor))
        nodes = renamed(piece.graph.node, known, k)
        return nodes, {value.name: known[value.name] for value in piece.graph.output}


def described(name: str, kind: int = TensorProto.FLOAT, shape: Sequence[str | int] | None = None) -> onnx.ValueInfoProto:
    """Return the ONNX description of a value: name, element type and shape (None: unspecified; strings: free lengths)."""
    description: onnx.ValueInfoProto = helper.make_tensor_value_info(name, kind, shape)
    return description


def _shorten(graph: onnx.GraphProto, names: dict[str, str]) -> None:
    """Replace the names of values by numbers, except those in `names`, which is extended; name nodes by part and number.

    The original names would take a quarter of the file.
    """
    parts = [node.name.partition("/")[0] for node in graph.node]
    for value in chain(graph.initializer, graph.input, graph.output):
        value.name = names.setdefault(value.name, f"v{len(names):x}")
    for node, part in zip(graph.node, parts, strict=True):
        for values in (node.input, node.output):
            values[:] = [names.setdefault(name, f"v{len(names):x}") for name in values]
        for attribute in node.attribute:
            if attribute.HasField("g"):
                _shorten(attribute.g, names)
        node.name = part and f"{part}/{node.output[0]}"


def _bare(node: onnx.NodeProto) -> onnx.NodeProto:
    """Return a copy of the node without its name and the exporter's notes."""
    copy = onnx.NodeProto()
    copy.CopyFrom(node)
    for field in ("metadata_props", "doc_string", "name"):
        copy.ClearField(field)
    return copy
