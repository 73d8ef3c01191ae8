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
from functools import partial, wraps
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
        method: method of a module; it takes and gives tensors, or tuples of them.

    Returns:
        The method, which also accepts `Value`s and then returns them.

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
        function: from a tensor to one of the same shape and type.
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
    """Within, each call of an `onnx_function` is traced as one node."""
    global _writing
    before, _writing = _writing, True
    try:
        yield
    finally:
        _writing = before


def fori_loop(
    step: Callable[..., Any], rows: int | Sequence[tuple[float, ...]], state: Sequence[Any], *given: Any
) -> Sequence[Any]:
    """Repeat `state = step(*state, *given, *row)` for every row, and give the last state.

    A compiled graph holds the steps one after another, an exported model as a Loop.

    Args:
        step: a `traced` method that gives the next state.
        rows: the numbers of each step, or how many steps there are.
        state: the values that a step changes.
        given: the values that it only reads.

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
    """Give `values` if `done` holds in every row, or else `otherwise()`.

    Eagerly and in an exported model `otherwise` runs only if a row is not done; where Python cannot read `done` it always runs.

    Args:
        done: `[B]` bool.
        values: tensors.
        otherwise: gives as many tensors, of the same shapes.

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
    """Give `function(*given, *constants)`, on a processor computed for at most `size` rows at a time.

    There larger batches do not stay in the cache. Other devices, compiled graphs and exported models take all rows at once.

    Args:
        size: rows of a part.
        function: gives tensors `[B, ...]`, each row from the same row of `given`.
        given: tensors `[B, ...]`, or None.
        constants: what all rows share.

    Example:
        >>> chunked(2, lambda x, add: (x + add, 2 * x), [torch.arange(3)], 1)
        [tensor([1, 2, 3]), tensor([0, 2, 4])]
    """
    if _graph(given) is not None or torch.compiler.is_compiling() or not given[0].is_cpu or len(given[0]) <= size:
        return function(*given, *constants)
    rows = range(0, len(given[0]), size)
    parts = [function(*(None if one is None else one[k : k + size] for one in given), *constants) for k in rows]
    return [torch.cat(values) for values in zip(*parts, strict=True)]


def stacked(
    function: Callable[..., Sequence[torch.Tensor]], starts: Sequence[Sequence[Any]], given: Sequence[Any]
) -> list[Sequence[Any]]:
    """Give `function(start, given)` for every start.

    Tensors are joined to one batch, which takes little longer than one start where they are few and small. In an exported model
    the starts follow one another.

    Args:
        function: gives tensors `[B, ...]`, each row from the same row of its arguments.
        starts: sequences of as many tensors `[B, ...]`.
        given: a named tuple of tensors `[B, ...]`, or None, that all starts share.

    Returns:
        What the function gives, by start.

    Example:
        >>> from typing import NamedTuple
        >>> class Rate(NamedTuple):
        ...     value: torch.Tensor
        >>> starts = [(torch.tensor([1.0, 2.0]),), (torch.tensor([3.0, 4.0]),)]
        >>> stacked(lambda start, rate: [start[0] * rate.value], starts, Rate(torch.tensor([1.0, 10.0])))
        [[tensor([ 1., 20.])], [tensor([ 3., 40.])]]
    """
    if _graph((*starts, given)) is not None:
        return [function(start, given) for start in starts]
    count = len(starts)
    together = [torch.cat(values) for values in zip(*starts, strict=True)]
    for_each = [None if value is None else value.repeat(count, *(1,) * (value.ndim - 1)) for value in given]
    found = [value.chunk(count) for value in function(together, type(given)(*for_each))]
    return [list(values) for values in zip(*found, strict=True)]


def in_inference_mode(function: Callable[..., Output], *given: Any) -> Output:
    """Give `function(*given)`, computed in inference mode where no gradient is recorded.

    That saves a tenth of the time of many small tensors. The result is a copy of which gradients may be taken later. Compiled
    graphs and exported models have no such mode.

    Args:
        function: gives a named tuple of tensors.
        given: its arguments.

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

    It is a formula of tensors: call it within a `traced` method.

    Args:
        done: `[B]` bool.
        values: tensors `[B, ...]`.
        others: tensors of the same shapes.

    Returns:
        The tensors selected.

    Example:
        >>> where_rows(torch.tensor([True, False]), [torch.tensor([1, 2])], [torch.tensor([3, 4])])
        [tensor([1, 4])]
    """
    return [
        torch.where(done.reshape(-1, *(1,) * (value.ndim - 1)), value, other)
        for value, other in zip(values, others, strict=True)
    ]


def retry_rows(
    done: Any,
    values: Sequence[Any],
    again: Callable[..., Sequence[Any]],
    given: Sequence[Any],
    chosen: Callable[..., Any] | None = None,
) -> Sequence[Any]:
    """Give `values` in the rows where `done` holds, and what `again(*given)` gives in the rest.

    Eagerly only the rows that are not done are computed again, on a device after one wait for `done`. An exported model
    computes all rows again if one of them is not done, and a graph in which `done` cannot be read always does.

    Args:
        done: `[B]` bool.
        values: tensors `[B, ...]`.
        again: gives as many tensors of the same shapes, each row from the same row of `given`.
        given: tensors `[B, ...]`, or None.
        chosen: a `traced` method `chosen(done, values, others)` that selects row by row what is taken in place of all of
            `others`; it gives `values` where `done` holds.

    Returns:
        The tensors. No gradient of `given` passes through `again` in rows that are done.

    Example:
        >>> x = torch.tensor([1.0, 2.0])
        >>> retry_rows(x > 1, [x], lambda x: [10 * x], [x])
        [tensor([10.,  2.])]
    """
    chosen = partial(_retried, None) if chosen is None else chosen
    if _graph(values) is not None:
        return cond(done, values, lambda: chosen(done, values, again(*given)))
    if not can_sync(done):
        unfinished = (None if one is None else where_rows(done, [one.detach()], [one])[0] for one in given)
        taken: Sequence[Any] = chosen(done, values, again(*unfinished))
        return taken
    rows = (~done).nonzero().ravel()
    if len(rows) == 0:
        return values
    others = again(*(None if one is None else one[rows] for one in given))
    taken = chosen(done[rows], [value[rows] for value in values], others)
    return [value.index_copy(0, rows, other) for value, other in zip(values, taken, strict=True)]


@traced
def _retried(_: None, done: torch.Tensor, values: Sequence[torch.Tensor], others: Sequence[torch.Tensor]) -> Any:
    return where_rows(done, values, others)


def can_sync(value: torch.Tensor) -> bool:
    """Whether Python can read a tensor's values now, if need be after a wait for its device.

    It cannot in a graph that is being compiled or exported, on the meta device, and while a CUDA graph is recorded.
    """
    if torch.compiler.is_compiling() or value.is_meta:
        return False
    return not (value.is_cuda and torch.cuda.is_current_stream_capturing())


def _graph(values: Sequence[Any]) -> Graph | None:
    """The graph of the first `Value` among the values, or in tuples among them."""
    for value in values:
        graph = value.graph if isinstance(value, Value) else _graph(value) if isinstance(value, (tuple, list)) else None
        if graph is not None:
            return graph
    return None
