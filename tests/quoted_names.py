"""Names of the code that documents quote, and what they stand for."""

import importlib
import re
from pathlib import Path

import torchmembrane

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "torchmembrane"
TOP = {path.stem for path in PACKAGE.iterdir()}
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def quoted(text: str) -> list[str]:
    """Quoted names of the package: `tm.NAME`, or dotted ones that begin with a module at its top.

    >>> quoted("`tm.Sensor`, `solve.kkt.Minimum`, `np.ndarray`, `camera.toml`, `camera`")
    ['solve.kkt.Minimum', 'tm.Sensor']
    """
    dotted = re.findall(r"`(?:torchmembrane\.)?([a-z_]+(?:\.\w+)+)[`(]", text)
    names = {name for name in dotted if name.split(".")[0] in {"tm", *TOP}}
    return sorted(name for name in names if not name.endswith((".toml", ".csv", ".npz", ".png")))


def quoted_paths(text: str) -> list[str]:
    """Quoted paths of Python files.

    >>> quoted_paths("`solve/kkt.py`, `python docs/reference.py --check`, `kkt.py`")
    ['docs/reference.py', 'solve/kkt.py']
    """
    return sorted(set(re.findall(r"`(?:python )?((?:\w+/)+\w+\.py)\b", text)))


def quoted_benchmarks(text: str) -> list[str]:
    """Paths of the benchmarks that a text names, as a file or in a command.

    >>> quoted_benchmarks("`bench/a/one.py` (`python -m\\nbench.a.two DATA`), python bench/a/three.py")
    ['bench/a/one.py', 'bench/a/three.py', 'bench/a/two.py']
    """
    modules = re.findall(r"python -m\s+(bench(?:\.\w+)+)", text)
    return sorted({*re.findall(r"\bbench/[\w/]+\.py\b", text), *(f"{name.replace('.', '/')}.py" for name in modules)})


def meant_by(name: str) -> object:
    """What a dotted name stands for; fails where there is nothing of that name.

    >>> meant_by("solve.kkt.solve_bordered").__name__, meant_by("tm.Status.OK").value
    ('solve_bordered', 0)
    """
    first, *rest = name.split(".")
    found = torchmembrane if first == "tm" else importlib.import_module(f"torchmembrane.{first}")
    path = PACKAGE / first
    for part in rest:
        path = path / part
        is_module = first != "tm" and (path.is_dir() or path.with_suffix(".py").exists())
        found = importlib.import_module(f"{found.__name__}.{part}") if is_module else member(found, part)
    return found


def member(owner: object, name: str) -> object:
    """An attribute, or the type of one that a class only declares (a module's buffer, a field without default)."""
    declared = {}
    for kind in reversed(getattr(owner, "__mro__", ())):
        declared |= vars(kind).get("__annotations__", {})
    return declared[name] if name in declared and not hasattr(owner, name) else getattr(owner, name)
