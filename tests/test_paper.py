"""docs/paper.md leaves no equation, section or figure out, and what it names exists."""

import ast
import re

import pytest
from quoted_names import ROOT, meant_by, quoted

from torchmembrane.cli.calibrate import STEPS

TEXT = (ROOT / "docs" / "paper.md").read_text()
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
    assert all((ROOT / path).exists() for path in set(re.findall(r"bench/\w+\.py", TEXT)))
    made = {int(n) for n in re.findall(r"^def figure_(\d+)", (ROOT / "docs" / "figures.py").read_text(), re.M)}
    assert {int(n) for n in re.findall(r"figures/figure_(\d+)\.png", TEXT)} == made
