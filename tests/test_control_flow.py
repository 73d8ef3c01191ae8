"""Control flow is the same eager, compiled, exported and on a GPU."""

from inspect import isfunction
from typing import NamedTuple

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import nn

from torchmembrane import control_flow
from torchmembrane.control_flow import (
    can_sync,
    chunked,
    cond,
    fori_loop,
    in_inference_mode,
    onnx_function,
    repeat_rows,
    traced,
    where_rows,
)
from torchmembrane.onnx import export

X = torch.tensor([[1.0, 4.0], [9.0, 0.25], [0.5, 2.0]])
DONE = {"all": [2.0, 2.0, 2.0], "none": [-1.0, -2.0, -1.0], "some": [3.0, -1.0, 1.0]}
"""Numbers above zero where a row is done."""

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
STEPS = (2, 3, 1)
"""Steps of `Verbs.until` after which each row of `X` is done."""
done_so = pytest.mark.parametrize("sign", [torch.tensor(values) for values in DONE.values()], ids=DONE)


class Pair(NamedTuple):
    x: torch.Tensor
    sign: torch.Tensor


@onnx_function
def cubed(x):
    return x * x * x


class Verbs(nn.Module):
    """A use of each function, from `x [B, 2]` and `sign [B]` to one tensor `[B, ...]`."""

    def __init__(self):
        super().__init__()
        self.register_buffer("share", torch.tensor([0.5, 0.25]))

    @traced
    def is_done(self, sign):
        return sign > 0

    @traced
    def first(self, x):
        return (self.share * x,)

    @traced
    def second(self, x, sign):
        return (x.sqrt() + sign[:, None],)

    @traced
    def grown(self, x, given, rate):
        return (x + rate * given * x,)

    @traced
    def mixed(self, x, given, rate):
        return (rate * x + given,)

    @traced
    def until(self, done, x, sign):
        after = x.sqrt() + self.share
        return (after - x).abs().amax(-1) < 0.8, after, sign

    @traced
    def cubed(self, x):
        return cubed(x) + cubed(x + 1)

    @traced
    def selected(self, x, sign):
        return where_rows(sign > 0, [x], [-x])

    def traced(self, x, sign):
        return self.first(x)[0]

    def onnx_function(self, x, sign):
        return self.cubed(x)

    def fori_loop(self, x, sign):
        return fori_loop(self.mixed, [(0.5,), (0.25,), (2.0,)], (x,), x)[0]

    def cond(self, x, sign):
        return cond(self.is_done(sign), self.first(x), lambda: self.second(x, sign))[0]

    def chunked(self, x, sign):
        return chunked(2, self.second, [x, sign])[0]

    def in_inference_mode(self, x, sign):
        return in_inference_mode(lambda x: Pair(self.cubed(x), self.cubed(x)), x).sign

    def where_rows(self, x, sign):
        return self.selected(x, sign)[0]

    def repeat_rows(self, x, sign):
        return repeat_rows(self.until, 3, (self.is_done(sign), x, sign), ())[1]


class Watched(Verbs):
    """Keeps how many rows every call was given."""

    def __init__(self):
        super().__init__()
        self.asked = []

    def second(self, x, sign):
        self.asked.append(len(x))
        return super().second(x, sign)

    def until(self, done, x, sign):
        self.asked.append(len(x))
        return super().until(done, x, sign)


def expected(verb, sign):
    """In closed form."""
    done, first, second = (sign > 0)[:, None], X * torch.tensor([0.5, 0.25]), X.sqrt() + sign[:, None]
    repeated = [X]
    for _ in range(3):
        repeated.append(repeated[-1].sqrt() + torch.tensor([0.5, 0.25]))
    steps = [0 if sign[row] > 0 else STEPS[row] for row in range(len(X))]
    return {
        "traced": first,
        "onnx_function": X**3 + (X + 1) ** 3,
        "fori_loop": 2 * (0.25 * (0.5 * X + X) + X) + X,
        "cond": first if done.all() else second,
        "chunked": second,
        "in_inference_mode": X**3 + (X + 1) ** 3,
        "where_rows": torch.where(done, X, -X),
        "repeat_rows": torch.stack([repeated[count][row] for row, count in enumerate(steps)]),
    }[verb]


VERBS = [name for name, value in vars(control_flow).items() if isfunction(value) and value.__module__ == control_flow.__name__]
APART = {"can_sync", "writing"}
"""Functions that give no tensors."""
every_verb = pytest.mark.parametrize("verb", [name for name in VERBS if name not in APART and not name.startswith("_")])


def exported(function, *inputs):
    """What a function of `Value`s gives as an ONNX model."""
    tracer, names = export.Tracer(), [f"x{k}" for k in range(len(inputs))]
    found = function(*(tracer.given(name, value) for name, value in zip(names, inputs, strict=True)))
    tracer.assembly.named(found.name, "result")
    given = [
        onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", *value.shape[1:]])
        for name, value in zip(names, inputs, strict=True)
    ]
    result = onnx.helper.make_tensor_value_info("result", onnx.TensorProto.FLOAT, ["batch", *found.example.shape[1:]])
    model = tracer.assembly.model(given, [result], {}).SerializeToString()
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    return lambda *values: torch.from_numpy(session.run(None, {k: v.numpy() for k, v in zip(names, values, strict=True)})[0])


def assert_verb(verb, run, device="cpu"):
    """For a batch in which all rows are done, none and some, and for its rows one by one."""
    for sign in map(torch.tensor, DONE.values()):
        for rows in [slice(None), *(() if verb == "cond" else (slice(k, k + 1) for k in range(len(X))))]:
            found = run(X[rows].to(device), sign[rows].to(device))
            torch.testing.assert_close(found.cpu(), expected(verb, sign)[rows], rtol=1e-6, atol=1e-6)


@every_verb
def test_eagerly(verb):
    with torch.no_grad():
        assert_verb(verb, getattr(Verbs(), verb))
    assert_verb(verb, getattr(Verbs(), verb))


@every_verb
def test_compiled_to_one_graph(verb):
    torch.compiler.reset()
    with torch.no_grad():
        assert_verb(verb, torch.compile(getattr(Verbs(), verb), fullgraph=True, backend="eager", dynamic=False))


@every_verb
def test_exported_by_torch(verb):
    verbs = Verbs()
    verbs.forward = getattr(verbs, verb)
    program = torch.export.export(verbs, (X, torch.tensor(DONE["all"])), strict=False).module()
    for sign in map(torch.tensor, DONE.values()):
        torch.testing.assert_close(program(X, sign), expected(verb, sign), rtol=1e-6, atol=1e-6)


@every_verb
def test_exported_to_onnx(verb):
    assert_verb(verb, exported(getattr(Verbs(), verb), X[:2], torch.tensor(DONE["some"][:2])))


@needs_gpu
@every_verb
def test_on_a_gpu_and_compiled_there(verb):
    torch.compiler.reset()
    run = getattr(Verbs().to("cuda"), verb)
    with torch.no_grad():
        assert_verb(verb, run, "cuda")
        assert_verb(verb, torch.compile(run, fullgraph=True, backend="eager", dynamic=False), "cuda")


@needs_gpu
@done_so
def test_in_a_recorded_graph_of_a_gpu(sign):
    verbs, x, given = Verbs().to("cuda"), X.to("cuda"), sign.to("cuda")
    with torch.no_grad():
        verbs.repeat_rows(x, given)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            found = verbs.repeat_rows(x, given)
        graph.replay()
    torch.testing.assert_close(found.cpu(), expected("repeat_rows", sign))


@pytest.mark.parametrize("way", [lambda f: f, lambda f: torch.compile(f, fullgraph=True, backend="eager")])
@done_so
def test_gradients_come_from_what_was_taken(way, sign):
    """Of steps that were not taken in no part."""
    torch.compiler.reset()
    x = X.clone().requires_grad_()
    (found,) = torch.autograd.grad(way(Verbs().repeat_rows)(x, sign).sum(), x)
    at, by_closed_form = X.clone().requires_grad_(), []
    for row, count in enumerate(STEPS):
        value = at[row]
        for _ in range(0 if sign[row] > 0 else count):
            value = value.sqrt() + torch.tensor([0.5, 0.25])
        by_closed_form.append(value)
    torch.testing.assert_close(found, torch.autograd.grad(torch.stack(by_closed_form).sum(), at)[0])


@done_so
def test_eagerly_only_rows_that_are_not_done_take_a_step(sign):
    verbs = Watched()
    verbs.repeat_rows(X, sign)
    left = [sum(1 for row in range(len(X)) if sign[row] <= 0 and STEPS[row] > step) for step in range(3)]
    assert verbs.asked == [count for count in left if count]


def test_no_more_steps_are_taken_than_asked_for():
    """Of rows that are never done."""
    verbs, none = Watched(), torch.zeros(3, dtype=torch.bool)
    never = lambda done, x, sign: (done, *verbs.until(done, x, sign)[1:])  # noqa: E731
    assert torch.equal(repeat_rows(never, 0, (none, X, X[:, 0]), ())[1], X)
    repeat_rows(never, 5, (none, X, X[:, 0]), ())
    assert verbs.asked == 5 * [3]


def test_values_can_be_read_but_in_a_graph_and_on_the_meta_device():
    assert can_sync(X) and not can_sync(X.to("meta"))
    assert torch.compile(lambda x: x + can_sync(x), backend="eager")(X)[0, 0] == X[0, 0]
    verbs = Verbs().to("meta")
    for verb in ("cond", "repeat_rows", "chunked"):
        assert getattr(verbs, verb)(X.to("meta"), X[:, 0].to("meta")).shape == X.shape


@needs_gpu
def test_values_on_a_gpu_can_be_read():
    assert can_sync(X.to("cuda"))


def test_a_batch_is_computed_in_chunks_on_a_processor_alone():
    eager, compiled = Watched(), Watched()
    eager.chunked(X, X[:, 0])
    assert eager.asked == [2, 1]
    torch.compile(compiled.chunked, backend="eager")(X, X[:, 0])
    assert compiled.asked == [3]
    np.testing.assert_array_equal(eager.chunked(X[:2], X[:2, 0]), eager.chunked(X, X[:, 0])[:2])
