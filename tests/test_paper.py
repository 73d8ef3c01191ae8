"""docs/paper.md covers every equation, section and figure."""

import ast
import re

import pytest
import torch
from quoted_names import ROOT, meant_by, quoted, quoted_benchmarks

from torchmembrane.cli.calibrate import STEPS
from torchmembrane.surface.topology import corners

TEXT = (ROOT / "docs" / "paper.md").read_text()
CHAIN = "\n".join(re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "paper_chain.md").read_text(), re.S))
NAMED_TESTS = sorted(set(re.findall(r"`(test_\w+)::(test_\w+)`", TEXT)))


def listed(words: str) -> set[int]:
    """Numbers after a word as in `Figs. 9, 10` in the first column of a table's rows."""
    column = re.findall(r"^\| ([^|]*)", TEXT, re.M)
    found = (re.findall(rf"(?:{words}) ((?:\d+(?:, )?)+)", row) for row in column)
    return {int(number) for row in found for group in row for number in re.findall(r"\d+", group)}


def test_no_equation_and_no_figure_is_left_out():
    assert listed(r"[Ee]qs?\.") >= set(range(1, 65))
    assert listed(r"Figs?\.") >= set(range(1, 22))
    for part in ("1", "2", "3", "3.1", "3.2", "3.3", "4", "5", "5.1", "5.2", "5.3", "6"):
        assert re.search(rf"Sections? ([\d.]+, )*{re.escape(part)}\b", TEXT), part
    assert all(f"Appendix {letter}" in TEXT for letter in "ABCD") and "Table 1" in TEXT


@pytest.mark.parametrize("module", sorted({module for module, _ in NAMED_TESTS}))
def test_every_named_test_exists(module):
    tree = ast.parse((ROOT / "tests" / f"{module}.py").read_text())
    defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert {name for where, name in NAMED_TESTS if where == module} <= defined


@pytest.mark.parametrize("name", quoted(TEXT))
def test_every_named_function_exists(name):
    meant_by(name)


def test_every_row_names_a_test():
    tables = TEXT[: TEXT.index("## Measured")]
    rows = [row for row in re.findall(r"^\| .*", tables, re.M) if not re.match(r"\| (paper|where) \|", row)]
    assert [row for row in rows if not re.search(r"`test_\w+::test_\w+` \|$", row)] == []


def test_calibration_names_every_step_and_no_other():
    assert set(re.findall(r"`torchmembrane calibrate (\w+)`", TEXT)) == set(STEPS)


def test_every_named_bench_and_figure_is_made():
    assert all((ROOT / path).exists() for path in quoted_benchmarks(TEXT))
    made = {int(n) for n in re.findall(r"^def figure_(\d+)", (ROOT / "docs" / "figures.py").read_text(), re.M)}
    assert {int(n) for n in re.findall(r"figures/figure_(\d+)\.png", TEXT)} == made


@pytest.fixture(scope="module")
def chain():
    """What the worked page's code has defined after it ran."""
    names: dict = {}
    exec(compile(CHAIN, "paper_chain.md", "exec"), names)
    return names


def test_the_worked_page_solves_the_paper_s_equations(chain):
    """Eqs. 14, 18, 25, 26 and 28 hold for its tensors, and by itself it goes the way that the product goes."""
    Q, K, M, psi, programme = (chain[name] for name in ("Q", "K", "M", "psi", "programme"))
    estimator, observation, free = chain["estimator"], chain["observation"], chain["membrane"].free_vertices
    t = estimator.rest_range
    maps = (chain["A_k"] * corners(t[:, None], chain["membrane"].grid).mT[..., None, :]).sum(-1)
    energy = estimator.energy.tension * (estimator.energy.area * maps.square().sum((-1, -2))).sum()
    torch.testing.assert_close((Q @ t).square().sum(), energy)
    torch.testing.assert_close(t @ K @ t, energy)
    assert (Q != 0).sum(1).max() == 4 and (K != 0).sum(1).max() == 9 and (M != 0).sum(1).max() == 13
    stationary = psi[0] @ M[free][:, free] - programme.load[0] + chain["multiplier"] * programme.v[0]
    assert stationary.abs().max() < 1e-12 and abs(programme.v[0] @ psi[0] + programme.rise[0]) < 1e-10
    first = estimator.solve(observation, chain["relaxed"])
    torch.testing.assert_close(chain["pressure"], first.pressure)
    x = chain["origins"][:, free] + (t[free] + psi)[..., None] * chain["directions"][:, free]
    torch.testing.assert_close(first.vertices[:, free], x)
    torch.testing.assert_close(chain["result"].vertices, chain["loop"].surface.vertices)
    bilinear = estimator.flow.interpolation.bilinear
    torch.testing.assert_close(chain["flow"][0], bilinear @ chain["u"][0], rtol=0, atol=2e-2)


def test_the_worked_page_says_what_it_gives(chain):
    """The shapes and the error in its comments."""
    said = []
    for line in CHAIN.splitlines():
        code, _, comment = line.partition("  # ")
        shapes = [ast.literal_eval(shape) for shape in re.findall(r"\[\d+(?:, \d+)*\]", comment)]
        if shapes and (printed := re.findall(r"([\w.]+)\.shape", code)):
            said += zip(printed, shapes * len(printed), strict=False)
        elif shapes and (assigned := re.match(r"(\w+(?:, \w+)*) = ", code)):
            said += zip(assigned[1].split(", "), shapes + shapes[-1:], strict=False)
    tensors = {name: eval(name, chain) for name, _ in said}
    assert len(said) > 20
    assert {name: list(tensors[name].shape) for name, _ in said if hasattr(tensors[name], "shape")} == {
        name: shape for name, shape in said if hasattr(tensors[name], "shape")
    }
    error, shift = (float(chain[name].square().sum(1).mean().sqrt()) for name in ("error", "shift"))
    (words,) = re.findall(r"mm\"\)  # ([\d.]+) of ([\d.]+) mm", CHAIN)
    assert (error, shift) == pytest.approx([float(word) for word in words], abs=2e-3)
