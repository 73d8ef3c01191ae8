"""What the pages of the API need of docstrings: `Example:` is a section, a table of arrays stays as it is typed."""

import re
from typing import Any

import griffe

ARRAYS = re.compile(r"(?:^\w+ +\[[^\n]*\n(?:^ {8,}\S[^\n]*\n)*){3,}", re.M)
"""Lines as `vertices   [B, V, 3]  deformed surface`, at least three, and what continues them."""


class Docstrings(griffe.Extension):
    """Prepares docstrings for the renderer."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring:
            text = re.sub(r"^( *)Example:$", r"\1Examples:", obj.docstring.value, flags=re.M)
            obj.docstring.value = ARRAYS.sub(
                lambda block: "\n" + re.sub(r"^", "    ", block[0], flags=re.M).rstrip() + "\n", text
            )
