"""Tracing of a piece of torch code to an ONNX graph with a free batch size."""

import warnings
from typing import Any

import numpy as np
import onnx
import onnx_ir as ir
import torch
from onnx import TensorProto
from onnx_ir import passes
from onnx_ir.passes import common
from onnxscript import opset18
from onnxscript.function_libs.torch_lib.ops.core import aten_full, aten_full_like, aten_index_select, aten_scalar_tensor
from onnxscript.optimizer import fold_constants_ir
from torch import Tensor, nn

from ..control_flow import writing
from .torch_internals import TorchExporter, empty_batches

OPSET = 18
MANY = 1_000_003
"""The batch size for tracing, a prime; no tensor of that size is allocated."""
HUGE = (1 << 31) - 1
"""Values from here on mean the end of an axis and are not lengths."""
LENGTHS = 8
"""Largest number of elements of a tensor of lengths."""
UNTOLD = -1
"""A precision that an operation does not tell."""
NUMBERS = (ir.AttributeType.INT, ir.AttributeType.INTS, ir.AttributeType.FLOAT, ir.AttributeType.FLOATS)

TIDY = passes.Sequential(
    common.RemoveUnusedNodesPass(),
    common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
    common.DeduplicateInitializersPass(),
    common.CommonSubexpressionEliminationPass(),
    common.OutputFixPass(),
    common.NameFixPass(),
)
"""The passes of torch's exporter without its pattern rewriting, which takes most of the time and changes hardly anything."""


def _number(s: float, dtype: int = TensorProto.FLOAT, layout: str = "", device: str = "", pin_memory: bool = False) -> Any:
    """Translate `torch.scalar_tensor` to ONNX, keeping double precision."""
    if dtype != TensorProto.DOUBLE or not isinstance(s, float):
        return aten_scalar_tensor(s, dtype, layout, device, pin_memory)
    number: Any = ir.tensor(s, dtype=ir.DataType.DOUBLE)
    return opset18.Constant(value=number)


def _full(size: Any, fill_value: Any, dtype: int = TensorProto.FLOAT, **others: Any) -> Any:
    """Translate `torch.full` to ONNX, keeping double precision."""
    return aten_full(size, _number(fill_value, dtype), dtype, **others)


def _new_full(self: Any, size: Any, fill_value: Any, dtype: int = UNTOLD, **others: Any) -> Any:
    """Translate `torch.new_full` to ONNX, keeping double precision."""
    return _full(size, fill_value, _told(dtype, self), **others)


def _full_like(self: Any, fill_value: Any, dtype: int = UNTOLD, **others: Any) -> Any:
    """Translate `torch.full_like` to ONNX, keeping double precision."""
    dtype = _told(dtype, self)
    return aten_full_like(self, _number(fill_value, dtype), dtype, **others)


def _masked_fill(self: Any, mask: Any, value: Any) -> Any:
    """Translate `torch.masked_fill` to ONNX, keeping double precision."""
    return opset18.Where(mask, _number(value, self.dtype.value), self)


def _power(self: Any, exponent: Any) -> Any:
    """Translate `torch.pow` of a number to ONNX, keeping double precision."""
    return opset18.Pow(_number(self, exponent.dtype.value), exponent)


def _told(dtype: int, tensor: Any) -> int:
    """Return a precision if it is told, else that of a tensor."""
    return int(tensor.dtype.value) if dtype == UNTOLD else dtype


def _selected(self: Any, dim: int, index: Any) -> Any:
    """Translate `torch.index_select` to ONNX.

    Along the last axis, entries are gathered one by one, because onnxruntime is slow with many slices of length one.
    """
    *others, _ = self.shape
    if dim % len(self.shape) < len(others):
        return aten_index_select(self, dim, index)
    tensor: Any = ir.tensor([*others, *index.shape], dtype=ir.DataType.INT64)
    shape: Any = opset18.Constant(value=tensor)
    return opset18.GatherElements(self, opset18.Expand(index, shape), axis=len(others))


EXPORTER = TorchExporter(
    {
        torch.ops.aten.scalar_tensor.default: _number,
        torch.ops.aten.full.default: _full,
        torch.ops.aten.new_full.default: _new_full,
        torch.ops.aten.full_like.default: _full_like,
        torch.ops.aten.masked_fill.Scalar: _masked_fill,
        torch.ops.aten.pow.Scalar: _power,
        torch.ops.aten.index_select.default: _selected,
    }
)
"""The exporter, with scalars in double precision (torch rounds them to single) and an `index_select` fast in onnxruntime."""


def traced_model(module: nn.Module, inputs: dict[str, Tensor], outputs: list[str]) -> onnx.ModelProto:
    """Trace a module to ONNX, with named inputs and outputs; the first axis of every input except scalars is the batch.

    The module is traced with a batch of `MANY` frames, a length that nothing else has; occurrences of this length in the graph
    are then replaced by the actual batch size. With a symbolic length, torch takes three times as long.

    Raises:
        ValueError: a number that is not a length depends on the batch size.
    """
    examples = empty_batches(inputs.values(), MANY)
    with warnings.catch_warnings(), EXPORTER.at_work(), writing():
        warnings.simplefilter("ignore")  # of the exporter about its own code
        program = torch.onnx.export(
            EXPORTER.captured(module.eval(), examples),
            input_names=list(inputs),
            output_names=outputs,
            opset_version=OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
            optimize=False,
        )
    assert program is not None  # only the exporter without dynamo returns None
    common.InlinePass()(program.model)
    fold_constants_ir(program.model, should_fold=_is_constant)
    _free(program.model.graph)
    _leave_out_ones(program.model.graph)
    TIDY(program.model)
    for value, name in zip(program.model.graph.inputs, inputs, strict=True):  # inputs that are also outputs lost their names
        value.name = name
    return program.model_proto


def _is_constant(node: ir.Node) -> bool | None:
    """Return False for nodes that would make a constant of the batch's length; None leaves the decision to the pass."""
    if node.op_type == "Concat":
        return None
    lengths = (None if value is None else ir.convenience.get_const_tensor(value) for value in node.inputs)
    made = any(each is not None and each.size <= LENGTHS and _depends(each.numpy()) for each in lengths)
    return False if made else None


def _free(graph: ir.Graph) -> None:
    """Replace constants that are lengths and multiples of the traced batch size by values computed from the actual batch size.

    Raises:
        ValueError: a number that is not a length is a multiple of the traced batch size.
    """
    length: ir.Value | None = None
    for node in list(graph):
        given = [] if node.op_type == "Constant" else node.attributes.values()
        if any(_depends(np.asarray(each.value)) for each in given if each.type in NUMBERS):
            raise ValueError(
                f"the batch size is a fixed attribute of {node.op_type}; compute each frame independently of the others"
            )
        for k, value in enumerate(node.inputs):
            constant = None if value is None else ir.convenience.get_const_tensor(value)
            if constant is None or constant.size > LENGTHS or not _depends(constant.numpy()):
                continue
            numbers = constant.numpy()
            if numbers.dtype != np.int64:
                raise ValueError(
                    f"{node.op_type} computes with the batch size as a value, not as a length, so that the model would hold "
                    "for one batch size only; compute each frame independently of the others"
                )
            of_batch = numbers % MANY == 0
            if node.op_type == "Reshape" and of_batch.sum() == 1 and (numbers > 0).all():
                free = [ir.node("Constant", [], {"value": ir.tensor(np.where(of_batch, -1, numbers))})]
            else:
                if length is None:
                    source = next(value for value in graph.inputs if value.shape is not None and len(value.shape))
                    first = ir.node("Shape", [source], {"start": 0, "end": 1})
                    graph.insert_before(graph[0], first)
                    length = first.outputs[0]
                free = _lengths(numbers, of_batch & (numbers != 0), length)
            graph.insert_before(node, free)
            node.replace_input_with(k, free[-1].outputs[0])
    for value in [*graph.inputs, *(value for node in graph for value in node.outputs)]:
        if value.shape is not None:
            lengths = [length if isinstance(length, int) else None for length in value.shape]
            value.shape = ir.Shape([None if length and length % MANY == 0 else length for length in lengths])


def _leave_out_ones(graph: ir.Graph) -> None:
    """Remove products with the number 1, which torch's exporter makes of `addcmul` and others."""
    for node in [node for node in graph if node.op_type == "Mul" and not node.outputs[0].is_graph_output()]:
        for value, other in (node.inputs, node.inputs[::-1]):
            constant = None if value is None else ir.convenience.get_const_tensor(value)
            if other is not None and constant is not None and constant.numpy().ndim == 0 and constant.numpy() == 1:
                ir.convenience.replace_all_uses_with(node.outputs[0], other)
                graph.remove(node, safe=True)
                break


def _depends(numbers: np.ndarray) -> bool:
    """Return whether any of the numbers is a multiple of the traced batch size."""
    wide = numbers.dtype.kind in "if" and numbers.dtype.itemsize > 2
    return bool(wide and (numbers[(numbers >= MANY) & (numbers < HUGE)] % MANY == 0).any())


def _lengths(numbers: np.ndarray, of_batch: np.ndarray, length: ir.Value) -> list[ir.Node]:
    """Return nodes, the last of which computes the numbers, with multiples of the traced batch size taken of `length [1]`."""
    times, plus = np.where(of_batch, numbers // MANY, 0), np.where(of_batch, 0, numbers)
    constants = [ir.node("Constant", [], {"value": ir.tensor(each.reshape(-1))}) for each in (times, plus)]
    product = ir.node("Mul", [length, constants[0].outputs[0]])
    both = ir.node("Add", [product.outputs[0], constants[1].outputs[0]])
    if numbers.ndim == 1:
        return [*constants, product, both]
    shape = ir.node("Constant", [], {"value": ir.tensor(np.array(numbers.shape, np.int64))})
    return [*constants, product, both, shape, ir.node("Reshape", [both.outputs[0], shape.outputs[0]])]
