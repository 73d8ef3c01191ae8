"""Code in the site's pages breaks where it can be read: not within an option, in a table not within a short name. Pictures open
in their own size where they are clicked. A measured table says so where what it measures has changed since."""

import re

from bench.measure.pages import aged
from bench.measure.tables import TABLES, paths_of

LONGEST = 18  # letters of a name that is kept whole in a table
OPTION = re.compile(r"(?<![\w-])--?[A-Za-z][\w-]*")
CODE = re.compile(r"(<code[^>]*>)(.*?)(</code>)", re.S)
PICTURE = re.compile(r'<img [^>]*src="([^"]+)"[^>]*>')
CELL = re.compile(r"<(t[dh]).*?</\1>", re.S)
JOINT = re.compile(r"(?<=\w)(::|[._/(\[,=])(?=[\w\]])")


def on_page_markdown(markdown: str, **_: object) -> str:
    """A page whose measured tables say how old they are."""
    return aged(markdown, {table: paths_of(table) for table in TABLES})


def on_page_content(html: str, **_: object) -> str:
    """A page's HTML, options in code made whole, code in tables broken at its joints, pictures as links to themselves."""
    html = PICTURE.sub(r'<a href="\1">\g<0></a>', html)
    return CODE.sub(_with_whole_options, CELL.sub(lambda cell: CODE.sub(_in_cell, cell[0].replace("\\|", "|")), html))


def _with_whole_options(code: re.Match[str]) -> str:
    return code[1] + OPTION.sub(r'<span class="whole">\g<0></span>', code[2]) + code[3]


def _in_cell(code: re.Match[str]) -> str:
    if "<" in code[2]:
        return code[0]
    if len(code[2]) <= LONGEST:
        return f'<span class="whole">{code[0]}</span>'
    return code[1] + JOINT.sub(r"\1<wbr>", code[2]) + code[3]
