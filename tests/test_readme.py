"""The README's Python example runs and does what it claims."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest
import torch

import torchmembrane
from torchmembrane.cli.main import main

ROOT = Path(__file__).parents[1]
(CODE,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
PRESSES = ("press_on_axis", "flat_plate")


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """The example's names, after it ran where `make demo` has written its results."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "examples").symlink_to(ROOT / "examples")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        files = [f"examples/{name}.png" for name in PRESSES]
        assert main(["reconstruct", "examples/sensor.toml", *files, "--out", "out/demo", "--device", "cpu"]) == 0
        names: dict = {}
        exec(compile(CODE, "README.md", "exec"), names)
        yield names


def test_the_python_example_is_short_and_needs_public_names_only():
    assert len(CODE.splitlines()) <= 15
    tree = ast.parse(CODE)
    (imported,) = (node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom))
    assert ast.unparse(imported) == "import torchmembrane as tm"
    assert set(re.findall(r"\btm\.(\w+)", CODE)) <= set(torchmembrane.__all__)


def test_the_python_example_runs(example):
    result = example["result"]
    assert [torchmembrane.Status(code) for code in result.status.tolist()] == [torchmembrane.Status.OK] * 2
    assert list(result.vertices.shape) == [2, 1089, 3]
    assert (result.force[:, 2] < 0).all()  # both press towards the camera


def test_the_example_s_gradient_is_finite(example):
    gradient = example["images"].grad
    assert gradient.isfinite().all() and (gradient.abs().amax((1, 2, 3)) > 0).all()


def test_the_example_s_tracker_follows_the_last_frame(example):
    last, alone = example["tracker"](example["frame"]), example["result"].frame(1)
    moved = np.linalg.norm(alone["displacement"])
    assert np.linalg.norm(last.frame(0)["vertices"] - alone["vertices"]) < 0.1 * moved


def test_the_example_reads_back_what_was_found(example):
    """To the last bit what is found of these images; with gradients, by tensor operations, within half a settled step."""
    results, reconstructor = example["results"], example["reconstructor"]
    found = reconstructor(example["images"].detach())
    assert sorted(results.names) == sorted(PRESSES)
    for row, name in enumerate(PRESSES):
        for key, value in found.frame(row).items():
            np.testing.assert_array_equal(results[name][key], value, err_msg=key)
        recorded = example["result"].frame(row)
        apart = np.square(recorded["vertices"] - results[name]["vertices"]).sum(-1).mean() ** 0.5
        assert apart < 0.5 * torchmembrane.ForceBalanceSettings().settled_step_tol * reconstructor.estimator.size
        np.testing.assert_allclose(recorded["force"], results[name]["force"], rtol=0, atol=1e-3 * abs(recorded["force"]).max())


def test_with_gradients_the_example_s_images_give_the_same_but_for_rounding():
    """In double precision; in single precision rounding decides with which step a frame has settled."""
    reconstructor = torchmembrane.Reconstructor.from_file(ROOT / "examples" / "sensor.toml", dtype=torch.float64)
    images = reconstructor.read(*(ROOT / "examples" / f"{name}.png" for name in PRESSES))
    found, recorded = (reconstructor(each).cpu() for each in (images, images.clone().requires_grad_()))
    np.testing.assert_allclose(recorded.vertices.detach(), found.vertices.detach(), rtol=0, atol=1e-6)
    np.testing.assert_allclose(recorded.force.detach(), found.force.detach(), rtol=0, atol=1e-6 * float(abs(found.force).max()))


def test_every_linked_file_exists():
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
