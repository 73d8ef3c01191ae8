"""Changelog, contributing guide, glossary and citation are true."""

import re
import tomllib

import pytest
from quoted_names import PACKAGE, PAGES, ROOT, meant_by, quoted, quoted_benchmarks, quoted_paths

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
CHANGELOG = (ROOT / "CHANGELOG.md").read_text()
GLOSSARY = (ROOT / "docs" / "glossary.md").read_text()
MATHEMATICS = (ROOT / "docs" / "mathematics.md").read_text()


def read_yaml(text: str):
    """The part of YAML that a citation needs: blocks of keys and of list items, texts and whole numbers.

    >>> read_yaml('title: "A: b"\\nauthors:\\n  - name: C\\n    age: 3\\n  - name: D\\nkeywords:\\n  - E')
    {'title': 'A: b', 'authors': [{'name': 'C', 'age': 3}, {'name': 'D'}], 'keywords': ['E']}
    """
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    assert not [line for line in lines if "\t" in line]
    found, rest = _block(lines, 0)
    assert not rest, f"not understood: {rest[0]!r}"
    return found


def _block(lines: list[str], indent: int):
    """What stands at the beginning of `lines` at this indent, and the lines that are left."""
    found = [] if lines[0].lstrip().startswith("- ") else {}
    while lines and len(lines[0]) - len(lines[0].lstrip()) == indent:
        item, lines = lines[0].strip(), lines[1:]
        if isinstance(found, list):
            mark, item = item[:2], item[2:]
            assert mark == "- ", f"expected an item of a list: {item!r}"
            value, lines = _block([" " * (indent + 2) + item, *lines], indent + 2) if _pair(item) else (_scalar(item), lines)
            found.append(value)
        else:
            assert _pair(item), f"expected `key: value`: {item!r}"
            key, text = _pair(item).groups()
            assert key not in found, f"twice: {key}"
            found[key], lines = (_scalar(text), lines) if text else _block(lines, indent + 2)
    return found, lines


def _pair(item: str) -> re.Match | None:
    return re.fullmatch(r"([a-z][a-z-]*):(?: (.+))?", item)


def _scalar(text: str) -> str | int:
    if quoted := re.fullmatch(r'"([^"\\]*)"', text):
        return quoted[1]
    assert not re.search(r": | #|^[\[{&*!|>%@`\"'?-]", text), f"needs quotes: {text!r}"
    return int(text) if text.isdigit() else text


@pytest.fixture(scope="module")
def citation():
    return read_yaml((ROOT / "CITATION.cff").read_text())


def test_citation_has_what_the_format_requires(citation):
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert citation["cff-version"] == "1.2.0" and citation["type"] == "software"
    for reference in citation["references"]:
        assert {"type", "title", "authors"} <= reference.keys()
        assert all({"given-names", "family-names"} <= person.keys() for person in reference["authors"])


def test_citation_is_of_this_version(citation):
    project = PROJECT["project"]
    assert citation["title"] == project["name"] and citation["version"] == project["version"]
    assert citation["license"] == project["license"] and citation["abstract"] == project["description"]
    assert citation["repository-code"] == project["urls"]["Homepage"]
    assert [author["name"] for author in citation["authors"]] == [author["name"] for author in project["authors"]]


def test_a_broken_citation_is_not_read():
    for broken in ("title: A: b", "title: A\ntitle: B", "authors:\n  name: A\n - b", "- a\nb: c"):
        with pytest.raises(AssertionError):
            read_yaml(broken)


def test_changelog_begins_with_this_version():
    assert re.search(r"^## \[(.+?)\]", CHANGELOG, re.M)[1] == PROJECT["project"]["version"]


def test_drawn_layers_are_the_checked_ones():
    contracts = PROJECT["tool"]["importlinter"]["contracts"]
    (layers,) = (contract["layers"] for contract in contracts if contract["type"] == "layers")
    drawn = "\n".join(f"    {layer.replace('torchmembrane.', '')}" for layer in layers)
    assert f"\n\n{drawn}\n\n" in (ROOT / "CONTRIBUTING.md").read_text()


@pytest.mark.parametrize("page", ["CHANGELOG.md", "CONTRIBUTING.md"])
def test_linked_files_exist(page):
    targets = re.findall(r"\]\(([^)#:]+)\)", (ROOT / page).read_text())
    assert targets and not [target for target in targets if not (ROOT / target).exists()]


def glossary() -> list[tuple[str, list[str], list[str]]]:
    """Of each line: the field's word, names of the code, symbols."""
    rows = [
        [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in GLOSSARY.splitlines() if line.startswith("| ")
    ]
    assert all(len(row) == 4 for row in rows)
    return [(row[0], *(re.findall(r"`([^`]+)`", cell) for cell in row[2:])) for row in rows if row[0] != "the field's word"]


FIELD_S_WORDS = """traction field; force distribution; shear; marker displacement; marker flow; reference; undeformed;
no-contact; wrench; contact patch; contact mask; indentation depth; inverse finite elements; incipient slip; prestretch;
marker-based visuotactile sensor; bearing; GNC; IRLS; tangent stiffness; one-ring"""


@pytest.mark.parametrize("word", re.split(r";\s", FIELD_S_WORDS))
def test_glossary_has_the_field_s_words(word):
    assert any(word in row[0] for row in glossary())


@pytest.mark.parametrize("word, names, symbols", glossary(), ids=lambda value: value if isinstance(value, str) else "")
def test_glossary_names_the_code_and_the_symbols(word, names, symbols):
    assert names
    for name in names:
        meant_by(name)
    assert not [symbol for symbol in symbols if not re.search(rf"(?<!\w){re.escape(symbol)}(?!\w)", MATHEMATICS)]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_named_code_exists(page):
    for name in quoted(page.read_text()):
        meant_by(name)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_named_files_exist(page):
    folders = (ROOT, ROOT / "torchmembrane")
    assert not [path for path in quoted_paths(page.read_text()) if not any((folder / path).exists() for folder in folders)]


def test_named_benchmarks_exist():
    """In documents, in the Makefile, and in docstrings."""
    sources = [path for folder in (ROOT / "bench", PACKAGE) for path in sorted(folder.rglob("*.py"))]
    texts = [*PAGES, ROOT / "CHANGELOG.md", ROOT / "Makefile", ROOT / "bench" / "README.md", *sources]
    named = {name: path for path in texts for name in quoted_benchmarks(path.read_text())}
    assert len(named) > 30 and {name: path for name, path in named.items() if not (ROOT / name).exists()} == {}
