"""The order of an estimator's or a locator's steps, written once: for tensors, which take them at once, and for the exporter.

A method that is a `traced`, `fori_loop` and `cond` do on tensors what they say. Given a `Value`, which stands for a tensor in a
graph that is being written, they are added to its `graph` instead. Between pieces values are only handed on.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial, wraps
from typing import Any, ParamSpec, Protocol, TypeVar

import torch

Inputs = ParamSpec("Inputs")
Output = TypeVar("Output")

NAMED = "torchmembrane"
FUNCTIONS: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {}
_writing = ContextVar("writing", default=False)


class Graph(Protocol):
    """What writes a graph, piece by piece."""

    def call(self, owner: Any, function: Callable[..., Any], inputs: Sequence[Any]) -> Any:
        """Values of `function(owner, *inputs)`."""
        ...

    def fori_loop(
        self, step: Callable[..., Any], rows: Sequence[tuple[float, ...]], state: Sequence[Any], given: Sequence[Any]
    ) -> Any:
        """Values as `fori_loop` gives them."""
        ...

    def cond(self, done: Any, values: Sequence[Any], otherwise: Callable[[], Sequence[Any]]) -> Any:
        """Values as `cond` gives them."""
        ...


class Value:
    """A tensor to be, in a `graph`."""

    def __init__(self, graph: Graph):
        self.graph = graph


def traced(method: Callable[Inputs, Output]) -> Callable[Inputs, Output]:
    """Make a method one that a graph holds as it is traced once.

    Args:
        method: of a module, from tensors or tuples of them to those.

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
    """Make a function, to a tensor of the shape and type of its argument, one that a piece being traced holds as one node of
    the domain `NAMED`, its type the function's name: its own nodes are traced once for every shape and precision."""

    @wraps(function)
    def called(value: torch.Tensor) -> torch.Tensor:
        if not _writing.get():
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
    """Within, functions that are `named` are nodes."""
    token = _writing.set(True)
    try:
        yield
    finally:
        _writing.reset(token)


def fori_loop(
    step: Callable[..., Any], rows: int | Sequence[tuple[float, ...]], state: Sequence[Any], *given: Any
) -> Sequence[Any]:
    """Take `state = step(*state, *given, *row)` for every row.

    Args:
        step: a piece that gives the state.
        rows: the numbers of every step, or how many steps.
        state: what a step changes.
        given: what it does not.

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
    """Take what `otherwise` gives, which is `values` where `done` holds: worked out only if somewhere it does not, but for a
    compiled graph, and for a device that would have to be waited for.

    Args:
        done: `[B]` bool.
        values: what there is.
        otherwise: gives values of the same number and shapes.
    """
    graph = _graph(values)
    if graph is None:
        return values if can_sync(done) and bool(done.all()) else otherwise()
    written: Sequence[Any] = graph.cond(done, values, otherwise)
    return written


def chunked(
    size: int, function: Callable[..., Sequence[torch.Tensor]], given: Sequence[Any], *constants: Any
) -> Sequence[torch.Tensor]:
    """`function(*given, *constants)` of at most so many rows at a time: in a larger batch a processor waits for its memory.

    A graph, a compiled one too, and a device that would have to be waited for, take all rows at once.

    Args:
        size: rows of a part.
        function: gives tensors `[B, ...]`.
        given: what it needs of each row, `[B, ...]` or None.
        constants: what it needs of all.

    Example:
        >>> chunked(2, lambda x, add: (x + add, x[:1]), [torch.arange(3)], 1)
        [tensor([1, 2, 3]), tensor([0, 2])]
    """
    if _graph(given) is not None or not can_sync(given[0]) or len(given[0]) <= size:
        return function(*given, *constants)
    rows = range(0, len(given[0]), size)
    parts = [function(*(None if one is None else one[k : k + size] for one in given), *constants) for k in rows]
    return [torch.cat(values) for values in zip(*parts, strict=True)]


def stacked(
    function: Callable[..., Sequence[torch.Tensor]], starts: Sequence[Sequence[Any]], given: Sequence[Any]
) -> list[Sequence[Any]]:
    """`function(start, given)` of every start: of tensors at once, in one batch, which takes little longer than one where they
    are few and small; in a graph one after the other.

    Args:
        function: gives tensors `[B, ...]`.
        starts: tensors `[B, ...]` each.
        given: what it needs besides, named: `[B, ...]` or None.

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
    """`function(*given)`, a named tuple of tensors; where no gradient is recorded in inference mode, a tenth faster for many
    small tensors, of which copies come out that gradients may be taken of later.

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
    """`values` in the rows where `done [B]` holds, else `others`; each `[B, ...]`."""
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
    """Take `values` in the rows where `done` holds, else what `chosen` makes of them and of what `again(*given)` gives.

    Tensors: nothing is worked out where all is done, and only the rows that are not where some are; a compiled graph, and a
    device that would have to be waited for, take `values`. A graph works all rows out if one is not done.

    Args:
        done: `[B]` bool.
        values: what there is, each `[B, ...]`.
        again: gives values of the same number and shapes.
        given: what it needs, each `[B, ...]` or None.
        chosen: a piece, `chosen(done, values, others)`: `values` where `done` holds, else what is taken of the others;
            default: all of them.
    """
    chosen = chosen or partial(_taken, None)
    if _graph(values) is not None:
        return cond(done, values, lambda: chosen(done, values, again(*given)))
    if not can_sync(done) or bool(done.all()):
        return values
    rows = (~done).nonzero().ravel()
    others = again(*(None if one is None else one[rows] for one in given))
    taken = chosen(done[rows], [value[rows] for value in values], others)
    return [value.index_copy(0, rows, other) for value, other in zip(values, taken, strict=True)]


@traced
def _taken(_: None, done: torch.Tensor, values: Sequence[torch.Tensor], others: Sequence[torch.Tensor]) -> Any:
    return where_rows(done, values, others)


def can_sync(done: torch.Tensor) -> bool:
    """Whether its values can be looked at now."""
    return done.device.type == "cpu" and not torch.compiler.is_compiling()


def _graph(values: Sequence[Any]) -> Graph | None:
    """The graph of the first `Value` among them, or in tuples among them."""
    for value in values:
        graph = value.graph if isinstance(value, Value) else _graph(value) if isinstance(value, (tuple, list)) else None
        if graph is not None:
            return graph
    return None
