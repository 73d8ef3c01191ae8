"""Each benchmark states its command and stands in bench/README.md."""

import ast
import re

import pytest
from quoted_names import ROOT, quoted_benchmarks

BENCH = ROOT / "bench"
FILES = sorted(BENCH.rglob("*.py"))
SCRIPTS = [path for path in FILES if "__main__" in path.read_text()]


def name_of(path):
    """A path from the repository's root.

    >>> name_of(BENCH / "data" / "record.py")
    'bench/data/record.py'
    """
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("path", SCRIPTS, ids=name_of)
def test_a_benchmark_says_its_own_command(path):
    module = name_of(path).removesuffix(".py").replace("/", ".")
    assert re.search(rf"^.*python -m {re.escape(module)}\b", ast.get_docstring(ast.parse(path.read_text())), re.M)


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_what_a_benchmark_imports_from_another_exists(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module.partition(".")[0] == "bench":
            tree = ast.parse((ROOT / node.module.replace(".", "/")).with_suffix(".py").read_text())
            assert {alias.name for alias in node.names} <= top_names(tree), node.module


def top_names(tree: ast.Module) -> set[str]:
    """Functions, classes and values that a module defines or imports.

    >>> sorted(top_names(ast.parse("from m import b as a\\nc: int = 1\\nd, E = 2, 3\\ndef f(): g = 1\\nclass H: i = 1")))
    ['E', 'H', 'a', 'c', 'd', 'f']
    """
    names = set()
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names |= {alias.asname or alias.name for alias in node.names}
        else:
            names |= {part.id for part in ast.walk(node) if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store)}
    return names


def test_the_list_of_benchmarks_is_complete():
    rows = [row for row in (BENCH / "README.md").read_text().splitlines() if row.startswith("| `")]
    listed = [f"bench/{folder}/{name}" for row in rows for folder, name in re.findall(r"^\| `(\w+)/(\w+\.py)`", row)]
    assert listed == [name_of(path) for path in FILES]
    for row, path in zip(rows, FILES, strict=True):
        assert quoted_benchmarks(row) == ([name_of(path)] if path in SCRIPTS else [])
