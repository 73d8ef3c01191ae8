"""Control flow that is written once and runs eagerly, compiled and exported to ONNX.

An estimator or a locator marks the methods that do its work as `traced`, and joins them by the functions below. Given tensors,
these compute the result at once. Given a `Value`, which stands for a tensor of an ONNX graph that is being written, they add
nodes to that graph instead; between two `traced` methods a `Value` can only be passed on.

Each function has one meaning: it gives the same values on every device, inside `torch.compile` and `torch.export`, and in an
exported model. `tests/test_control_flow.py` compares them. What differs is how much is computed: where Python cannot read a
tensor (`can_sync`), both sides of a branch are, and the result is selected from them.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import Any, ParamSpec, Protocol, TypeVar

import torch

Inputs = ParamSpec("Inputs")
Output = TypeVar("Output")

NAMED = "torchmembrane"
"""The ONNX domain of the nodes that stand for an `onnx_function`."""
FUNCTIONS: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {}
"""Every `onnx_function` by its name."""
_writing = False  # a plain name: torch.compile of earlier versions than 2.13 reads no ContextVar


class Graph(Protocol):
    """An ONNX graph that is being written; its methods add nodes and return `Value`s for their outputs."""

    def call(self, owner: Any, function: Callable[..., Any], inputs: Sequence[Any]) -> Any:
        """Add `function(owner, *inputs)`."""
        ...

    def fori_loop(
        self, step: Callable[..., Any], rows: Sequence[tuple[float, ...]], state: Sequence[Any], given: Sequence[Any]
    ) -> Any:
        """Add a loop; arguments as of the function `fori_loop`."""
        ...

    def repeat_rows(self, step: Callable[..., Any], count: int, state: Sequence[Any], given: Sequence[Any]) -> Any:
        """Add a loop that ends when all rows are done; arguments as of the function `repeat_rows`."""
        ...

    def cond(self, done: Any, values: Sequence[Any], otherwise: Callable[[], Sequence[Any]]) -> Any:
        """Add a branch; arguments as of the function `cond`."""
        ...


class Value:
    """A tensor of an ONNX `graph` that is being written."""

    def __init__(self, graph: Graph):
        self.graph = graph


def traced(method: Callable[Inputs, Output]) -> Callable[Inputs, Output]:
    """Decorate a method that an ONNX graph holds as the nodes of one trace.

    Called with tensors, eagerly or compiled, it is the method itself.

    Args:
        method: a method of a module. It takes and returns tensors or tuples of tensors.

    Returns:
        The method, which also accepts `Value`s; given these, it returns `Value`s.

    Example:
        >>> import torch
        >>> class Doubling(torch.nn.Module):
        ...     @traced
        ...     def forward(self, x):
        ...         return 2 * x
        >>> Doubling()(torch.tensor(3))
        tensor(6)
    """

    @wraps(method)
    def called(*owner_and_inputs: Inputs.args, **options: Inputs.kwargs) -> Output:
        graph = _graph(owner_and_inputs[1:])
        if graph is None:
            return method(*owner_and_inputs, **options)
        written: Output = graph.call(owner_and_inputs[0], method, owner_and_inputs[1:])
        return written

    return called


def onnx_function(function: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[torch.Tensor], torch.Tensor]:
    """Decorate a function that is traced for ONNX once for each shape and precision, however often it is called.

    In the trace of a `traced` method a call is one node of the domain `NAMED`, which the exporter replaces by the function's
    own nodes. Eagerly and compiled it is the function itself.

    Args:
        function: maps a tensor to a tensor of the same shape and type.
    """

    @wraps(function)
    def called(value: torch.Tensor) -> torch.Tensor:
        if not (_writing and torch.compiler.is_exporting()):
            return function(value)
        kept: torch.Tensor = torch.onnx.ops.symbolic(
            f"{NAMED}::{function.__name__}",
            (value,),
            {"sizes": [*value.shape[1:]], "bytes": value.element_size()},
            dtype=value.dtype,
            shape=value.shape,
        )
        return kept

    FUNCTIONS[function.__name__] = function
    return called


@contextmanager
def writing() -> Iterator[None]:
    """Within the block, trace each call of an `onnx_function` as one node."""
    global _writing
    before, _writing = _writing, True
    try:
        yield
    finally:
        _writing = before


def fori_loop(
    step: Callable[..., Any], rows: int | Sequence[tuple[float, ...]], state: Sequence[Any], *given: Any
) -> Sequence[Any]:
    """Repeat `state = step(*state, *given, *row)` for every row, and return the last state.

    A compiled graph unrolls the steps; an exported model contains a Loop.

    Args:
        step: a `traced` method that returns the next state.
        rows: the numbers that each step is given, or the number of steps.
        state: initial values of what the steps change.
        given: the values that the steps only read.

    Example:
        >>> fori_loop(lambda x, y, rate: (x + rate * y,), [(0.5,), (0.25,)], (1.0,), 4.0)
        (4.0,)
    """
    graph, table = _graph((*state, *given)), [()] * rows if isinstance(rows, int) else rows
    if graph is not None:
        written: Sequence[Any] = graph.fori_loop(step, table, state, given)
        return written
    for row in table:
        state = step(*state, *given, *row)
    return state


def cond(done: Any, values: Sequence[Any], otherwise: Callable[[], Sequence[Any]]) -> Sequence[Any]:
    """Return `values` if `done` holds in every row, otherwise the result of `otherwise()`.

    Eagerly and in an exported model, `otherwise` runs only if `done` is false in some row; where Python cannot read `done`, it
    always runs.

    Args:
        done: `[B]` bool, the rows whose `values` are final.
        values: tensors, returned if all rows are done.
        otherwise: a function that returns as many tensors of the same shapes.

    Example:
        >>> cond(torch.tensor([True, False]), [torch.tensor(1)], lambda: [torch.tensor(2)])
        [tensor(2)]
    """
    graph = _graph(values)
    if graph is not None:
        written: Sequence[Any] = graph.cond(done, values, otherwise)
        return written
    if can_sync(done):
        return values if bool(done.all()) else otherwise()
    all_done = done.all()
    return [torch.where(all_done, value, other) for value, other in zip(values, otherwise(), strict=True)]


def chunked(
    size: int, function: Callable[..., Sequence[torch.Tensor]], given: Sequence[Any], *constants: Any
) -> Sequence[torch.Tensor]:
    """Return `function(*given, *constants)`, computed on a CPU in chunks of at most `size` rows.

    On a CPU, larger batches do not fit the cache. Other devices, compiled graphs and exported models process all rows at once.

    Args:
        size: largest number of rows in a chunk.
        function: returns tensors `[B, ...]` of which each row depends only on the same row of `given`.
        given: tensors `[B, ...]`, or None, that are split into chunks.
        constants: arguments that all rows share.

    Example:
        >>> chunked(2, lambda x, add: (x + add, 2 * x), [torch.arange(3)], 1)
        [tensor([1, 2, 3]), tensor([0, 2, 4])]
    """
    if _graph(given) is not None or torch.compiler.is_compiling() or not given[0].is_cpu or len(given[0]) <= size:
        return function(*given, *constants)
    rows = range(0, len(given[0]), size)
    parts = [function(*(None if one is None else one[k : k + size] for one in given), *constants) for k in rows]
    return [torch.cat(values) for values in zip(*parts, strict=True)]


def in_inference_mode(function: Callable[..., Output], *given: Any) -> Output:
    """Return `function(*given)`, computed in inference mode if gradients are disabled.

    Inference mode saves a tenth of the time of many small tensors. The result is a copy that may take part in later
    computations of gradients. Compiled graphs and exported models have no such mode.

    Args:
        function: returns a named tuple of tensors.
        given: arguments of the function.

    Example:
        >>> from typing import NamedTuple
        >>> class Twice(NamedTuple):
        ...     value: torch.Tensor
        >>> with torch.no_grad():
        ...     found = in_inference_mode(lambda x: Twice(2 * x), torch.tensor(3.0))
        >>> found, found.value.is_inference()
        (Twice(value=tensor(6.)), False)
    """
    if torch.is_grad_enabled() or torch.compiler.is_compiling() or _graph(given) is not None:
        return function(*given)
    with torch.inference_mode():
        found: Any = function(*given)
    copies: Output = type(found)(*(value.clone() for value in found))
    return copies


def where_rows(done: torch.Tensor, values: Sequence[torch.Tensor], others: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Select `values` in the rows where `done` holds, and `others` in the rest.

    This function consists of tensor operations only: call it within a `traced` method.

    Args:
        done: `[B]` bool, the rows that are taken from `values`.
        values: tensors `[B, ...]`.
        others: tensors of the same shapes, for the other rows.

    Returns:
        The selected tensors.

    Example:
        >>> where_rows(torch.tensor([True, False]), [torch.tensor([1, 2])], [torch.tensor([3, 4])])
        [tensor([1, 4])]
    """
    return [
        torch.where(done.reshape(-1, *(1,) * (value.ndim - 1)), value, other)
        for value, other in zip(values, others, strict=True)
    ]


def repeat_rows(step: Callable[..., Sequence[Any]], count: int, state: Sequence[Any], given: Sequence[Any]) -> Sequence[Any]:
    """Repeat `state = step(*state, *given)` in the rows that are not done, at most `count` times, and return the last state.

    Eagerly, rows that are done are left out of further steps; on an accelerator every step takes one synchronisation, to read
    which these are. An exported model contains a Loop that computes all rows and ends when all are done; a graph in which
    tensors cannot be read takes all steps.

    Args:
        step: a `traced` method that returns the next state.
        count: largest number of steps.
        state: tensors `[B, ...]`, initial values of what the steps change; the first says which rows are done, `[B]` bool.
        given: tensors `[B, ...]`, or None, that the steps only read.

    Returns:
        The state. Rows that were done before a step keep their values.

    Example:
        >>> x = torch.tensor([1.0, 3.0, 8.0])
        >>> repeat_rows(lambda done, x: (x > 1.9, 2 * x), 2, (x > 5, x), ())
        [tensor([True, True, True]), tensor([4., 6., 8.])]
    """
    graph = _graph(state)
    if graph is not None:
        written: Sequence[Any] = graph.repeat_rows(step, count, state, given)
        return written
    if not can_sync(state[0]):
        for _ in range(count):
            state = where_rows(state[0], state, step(*state, *given))
        return state
    whole, here, those, rows = list(state), list(state), list(given), torch.arange(len(state[0]), device=state[0].device)
    for _ in range(count):
        left = (~here[0]).nonzero().ravel()
        if len(left) < len(rows):
            whole = [value.index_copy(0, rows, part) for value, part in zip(whole, here, strict=True)]
            here, those = ([None if value is None else value[left] for value in values] for values in (here, those))
            rows = rows[left]
        if len(rows) == 0:
            return whole
        here = list(step(*here, *those))
    return [value.index_copy(0, rows, part) for value, part in zip(whole, here, strict=True)]


def can_sync(value: torch.Tensor) -> bool:
    """Return whether Python can read a tensor's values now, if necessary after waiting for its device.

    It cannot while a graph is compiled or exported, on the meta device, or while a CUDA graph is recorded.
    """
    if torch.compiler.is_compiling() or value.is_meta:
        return False
    return not (value.is_cuda and torch.cuda.is_current_stream_capturing())


def _graph(values: Sequence[Any]) -> Graph | None:
    """Return the graph of the first `Value` among `values` and the tuples in them, or None without one."""
    for value in values:
        graph = value.graph if isinstance(value, Value) else _graph(value) if isinstance(value, (tuple, list)) else None
        if graph is not None:
            return graph
    return None
