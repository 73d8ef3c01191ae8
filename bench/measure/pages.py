"""Tables and paragraphs in the documents, between markers, from the records in docs/measured, with revision and processor.

A page holds `<!-- measured: NAME -->`, a table or a paragraph, a line that says where it comes from, `<!-- end of NAME -->`.
"""

import ast
import json
import re
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "docs" / "measured"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"(<!-- measured: ([\w-]+) -->\n)(.*?)(\n<!-- end of \2 -->)", re.S)
SOURCE = re.compile(r"^\*(?:Measured|Published) at revision (\w+), ", re.M)
AGED = "\n\n*This table is old: {} later commits have changed what it measures.*"


def record(part: str) -> dict | None:
    """What was measured for a part, or None."""
    path = RECORDS / f"{part}.json"
    return json.loads(path.read_text()) if path.exists() else None


def markdown(rows: list[list[str]]) -> str:
    """A table, whose first row is its head.

    >>> print(markdown([["", "ms"], ["one", "22"]]))
    | | ms |
    |---|---|
    | one | 22 |
    """
    lines = ["|" + "|".join(f" {cell} " if cell else " " for cell in row) + "|" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def source(found: dict) -> str:
    """One sentence: revision, date, processor and command of a record, of times the load as well."""
    how, where = "Measured at" if found["seconds"] else "Published at", found["processor"] or "processor not recorded"
    if found["load"] and " bench.speed." in found["command"]:
        where += f", {found['cores']} cores under a load of {found['load']:.1f}"
    return f"*{how} revision {found['revision']}, {found['date']}, {where}: `{found['command']}`*"


def block(parts: tuple[str, ...], make: Callable[..., list[list[str]] | str]) -> str:
    """What stands between the markers of a table."""
    found = [record(part) for part in parts]
    made = make(*(each["results"] for each in found))
    return (
        "\n" + (made if isinstance(made, str) else markdown(made)) + "\n\n" + "\n".join(source(each) for each in found) + "\n"
    )


def blocks(page: str) -> dict[str, str]:
    """What stands in a page between the markers of every table.

    >>> blocks("<!-- measured: a -->\\n| 1 |\\n<!-- end of a -->")
    {'a': '| 1 |'}
    """
    return {match[2]: match[3] for match in BLOCK.finditer(page)}


def filled(page: str, made: dict[str, str]) -> str:
    """A page with its tables made anew.

    >>> filled("<!-- measured: a -->\\n| 1 |\\n<!-- end of a -->", {"a": "| 2 |"})
    '<!-- measured: a -->\\n| 2 |\\n<!-- end of a -->'
    """
    return BLOCK.sub(lambda match: match[1] + made[match[2]] + match[4], page)


def aged(page: str, paths_of: dict[str, tuple[str, ...]]) -> str:
    """A page that says under every table whether what it measures has changed since.

    Args:
        page: Markdown.
        paths_of: of every table the paths that its figures depend on.
    """

    def noted(match: re.Match[str]) -> str:
        revisions = SOURCE.findall(match[3])
        changes = {change for revision in revisions for change in changes_since(revision, paths_of[match[2]])}
        return match[0] + (AGED.format(len(changes)) if changes else "")

    return BLOCK.sub(noted, page)


@cache
def changes_since(revision: str, paths: tuple[str, ...]) -> list[str]:
    """Commits after a revision to files below the paths whose program differs now; none if git does not know the revision."""
    names = git("diff", "--name-only", "--no-renames", revision, "HEAD", "--", *paths)
    changed = [name for name in names.splitlines() if program(name, revision) != program(name, "HEAD")]
    log = ("log", "--format=%h", "--no-merges", f"{revision}..HEAD", "--")
    return git(*log, *changed).split() if changed else []


@cache
def program(name: str, revision: str) -> str:
    """What a figure can depend on in a file: the statements of Python, without docstrings, comments, layout and the messages of
    errors."""
    text = git("show", f"{revision}:./{name}")
    if not name.endswith(".py"):
        return text
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            node.exc.args = []
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("Error"):
            node.args = []
        if isinstance(body := getattr(node, "body", None), list):
            node.body = [each for each in body if not is_text(each)]
    return ast.dump(tree)


def is_text(statement: ast.AST) -> bool:
    """Whether a statement is a docstring."""
    match statement:
        case ast.Expr(value=ast.Constant(value=str())):
            return True
    return False


def git(*words: str) -> str:
    """What git prints; nothing where it fails."""
    found = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True)
    return found.stdout if found.returncode == 0 else ""


def uncommitted(paths: tuple[str, ...]) -> list[str]:
    """Files below the paths that differ from the last commit."""
    return [line[3:] for line in git("status", "--porcelain", "--", *paths).splitlines()]
