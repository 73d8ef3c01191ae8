"""The private parts of torch in use work and stand in one file."""

import ast
import importlib
import re
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from torchmembrane import MembraneError
from torchmembrane.onnx import torch_internals
from torchmembrane.onnx.torch_internals import CHECKED, TorchExporter, empty_batches, replaced
from torchmembrane.onnx.trace import EXPORTER, traced_model

ROOT = Path(__file__).parents[1]
FILE = ROOT / "torchmembrane" / "onnx" / "torch_internals.py"
BROKEN = f"torch {torch.__version__} changed {{}}: mend torchmembrane/onnx/torch_internals.py, which was tried with {CHECKED}"
ATTRIBUTES = [
    ("torch.export._trace", "_export"),
    ("torch.export._trace", "_export_to_aten_ir"),
    ("torch.export._trace", "_aot_export_joint_with_descriptors"),
    ("torch.fx.config", "do_not_emit_stack_traces"),
    ("torch.onnx._internal.exporter._fx_passes", "decompose_with_registry"),
    ("torch.onnx._internal.exporter._registration", "ONNXRegistry.from_torchlib"),
    ("torch.onnx._internal.exporter._registration", "ONNXRegistry.register_op"),
    ("torch.onnx._internal.fx.passes.type_promotion", "_TypePromotionInterpreter.run_node"),
    ("torch.onnx._internal.fx.passes.type_promotion", "_TypePromotionInterpreter._set_current_node"),
    ("torch.onnx._internal.fx.passes.type_promotion", "_TypePromotionInterpreter._maybe_promote_node"),
]
"""What the file uses of private modules besides what it imports from them."""


def imports(path: Path) -> list[tuple[str, str]]:
    """Modules and names that a file imports, wherever in it."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and not node.level:
            found += [(node.module, alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names]
    return found


def is_private(*names: str) -> bool:
    """
    >>> is_private("torch.export", "_trace"), is_private("torch.nn", "Module"), is_private("torch.onnx._internal", "exporter")
    (True, False, True)
    """
    parts = ".".join(names).split(".")
    return parts[0] == "torch" and any(part.startswith("_") and not part.startswith("__") for part in parts)


PRIVATE = [pair for pair in imports(FILE) if is_private(*pair) or pair[0] == "torch.export.exported_program"]


@pytest.mark.parametrize(("module", "name"), [*PRIVATE, *ATTRIBUTES])
def test_every_private_part_is_there(module, name):
    try:
        value = importlib.import_module(module)
        for part in name.split("."):
            value = getattr(value, part) if hasattr(value, part) else importlib.import_module(f"{value.__name__}.{part}")
    except (ImportError, AttributeError):
        pytest.fail(BROKEN.format(f"{module}.{name}, which is missing"), pytrace=False)


def test_private_parts_of_torch_stand_in_one_file_and_nothing_is_mocked():
    assert len(PRIVATE) > 8
    for path in (ROOT / "torchmembrane").rglob("*.py"):
        modules = imports(path)
        used = {ast.unparse(node) for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
        private = [name for name in used if re.fullmatch(r"[\w.]+", name) and is_private(name)]
        private += [pair for pair in modules if is_private(*pair)]
        assert path == FILE or not private, f"{path}: {private}"
        assert not [pair for pair in modules if pair[0].startswith("unittest")], path


class Mixed(torch.nn.Module):
    """Operands of two types, an operator that ONNX lacks, and one that is translated otherwise."""

    def forward(self, x, n):
        return (x * n).diff(dim=-1) + torch.logsumexp(x, -1, keepdim=True), x.index_select(-1, torch.tensor([2, 0]))


INPUTS = {"x": torch.rand(2, 3, generator=torch.Generator().manual_seed(0)), "n": torch.tensor([[1, 2, 3], [4, 5, 6]])}


@pytest.mark.parametrize(
    ("owner", "name"),
    [
        (torch_internals._trace, "_export_to_aten_ir"),
        (torch_internals._trace, "_aot_export_joint_with_descriptors"),
        (torch_internals.OpSignature, "from_op_schema"),
        (torch_internals.ONNXRegistry, "from_torchlib"),
        (torch_internals._TypePromotionInterpreter, "run_node"),
        (torch_internals._fx_passes, "decompose_with_registry"),
    ],
)
def test_torch_calls_what_is_replaced(owner, name, monkeypatch):
    """Or an export would silently do its work twice, or without the translations."""
    called, put = [], torch_internals.replaced

    def watched(where, what, value):
        if where is not owner or what != name:
            return put(where, what, value)
        watching = lambda *given, **named: called.append(what) or value(*given, **named)  # noqa: E731
        return put(where, what, staticmethod(watching) if isinstance(value, staticmethod) else watching)

    monkeypatch.setattr(torch_internals, "replaced", watched)
    traced_model(Mixed(), INPUTS, ["a", "b"])
    assert called, BROKEN.format(f"{owner.__name__}.{name}, which the exporter calls no more")


def test_an_export_gives_what_the_module_gives():
    model = traced_model(Mixed(), INPUTS, ["a", "b"])
    found = onnxruntime.InferenceSession(model.SerializeToString()).run(None, {k: v.numpy() for k, v in INPUTS.items()})
    for value, expected in zip(found, Mixed()(*INPUTS.values()), strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-6, err_msg=BROKEN.format("what its exporter writes"))


def test_a_program_is_captured_in_operators_of_onnx():
    with EXPORTER.at_work():
        program = EXPORTER.captured(Mixed(), tuple(INPUTS.values()))
    names = {str(node.target) for node in program.graph.nodes if node.op == "call_function"}
    assert "aten.diff.default" not in names, BROKEN.format("torch.export._trace._export_to_aten_ir, which does not decompose")
    assert "aten.index_select.default" in names


def test_examples_take_no_memory():
    large, scalar = empty_batches([torch.ones(2, 10**6), torch.tensor(1.0)], 10**6)
    assert large.shape == (10**6, 10**6) and scalar.shape == ()


def test_a_name_is_replaced_for_a_while_and_one_that_is_missing_is_named():
    class Owner:
        @classmethod
        def kept(cls):
            return 1

    before = vars(Owner)["kept"]
    with pytest.raises(KeyError), replaced(Owner, "kept", staticmethod(lambda: 2)):
        assert Owner.kept() == 2
        raise KeyError
    assert vars(Owner)["kept"] is before
    with pytest.raises(MembraneError, match=r"has no Owner.gone.*tried: 2\."), replaced(Owner, "gone", None):
        pass


def test_translations_are_registered_once():
    exporter = TorchExporter({torch.ops.aten.sin.default: lambda x: x})
    registry = exporter._registry()
    assert exporter._registry() is registry is not EXPORTER._registry()
    assert registry.get_decomps(torch.ops.aten.sin.default)[0].onnx_function(3) == 3
