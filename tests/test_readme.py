"""The README's Python example runs and says what it claims."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_python_example_runs(monkeypatch):
    monkeypatch.chdir(ROOT)
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    assert names["result"].status.tolist() == [0, 0]
    assert list(names["result"].vertices.shape) == [2, 1089, 3]
    assert list(names["again"].vertices.shape) == [2, 1089, 3]


def test_every_linked_file_exists():
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
