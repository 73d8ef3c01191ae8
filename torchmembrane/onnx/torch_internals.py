"""The private parts of torch on which the export depends; no other file of the package uses private parts of torch.

With the public functions `torch.export.export` and `torch.onnx.export` alone, the models are the same, but an export takes
several times as long. Private parts may change with every version of torch: `CHECKED` lists the versions that were tested, and
`tests/test_torch_internals.py` reports each part that is missing or works differently.
"""

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache, cached_property, partial
from typing import Any

import onnx
import torch
from torch import Tensor, nn

from ..errors import MembraneError

CHECKED = ("2.13.0",)
"""Tested versions of torch."""

try:
    from onnx_ir.schemas import OpSignature
    from torch._dispatch.python import enable_python_dispatcher
    from torch._functorch.aot_autograd import FQN, GraphSignature
    from torch._subclasses.fake_tensor import FakeTensorMode
    from torch._subclasses.functional_tensor import FunctionalTensorMode, dispatch_functionalize
    from torch.export import _trace
    from torch.export.exported_program import (
        _override_composite_implicit_decomp,
        _split_decomp_table_to_cia_and_python_decomp,
    )
    from torch.fx.experimental.proxy_tensor import make_fx
    from torch.nn.utils.stateless import _reparametrize_module
    from torch.onnx._internal.exporter import _fx_passes
    from torch.onnx._internal.exporter._decomp import (
        create_onnx_friendly_decomposition_table,
        get_onnx_implemented_overloads,
    )
    from torch.onnx._internal.exporter._registration import ONNXRegistry
    from torch.onnx._internal.fx.passes.type_promotion import _TypePromotionInterpreter, get_type_promotion_rule
    from torch.utils._pytree import tree_flatten, tree_leaves, tree_map, tree_unflatten
except ImportError as error:
    if not (error.name or "").startswith("torch"):
        raise  # onnxscript is not installed
    raise MembraneError(
        f"export: torch {torch.__version__} lacks a private part that the export needs ({error}); expected a version with "
        f"which it was tried: {', '.join(CHECKED)}"
    ) from error

__all__ = ["CHECKED", "TorchExporter", "empty_batches", "replaced", "tree_flatten", "tree_leaves", "tree_map", "tree_unflatten"]


def empty_batches(values: Iterable[Tensor], frames: int) -> tuple[Tensor, ...]:
    """Return tensors for tracing that take no memory: like the values, but with a batch of this length (except scalars)."""
    with FakeTensorMode(allow_non_fake_inputs=True):
        return tuple(
            torch.empty(frames, *value.shape[1:], dtype=value.dtype) if value.ndim else torch.empty_like(value)
            for value in values
        )


@contextmanager
def replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Replace an attribute of a module or a class within this context, and restore it afterwards.

    Raises:
        MembraneError: the module or class does not define this attribute.
    """
    if name not in vars(owner):
        raise MembraneError(
            f"export: torch {torch.__version__} has no {owner.__name__}.{name}, which the export replaces; expected a version "
            f"with which it was tried: {', '.join(CHECKED)}"
        )
    before = vars(owner)[name]
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


class TorchExporter:
    """Torch's ONNX exporter without the work that it repeats for every model.

    Args:
        translations: functions that translate operators of torch to ONNX, by operator; they replace torch's own.
    """

    def __init__(self, translations: dict[Any, Callable[..., Any]]) -> None:
        self.translations = translations
        self._registries: dict[Any, ONNXRegistry] = {}
        self._is_at_work = False
        self._from_torchlib = ONNXRegistry.from_torchlib

    def _registry(self, **options: Any) -> ONNXRegistry:
        """Return torch's operators with the translations, cached: torch would read them for every model, a second each."""
        key = tuple(options.items())
        if key not in self._registries:
            self._registries[key] = self._from_torchlib(**options)
            for operator, translation in self.translations.items():
                self._registries[key].register_op(operator, translation)
        return self._registries[key]

    @cached_property
    def _decompositions(self) -> tuple[dict[Any, Any], ...]:
        """Decompositions of operators that are missing in ONNX."""
        table: dict[Any, Any] = create_onnx_friendly_decomposition_table(set(get_onnx_implemented_overloads(self._registry())))
        return _split_decomp_table_to_cia_and_python_decomp(table)

    def captured(self, module: nn.Module, examples: tuple[Tensor, ...]) -> torch.export.ExportedProgram:
        """Capture the module as a program of operators that exist in ONNX; call this method within `at_work`.

        Torch's exporter first captures a program of its own operators, and decomposes them in a second step.
        """
        _, decomposed = self._decompositions
        at_once = partial(_trace._export_to_aten_ir, decomp_table=decomposed)
        with ExitStack() as stack:
            stack.enter_context(replaced(_trace, "_export_to_aten_ir", at_once))
            stack.enter_context(replaced(_trace, "_aot_export_joint_with_descriptors", _captured_once))
            stack.enter_context(replaced(torch.fx.config, "do_not_emit_stack_traces", True))  # models do not contain them
            return _trace._export(module, examples, strict=False, pre_dispatch=False)

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """Make `torch.onnx.export` of a `captured` program skip repeated work within this context.

        Contexts may be nested; the outer one prepares everything.
        """
        if self._is_at_work:
            yield
            return
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns about torchvision, which is not needed
        with ExitStack() as stack:
            self._is_at_work = True
            stack.callback(setattr, self, "_is_at_work", False)
            stack.enter_context(_override_composite_implicit_decomp(self._decompositions[0]))
            for owner, name, value in (
                (ONNXRegistry, "from_torchlib", staticmethod(self._registry)),
                (_TypePromotionInterpreter, "run_node", _promoted),
                (_fx_passes, "decompose_with_registry", _as_it_is),
                (OpSignature, "from_op_schema", staticmethod(_signature)),
            ):
                stack.enter_context(replaced(owner, name, value))
            yield


def _captured_once(
    stack: ExitStack,
    module: nn.Module,
    args: tuple[Any, ...],
    *,
    kwargs: dict[str, Any],
    decompositions: dict[Any, Any],
    **_: Any,
) -> tuple[torch.fx.GraphModule, GraphSignature]:
    """Return the operators of a module that modifies none of its tensors, and descriptions of its inputs and outputs.

    Torch's own function runs the module an additional time, to find which tensors it modifies.
    """
    parameters, buffers = ([FQN(name) for name, _ in named()] for named in (module.named_parameters, module.named_buffers))
    held = [*parameters, *buffers]

    def function(*tensors: Tensor) -> Any:
        with _reparametrize_module(module, dict(zip(held, tensors, strict=False))):
            return module(*tensors[len(held) :])

    mode = FunctionalTensorMode(export=True)
    tensors = [*(module.get_parameter(name) for name in parameters), *(module.get_buffer(name) for name in buffers), *args]
    with enable_python_dispatcher():
        graph = make_fx(dispatch_functionalize(function, mode), decompositions, _disable_torch_fn_metadata_mode=True)(*tensors)
    graph.graph.eliminate_dead_code()
    graph.recompile()
    *nodes, output = graph.graph.nodes
    for node in nodes:
        node.meta.setdefault("nn_module_stack", {})  # the enclosing modules, which the model does not contain
    inputs = [node.name for node in nodes if node.op == "placeholder"]
    returned, structure = tree_flatten(output.args[0])
    signature = GraphSignature(
        parameters=parameters,
        buffers=buffers,
        user_inputs=inputs[len(held) :],
        user_outputs=[node.name for node in returned],
        inputs_to_parameters=dict(zip(inputs, parameters, strict=False)),
        inputs_to_buffers=dict(zip(inputs[len(parameters) :], buffers, strict=False)),
        buffers_to_mutate={},
        parameters_to_mutate={},
        user_inputs_to_mutate={},
        in_spec=tree_flatten((args, kwargs))[1],
        out_spec=structure,
        backward_signature=None,
        input_tokens=[],
        output_tokens=[],
    )
    return graph, signature


_from_op_schema = OpSignature.from_op_schema


@cache
def _signature_of(name: str, domain: str, version: int) -> OpSignature:
    return _from_op_schema(onnx.defs.get_schema(name, version, domain))


def _signature(schema: onnx.defs.OpSchema) -> OpSignature:
    """Return the signature of an ONNX operator, cached because torch's exporter reads it again for every node."""
    return _signature_of(schema.name, schema.domain, schema.since_version)


def _as_it_is(program: torch.export.ExportedProgram, registry: ONNXRegistry) -> torch.export.ExportedProgram:
    """Return the `captured` program unchanged, because it is already decomposed."""
    return program


def _promoted(interpreter: _TypePromotionInterpreter, node: torch.fx.Node) -> Any:
    """Promote the operands of a node to a common type, as a pass of torch's exporter does.

    Torch's pass also recomputes nodes that it leaves unchanged, which takes a fifth of the time of tracing.
    """
    if node.op != "call_function":
        return torch.fx.Interpreter.run_node(interpreter, node)
    with interpreter._set_current_node(node):
        rule = get_type_promotion_rule(node, interpreter.type_promotion_table)
        if rule is not None:
            interpreter._maybe_promote_node(node, rule)
    return node.meta.get("val")
