"""House rules: lengths of files, imports, constants in documents.

Layers and types are checked by `make lint`.
"""

import ast
import functools
import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "torchmembrane"
FILES = sorted(PACKAGE.rglob("*.py"))
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
LONG_FILE, LONGEST_FILE, LONGEST_FUNCTION = 350, 450, 50
ONE_THING: dict[str, str] = {
    "mechanics/hyperelastic.py": "one energy with its gradient and Hessian",
}
"""Files of more than `LONG_FILE` lines, and why each is one thing."""
HEAVY = ("torch", "kornia", "scipy", "matplotlib", "tqdm")

CONSTANT = r"`((?:[a-z_]+\.)*(?:[A-Z][A-Z0-9_]+|(?:[A-Z]\w+Settings)?\.[a-z]\w*))`"
NUMBER = r"-?[0-9.]+(?:e-?[0-9]+)?"
QUOTED = re.compile(rf"{CONSTANT}\s=\s({NUMBER}(?:,\s{NUMBER})*)")
"""A constant, or a setting and its default, as documents quote them: the name, as much of its module as identifies it, then
the value or values. `.name`: a setting that only one class has."""
NAMED = re.compile(CONSTANT)

every_file = pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
every_document = pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)


def length(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines from `def` to the end, the docstring's left out: what has to be understood at once.

    >>> length(ast.parse("def f():\\n    'Said.'\\n    return 1").body[0])
    2
    """
    docstring = function.body[0] if ast.get_docstring(function, clean=False) is not None else None
    said = docstring.end_lineno - docstring.lineno + 1 if docstring else 0
    return function.end_lineno - function.lineno + 1 - said


@every_file
def test_a_file_is_short_or_says_why_not(path):
    lines, is_one_thing = len(path.read_text().splitlines()), str(path.relative_to(PACKAGE)) in ONE_THING
    assert lines <= LONGEST_FILE
    assert (lines > LONG_FILE) == is_one_thing


@every_file
def test_functions_are_short(path):
    functions = [f for f in ast.walk(ast.parse(path.read_text())) if isinstance(f, ast.FunctionDef | ast.AsyncFunctionDef)]
    long = {f"{f.name}, line {f.lineno}": length(f) for f in functions if length(f) > LONGEST_FUNCTION}
    assert not long


@every_file
def test_nothing_hides_from_the_linters(path):
    hidden = re.compile(r"# noqa: E731|# noqa(?!: [A-Z])|# fmt: (skip|off)|# type: ignore(?!\[)|# mypy: ")
    assert not [f"{number}: {line}" for number, line in enumerate(path.read_text().splitlines(), 1) if hidden.search(line)]


def test_every_module_has_its_layer():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = (contract["layers"] for contract in contracts if contract["type"] == "layers")
    layered = {name for layer in layers for name in re.findall(r"[\w.]+", layer)}
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in FILES}
    layerless = {name for name in modules if not any(f"{name}.".startswith(f"{layer}.") for layer in layered)}
    assert layerless == {"torchmembrane", "torchmembrane.__main__"}


def loaded(*arguments: str) -> set[str]:
    """The heavy packages that `python *arguments` has imported when it ends."""
    command = [sys.executable, "-X", "importtime", *arguments]
    lines = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stderr.splitlines()
    names = {line.rpartition("|")[2].strip().partition(".")[0] for line in lines if line.startswith("import time:")}
    assert "torchmembrane" in names
    return names & set(HEAVY)


def test_importing_the_package_loads_nothing_heavy():
    assert loaded("-c", "import torchmembrane") == set()


def test_help_loads_nothing_heavy():
    assert loaded("-m", "torchmembrane", "--help") == set()


@pytest.mark.parametrize("package", ["matplotlib", "tqdm"])
def test_imported_only_where_it_is_used(package):
    """Only `plot` imports matplotlib with the module; a progress bar is imported by the function that draws it."""
    importers = {str(path.relative_to(PACKAGE)) for path in FILES if package in imported_at_once(ast.parse(path.read_text()))}
    assert {name for name in importers if not name.startswith("plot/")} == set()


def imported_at_once(tree: ast.AST) -> set[str]:
    """Packages that come in with a module, not with a call of one of its functions nor for types only."""
    found = set()
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add(node.module.partition(".")[0])
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            continue
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            found |= imported_at_once(node)
    return found


@functools.cache
def constants() -> dict[str, object]:
    """The package's upper-case names and settings' defaults by full name; None for what is not written out in the code."""
    found = {}
    for path in FILES:
        module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix("__init__").rstrip(".")
        tree = ast.parse(path.read_text())
        found |= {f"{module}.{name}": value for name, value in assigned(tree) if name.isupper()}
        for settings in (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name.endswith("Settings")):
            found |= {f"{module}.{settings.name}.{name}": value for name, value in assigned(settings)}
    return found


def assigned(scope: ast.Module | ast.ClassDef) -> list[tuple[str, object]]:
    """Names that a module or a class sets, and their values.

    >>> assigned(ast.parse("A, B = 1, (2, 3)\\nc: int = f(4)"))
    [('A', 1), ('B', (2, 3)), ('c', None)]
    """
    found = []
    for node in scope.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            pairs = zip(target.elts, node.value.elts, strict=True) if paired(target, node.value) else [(target, node.value)]
            found += [(ast.unparse(name), written_out(value)) for name, value in pairs]
    return found


def paired(target: ast.expr, value: ast.expr) -> bool:
    return isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)


def written_out(value: ast.expr):
    try:
        return ast.literal_eval(value)
    except ValueError:
        return None


def meant(name: str, known: dict[str, object]) -> list[str]:
    """The constants of this name in modules below those that it mentions.

    >>> meant("balance.REACH", {"estimators.balance.losses.REACH": 0.04, "markers.texture.REACH": 7})
    ['estimators.balance.losses.REACH']
    """
    *above, last = name.lstrip(".").split(".")
    full_names = [full for full in known if full.split(".")[-1] == last]
    return [full for full in full_names if set(above) <= set(full.split("."))]


@every_document
def test_quoted_constants_are_the_code_s(path):
    known, wrong = constants(), []
    for name, text in QUOTED.findall(path.read_text()):
        full = meant(name, known)
        values = tuple(float(part) for part in text.split(","))
        if [known[each] for each in full] not in ([values], [values[0]] if len(values) == 1 else None):
            wrong.append(f"{name} = {text}: {({each: known[each] for each in full}) or 'no such constant'}")
    assert not wrong


@every_document
def test_named_constants_exist(path):
    """Those with their module or class; a bare `NAME` may as well stand for a file's or an argument's."""
    known = constants()
    assert not [name for name in NAMED.findall(path.read_text()) if name.find(".") > 0 and len(meant(name, known)) != 1]


EXAMPLES_LEFT_OUT = {
    "ForceBalance": "built by Reconstructor, whose example runs it",
    "MinimumEnergy": "built by Reconstructor",
    "PaperEstimator": "built by Reconstructor",
    "export": "takes half a minute",
    "material_from_images": "some twenty force balances",
    "material_from_pixels": "some twenty force balances",
    "material_from_weight": "some twenty force balances",
    "rest_from_views": "needs images taken from several places, which take seconds to render",
}
"""Public names whose docstrings run no example, and why; records, whose docstrings list their fields, need none either."""


def is_record(value: object) -> bool:
    """Whether it is a class of named fields whose docstring says what they are."""
    return isinstance(value, type) and issubclass(value, tuple)


@pytest.mark.parametrize("face", ["torchmembrane", "torchmembrane.simulate", "torchmembrane.calibrate"])
def test_public_names_have_an_example(face):
    module = importlib.import_module(face)
    public = {name: getattr(module, name) for name in module.__all__}
    shown = {name: value for name, value in public.items() if callable(value) and not is_record(value)}
    without = {name for name, value in shown.items() if ">>>" not in (value.__doc__ or "")}
    assert len(shown) > 5 and without == EXAMPLES_LEFT_OUT.keys() & shown.keys()


@pytest.mark.parametrize("page, at_least", [("conventions.md", 9), ("mathematics.md", 20), ("force_balance.md", 9)])
def test_the_pages_that_state_limits_quote_them(page, at_least):
    assert len(QUOTED.findall((ROOT / "docs" / page).read_text())) >= at_least


def test_the_lowest_constraints_are_the_bounds_of_the_dependencies():
    """Each dependency's, and no others; of the extras no bound is below the one that they share with the package."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pins = dict(re.findall(r"^([\w-]+)==([\d.]+)$", (ROOT / "constraints-lowest.txt").read_text(), re.MULTILINE))

    def number(version):
        parts = [int(part) for part in version.split(".")]
        return parts + [0] * (3 - len(parts))

    bounds = dict(re.fullmatch(r"([\w-]+)>=([\d.]+)", each).groups() for each in project["dependencies"])
    assert {name: number(pin) for name, pin in pins.items()} == {name: number(bound) for name, bound in bounds.items()}
    shared = re.findall(r"\b([\w-]+)>=([\d.]+)", " ".join(sum(project["optional-dependencies"].values(), [])))
    assert not [(name, bound) for name, bound in shared if name in bounds and number(bound) < number(bounds[name])]
    edge = tomllib.loads((ROOT / "export" / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert f"pillow>={bounds['pillow']}" in edge["images"]


def test_no_stray_file_is_tracked_at_the_top():
    tracked = subprocess.run(["git", "ls-files", ":(glob)*"], cwd=ROOT, capture_output=True, text=True)
    if tracked.returncode:
        pytest.skip("no git checkout")
    known = {".gitignore", ".pre-commit-config.yaml", "CITATION.cff", "LICENSE", "Makefile", "mkdocs.yml", "pyproject.toml"}
    stray = [name for name in tracked.stdout.split() if name not in known and Path(name).suffix not in {".md", ".txt"}]
    assert stray == []


@pytest.mark.parametrize("path", sorted((ROOT / "tests").glob("*.py")), ids=lambda path: path.name)
def test_a_test_file_says_its_law_in_its_title(path):
    title = (ast.get_docstring(ast.parse(path.read_text())) or "").partition("\n")[0]
    assert title and len(title) <= 70, f"{path.name}: {len(title)} characters, expected 1 to 70"
